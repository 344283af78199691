//! The networks of latent diffusion, as Stable Diffusion 1.5 and 2.1 publish them.
//!
//! Paper: Rombach et al., "High-Resolution Image Synthesis with Latent Diffusion Models"; Zhang et al., "Adding Conditional
//! Control to Text-to-Image Diffusion Models". Parameters carry the names of diffusers' state dicts ([`layout`]), so published
//! weights load by name and ours open elsewhere.

mod attention;
mod config;
pub mod controlnet;
pub mod cross_view;
mod layers;
pub mod layout;
mod lora_sites;
mod panels;
mod preset;
mod resnet;
pub mod text;
pub mod unet;
pub mod vae;

pub use attention::Attention;
pub use config::ConfigError;
pub use controlnet::{ControlInputs, ControlNet, ControlNetConfig, ControlResiduals};
pub use cross_view::{Adjacency, CrossView, NeighbourMerge};
pub use layers::{Conv2d, Downsample, Upsample};
pub use panels::{Panels, join_width, split_width};
pub use preset::Preset;
pub use resnet::{ResnetBlock, ResnetSizes};
pub use text::{ClipTextConfig, ClipTextModel, ClipTokenizer, SmallTextEncoder, TextEncoder, TokenBatch, Tokenizer};
pub use unet::{
    AttentionHeads, EncoderConfig, ProjectionKind, SegmentedUNet, UNet2DCondition, UNetConfig, UNetGradients,
    UNetInputs,
};
pub use vae::{AutoencoderKL, Posterior, Tiling, VaeConfig};
