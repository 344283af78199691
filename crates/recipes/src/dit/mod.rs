//! The second stage: a diffusion transformer over latents of BEV-VAE, steered by a layout of boxes.

mod conditioner;
mod evaluate;
mod experiment;
mod loaded;
mod locality;
mod noising;
mod preview;
mod sample;
mod source;
mod step;
mod task;

pub use conditioner::Conditioner;
pub use evaluate::{DitEvaluator, DitScores, GeneratedScores};
pub use experiment::{
    ClassTable, ConditionSettings, DitEvaluation, DitExperiment, DitSampling, DitSizes, DitWidths, FlowNoise,
    LatentSettings, LatentSource, NoiseProcess, PreviewSettings, ScheduledNoise, StoredLatents, TreeLatents,
};
pub use loaded::LoadedDit;
pub use locality::EditScores;
pub use sample::{Guidance, NoiseKey};
pub use source::{HeldOut, LatentBatch, LatentItem, TrainingData};
pub use task::{DitMeasured, DitTask};
