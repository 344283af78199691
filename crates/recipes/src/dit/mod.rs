//! The second stage: a diffusion transformer over latents of BEV-VAE, steered by a layout of boxes.

mod conditioner;
mod evaluate;
mod experiment;
mod loaded;
mod locality;
mod noising;
mod opening;
mod preview;
mod sample;
mod settings;
mod source;
mod step;
mod task;

pub use conditioner::Conditioner;
pub use evaluate::{DitEvaluator, DitScores, GeneratedScores};
pub use experiment::DitExperiment;
pub use loaded::LoadedDit;
pub use locality::EditScores;
pub(crate) use opening::Latents;
pub use sample::{Guidance, NoiseKey};
pub use settings::{
    ClassTable, ConditionSettings, DitEvaluation, DitSampling, DitSizes, DitWidths, FlowNoise, LatentSettings,
    LatentSource, NoiseProcess, PreviewSettings, ScheduledNoise, StoredLatents, TreeLatents,
};
pub use source::{HeldOut, LatentBatch, LatentItem, TrainingData};
pub use task::{DitMeasured, DitTask};
