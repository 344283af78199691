//! Caption-conditioned latent diffusion of single views and of whole rigs, stage 2: the experiment, its step, and sampling.

mod evaluate;
mod experiment;
mod export;
mod latents;
mod neighbours;
mod painter;
mod sample;
mod start;
mod step;
mod task;
mod text;

pub use evaluate::{DiffusionEvaluator, DiffusionScores};
pub use experiment::{DiffusionConfig, DiffusionEvaluation, SamplingConfig, UNetExperiment};
pub use export::save_pipeline;
pub use latents::LatentCoder;
pub use neighbours::Neighbours;
pub use painter::Painter;
pub use task::UNetTask;
pub use text::{Captioner, Denoiser, TextConfig};
