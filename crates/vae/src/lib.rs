//! BEV-VAE: image, scene and state encoders and decoders, discriminator, losses.

mod config;
mod discriminator;
pub mod image_coder;
pub mod losses;
mod model;
pub mod official;
pub mod pixels;
pub mod pyramid;
pub mod sample_points;
pub mod scene_decoder;
pub mod scene_encoder;
mod segmented;
pub mod state_coder;

pub use config::{BevVaeConfig, ConfigError, ImageConfig, Preset, SceneConfig, StateConfig};
pub use discriminator::Discriminator;
pub use model::{BevVae, Decoded, Decoder, Encoder};
pub use sample_points::{SamplePoints, ViewMatrices};
pub use segmented::{OnBoth, SegmentedPass};
pub use state_coder::{DiagonalGaussian, latent_picture, latent_tokens};
