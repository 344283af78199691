//! BEV-VAE, stage 1: the experiment, its training step and its evaluation.

mod baseline;
mod evaluate;
mod experiment;
mod losses;
mod step;
mod task;
mod viewer;

pub use baseline::MeanPictures;
pub(crate) use baseline::spread;
pub(crate) use evaluate::Contest;
pub use evaluate::{Evaluation, Evaluator, Scores};
pub use experiment::{
    Adversarial, DataConfig, EvaluationConfig, Experiment, HingeConfig, LossConfig, Optimizers, PerceptualConfig,
    RunConfig,
};
pub use losses::{Perceptual, PixelRange};
pub use task::BevVaeTask;
pub use viewer::{Coded, PresentView, Viewer, pictures_of};
