//! UNet2DCondition: predicts noise (or velocity, or the clean latent) from a noisy latent, a time and text.

mod blocks;
mod config;
mod model;
mod segmented;
mod time;
mod transformer;

pub use blocks::{Condition, DownBlock, MidBlock, UpBlock};
pub use config::{AttentionHeads, EncoderConfig, ProjectionKind, UNetConfig};
pub use model::{UNet2DCondition, UNetInputs};
pub use segmented::{SegmentedUNet, UNetGradients};
pub use time::{TimeEmbedding, time_code};
pub use transformer::{FeedForward, Projection, Transformer2d, TransformerBlock};

pub(crate) use blocks::{encode, encoder_blocks};
pub(crate) use model::condition;
