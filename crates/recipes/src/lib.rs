//! One file per experiment kind: batch → losses → step; sampling, evaluation, export.
//!
//! This is the only crate that knows data, models and the training loop at once. The binaries beside it are thin.

mod adversary;
pub mod autoencoder;
pub mod bev_vae;
pub mod commands;
pub mod config_file;
pub mod dit;
pub mod evaluate;
pub mod latent_diffusion;
pub mod latents;
mod loader_source;
mod model_choice;
mod reconstruction;
pub mod rigs;
pub mod sheet;
pub mod show;
pub mod synthesis;
pub mod tensors;
mod trainer;

pub use loader_source::LoaderSource;
pub use model_choice::{AutoencoderSizes, Choice, ModelChoice, Sizes, UNetSizes, differences};
