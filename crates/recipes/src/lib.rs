//! One file per experiment kind: batch → losses → step; sampling, evaluation, export.
//!
//! This is the only crate that knows data, models and the training loop at once. The binaries beside it are thin.

pub mod bev_vae;
pub mod commands;
pub mod config_file;
pub mod evaluate;
mod model_choice;
pub mod sheet;
pub mod show;
pub mod tensors;

pub use model_choice::ModelChoice;
