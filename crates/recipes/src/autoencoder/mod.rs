//! AutoencoderKL on single pictures, stage 1 of latent diffusion: the experiment, its training step and its evaluation.

mod evaluate;
mod experiment;
mod step;
mod task;

pub use evaluate::PictureEvaluator;
pub(crate) use experiment::check_size;
pub use experiment::{AutoencoderEvaluation, AutoencoderExperiment};
pub use task::AutoencoderTask;
