//! DiT: a transformer that predicts the noise in a latent picture.
//!
//! Paper: Peebles & Xie, "Scalable Diffusion Models with Transformers", section 3.2 (adaLN-Zero); conditioned on binary occupancy of boxes as in
//! "Scalable and Generalizable Autonomous Driving Scene Synthesis", section 3.2. There is no camera in here: what it makes is decoded for any rig.
//! Parity: `tests/it/official.rs`. Shapes: B batch, C latent channels, H W latent cells, N tokens, D width, K classes, Z height slices.

mod block;
mod condition;
mod config;
mod embedding;
mod model;
pub mod official;

pub use block::DitBlock;
pub use condition::{LabelEmbedding, LayoutEmbedding};
pub use config::{ConditionConfig, ConfigError, DitConfig, OutputConfig, Preset};
pub use embedding::{TimestepEmbedding, position_code, timestep_code};
pub use model::{Condition, Dit};
