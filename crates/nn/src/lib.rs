//! Layers that several models share.

pub mod golden;
mod init;
pub mod layout;
mod linear;
pub mod lora;
mod norm;
mod position;
pub mod segments;
mod transformer;
pub mod weights;

pub use init::Init;
pub use linear::{Bias, Conv3x3, Conv3x3x3, Linear, PatchConv2d, PatchConv3d, PatchDeconv2d};
pub use norm::{GroupNorm, LayerNorm, RmsNorm};
pub use position::{RotaryAngles, sincos_3d};
pub use transformer::{Mlp, NORM_EPSILON, RotaryAttention, RotaryBlock, RotaryStack};
