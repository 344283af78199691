//! The experiment file of `train-autoencoder`.

use data::{ImageSize, LoaderConfig};
use serde::{Deserialize, Serialize};
use train::{DeviceConfig, EmaConfig, TrainConfig};

use crate::bev_vae::{DataConfig, LossConfig, Optimizers, RunConfig};
use crate::{AutoencoderSizes, Choice};

/// Everything a run of `train-autoencoder` depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AutoencoderExperiment {
    /// Seed of everything random.
    pub seed: u64,
    /// Where to compute.
    #[serde(default)]
    pub device: DeviceConfig,
    /// Random views of each micro batch that a step looks at; 0 for all.
    #[serde(default)]
    pub views: usize,
    /// Where results go.
    pub run: RunConfig,
    /// Sizes of the network.
    pub model: Choice<AutoencoderSizes>,
    /// Picture size; multiples of the network's factor.
    pub image: ImageSize,
    /// What is learned from.
    pub data: DataConfig,
    /// Weights of the losses.
    #[serde(default)]
    pub loss: LossConfig,
    /// AdamW of autoencoder and discriminator.
    #[serde(default)]
    pub optimizer: Optimizers,
    /// Averaged weights, used for everything but training.
    #[serde(default)]
    pub ema: EmaConfig,
    /// Length and rhythm.
    #[serde(default)]
    pub train: TrainConfig,
    /// What is measured on held-out data.
    #[serde(default)]
    pub evaluation: AutoencoderEvaluation,
}

/// What is measured, always with averaged weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AutoencoderEvaluation {
    /// Frames of each validation dataset, spread evenly, in validations during training.
    pub frames: usize,
    /// The same at the end of the run; 0 for all.
    pub final_frames: usize,
    /// Training frames of each dataset that the mean pictures and the scale of the latents are measured on.
    pub baseline_frames: usize,
}

impl Default for AutoencoderEvaluation {
    fn default() -> Self {
        Self { frames: 8, final_frames: 32, baseline_frames: 64 }
    }
}

impl AutoencoderExperiment {
    /// Pictures at network size, and the run's seed for shuffling.
    pub fn loader_config(&self) -> LoaderConfig {
        LoaderConfig { size: self.image, seed: self.seed, ..self.data.loader.clone() }
    }

    /// Refuses pictures that the network cannot halve.
    ///
    /// # Errors
    /// Names the size.
    pub fn checked(self) -> anyhow::Result<Self> {
        check_size(self.image, self.model.config.factor())?;
        Ok(self)
    }
}

/// Refuses pictures that an autoencoder of this factor cannot halve.
pub(crate) fn check_size(image: ImageSize, factor: usize) -> anyhow::Result<()> {
    let fits = |side: u32| side > 0 && (side as usize).is_multiple_of(factor);
    anyhow::ensure!(
        fits(image.height) && fits(image.width),
        "image: {}x{} pixels must be multiples of {factor}, the factor of the autoencoder",
        image.width,
        image.height
    );
    Ok(())
}
