//! ControlNet: a trainable copy of the UNet's encoder that steers it by a condition picture.

mod config;
mod embedding;
mod model;
mod residuals;

pub use config::ControlNetConfig;
pub use embedding::ConditionEmbedding;
pub use model::{ControlInputs, ControlNet};
pub use residuals::ControlResiduals;
