//! The experiment file of `train-unet`.

use std::path::PathBuf;

use anyhow::ensure;
use data::{ImageSize, LoaderConfig};
use diffusion::{Ddim, FinalLevel, LossWeight, NoiseSchedule, SamplerConfig, ScheduleConfig, Spacing, Target};
use nn::lora::LoraConfig;
use serde::{Deserialize, Serialize};
use stable_diffusion::Panels;
use train::{DeviceConfig, EmaConfig, OptimizerConfig, TrainConfig};

use super::TextConfig;
use crate::bev_vae::{DataConfig, RunConfig};
use crate::{Choice, UNetSizes};

/// Everything a run of `train-unet` depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UNetExperiment {
    /// Seed of everything random.
    pub seed: u64,
    /// Where to compute.
    #[serde(default)]
    pub device: DeviceConfig,
    /// Folder of the frozen autoencoder (`config.json` and weights), such as the `vae` folder of a run of `train-autoencoder`.
    pub autoencoder: PathBuf,
    /// Where results go.
    pub run: RunConfig,
    /// Sizes of the UNet. With `encoder.cross_view` or joined panels the views of a rig are made together, else each alone.
    pub model: Choice<UNetSizes>,
    /// Weights to start from instead of fresh ones: a run or checkpoint folder of `train-unet` (its averaged weights), or a folder in
    /// diffusers' layout that holds `unet`. Optimizer and step count start anew.
    #[serde(default)]
    pub init_from: Option<PathBuf>,
    /// Train low-rank adapters beside the weights of `init_from`, which stay as they are.
    #[serde(default)]
    pub adapter: Option<LoraConfig>,
    /// Differentiate the UNet block by block, each computed twice: the memory of one block instead of all, about a quarter more time.
    #[serde(default)]
    pub checkpointing: bool,
    /// What reads captions.
    #[serde(default)]
    pub text: TextConfig,
    /// Picture size; multiples of the autoencoder's factor.
    pub image: ImageSize,
    /// What is learned from.
    pub data: DataConfig,
    /// Noise and target.
    #[serde(default)]
    pub diffusion: DiffusionConfig,
    /// AdamW.
    #[serde(default)]
    pub optimizer: OptimizerConfig,
    /// Averaged weights, used for everything but training.
    #[serde(default)]
    pub ema: EmaConfig,
    /// Length and rhythm.
    #[serde(default)]
    pub train: TrainConfig,
    /// How pictures are made.
    #[serde(default)]
    pub sampling: SamplingConfig,
    /// What is measured on held-out data.
    #[serde(default)]
    pub evaluation: DiffusionEvaluation,
}

/// Noise and target.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiffusionConfig {
    /// How much noise each timestep holds.
    pub schedule: ScheduleConfig,
    /// What the network predicts.
    pub target: Target,
    /// Weight of timesteps.
    pub weight: LossWeight,
    /// Share of captions that are left out in training, for guidance.
    pub caption_dropout: f64,
}

impl Default for DiffusionConfig {
    fn default() -> Self {
        Self {
            schedule: ScheduleConfig::STABLE_DIFFUSION,
            target: Target::Noise,
            weight: LossWeight::Uniform,
            caption_dropout: 0.1,
        }
    }
}

/// How pictures are made.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SamplingConfig {
    /// From noise to latents.
    pub sampler: SamplerConfig,
    /// Guidance by the caption; 1 for none.
    pub guidance: f64,
    /// Held-out frames of each dataset whose captions are painted.
    pub frames: usize,
}

impl Default for SamplingConfig {
    fn default() -> Self {
        let (spacing, last) = (Spacing::Leading { offset: 1 }, FinalLevel::default());
        let sampler = SamplerConfig::Ddim(Ddim { steps: 25, eta: 0.0, spacing, last, clip: false });
        Self { sampler, guidance: 3.0, frames: 2 }
    }
}

/// What is measured, always with averaged weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DiffusionEvaluation {
    /// Frames of each validation dataset, spread evenly, in validations during training.
    pub frames: usize,
    /// The same at the end of the run; 0 for all.
    pub final_frames: usize,
}

impl Default for DiffusionEvaluation {
    fn default() -> Self {
        Self { frames: 8, final_frames: 32 }
    }
}

impl UNetExperiment {
    /// Pictures at network size, and the run's seed for shuffling.
    pub fn loader_config(&self) -> LoaderConfig {
        LoaderConfig { size: self.image, seed: self.seed, ..self.data.loader.clone() }
    }

    /// Refuses settings that do not go together.
    ///
    /// # Errors
    /// Names the setting.
    pub fn checked(self) -> anyhow::Result<Self> {
        let schedule = NoiseSchedule::new(&self.diffusion.schedule)?;
        ensure!(
            !matches!(self.sampling.sampler, SamplerConfig::FlowEuler(_)),
            "sampling.sampler: flow_euler samples rectified flows, and train-unet trains on a noise schedule"
        );
        self.sampling.sampler.checked(&schedule, self.diffusion.target)?;
        ensure!(
            self.adapter.is_none() || self.init_from.is_some(),
            "[adapter] learns beside trained weights: init_from must name them"
        );
        let dropout = self.diffusion.caption_dropout;
        ensure!((0.0..=1.0).contains(&dropout), "diffusion.caption_dropout must lie in 0..=1, not {dropout}");
        ensure!(self.sampling.guidance.is_finite(), "sampling.guidance must be a number");
        ensure!(
            self.model.config.encoder.panels == Panels::PerView,
            "model.encoder.panels: train-unet convolves each view alone; joined panoramas need rigs of equal pictures side by side"
        );
        Ok(self)
    }
}
