//! BEV-VAE, stage 1: the experiment, its training step and its evaluation.

mod baseline;
mod budget;
mod evaluate;
mod experiment;
mod losses;
mod machine;
mod step;
mod task;
mod viewer;

pub use baseline::MeanPictures;
pub(crate) use baseline::{renders, spread};
pub use budget::{Budget, Walk, refusal};
pub(crate) use evaluate::Contest;
pub use evaluate::{Evaluation, Evaluator, Scores};
pub use experiment::{
    Adversarial, DataConfig, EvaluationConfig, Experiment, HingeConfig, LecamConfig, LossConfig, Optimizers,
    PerceptualConfig, Regulariser, RunConfig, SlopeConfig,
};
pub use losses::{Perceptual, PixelRange};
pub use machine::{duration, free_memory, operations_per_second};
pub use task::BevVaeTask;
pub use viewer::{Coded, PresentView, Viewer, pictures_of};
