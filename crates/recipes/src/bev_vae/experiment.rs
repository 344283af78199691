//! The experiment file of `train-vae`.

use std::path::PathBuf;

use anyhow::bail;
use data::{DatasetConfig, LoaderConfig, MixtureConfig};
use features::Tap;
use serde::{Deserialize, Serialize};
use train::{DeviceConfig, EmaConfig, OptimizerConfig, TrainConfig};

use crate::ModelChoice;

/// Everything a run of `train-vae` depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Experiment {
    /// Seed of everything random.
    pub seed: u64,
    /// Where to compute.
    #[serde(default)]
    pub device: DeviceConfig,
    /// Run or checkpoint folder whose averaged weights the network starts from; fresh weights without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub init_from: Option<PathBuf>,
    /// Computes every block again on the way back instead of keeping what it computed: half the memory, about a fifth more time.
    #[serde(default)]
    pub checkpointing: bool,
    /// Where results go.
    pub run: RunConfig,
    /// Sizes of the network.
    pub model: ModelChoice,
    /// What is learned from.
    pub data: DataConfig,
    /// Weights of the losses.
    #[serde(default)]
    pub loss: LossConfig,
    /// AdamW of generator and discriminator.
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
    pub evaluation: EvaluationConfig,
}

/// The run's folder is `<root>/<name>`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunConfig {
    /// Folder name.
    pub name: String,
    /// Folder of all runs.
    #[serde(default = "runs")]
    pub root: PathBuf,
}

fn runs() -> PathBuf {
    PathBuf::from("runs")
}

/// Datasets and how they are mixed.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DataConfig {
    /// Training datasets; their rigs may differ.
    #[serde(default)]
    pub train: Vec<DatasetConfig>,
    /// Held-out datasets.
    #[serde(default)]
    pub validation: Vec<DatasetConfig>,
    /// Weights and order of the training datasets.
    #[serde(default)]
    pub mixture: MixtureConfig,
    /// Batches.
    #[serde(default)]
    pub loader: LoaderConfig,
}

/// Losses of section 5 of the BEV-VAE specification.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// β of the KL term.
    pub kl_weight: f64,
    /// VGG-16 features.
    pub perceptual: PerceptualConfig,
    /// Discriminator.
    pub adversarial: Adversarial,
}

impl Default for LossConfig {
    fn default() -> Self {
        Self { kl_weight: 1e-6, perceptual: PerceptualConfig::default(), adversarial: Adversarial::default() }
    }
}

/// The perceptual term; off until `weights` names a VGG-16 file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PerceptualConfig {
    /// Convolutions of VGG-16 in torchvision's or Oxford's layout, safetensors or `.pth`.
    pub weights: Option<PathBuf>,
    /// Linear heads of LPIPS 0.1 (`lpips_linear_heads_v0.1.safetensors`, or the release's file for VGG). With them the term is LPIPS,
    /// which needs torchvision's kernels; without, the mean squared difference of features.
    pub heads: Option<PathBuf>,
    /// Factor on the term.
    pub weight: f64,
    /// Deepest tap.
    pub last: Tap,
    /// Random views per step that it looks at; 0 for all.
    pub views: usize,
}

impl Default for PerceptualConfig {
    fn default() -> Self {
        Self { weights: None, heads: None, weight: 1.0, last: Tap::Relu5_3, views: 0 }
    }
}

/// The adversarial term.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Adversarial {
    /// No discriminator.
    Off,
    /// Hinge GAN with adaptive weight.
    Hinge(HingeConfig),
}

impl Default for Adversarial {
    fn default() -> Self {
        Self::Hinge(HingeConfig::default())
    }
}

/// Settings of the hinge GAN.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HingeConfig {
    /// Factor on λ·L_A.
    pub weight: f64,
    /// Share of the run after which the discriminator learns.
    pub discriminator_start: f64,
    /// Share of the run after which it also teaches the generator.
    pub generator_start: f64,
    /// Random views per step that it looks at; 0 for all.
    pub views: usize,
    /// Channels at full resolution; 0 for the preset's.
    pub channels: usize,
    /// What keeps it smooth.
    pub regulariser: Regulariser,
}

/// What keeps the discriminator smooth (section 5.2 of the specification).
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Regulariser {
    /// Nothing.
    #[default]
    None,
    /// Small slopes at real pictures: R1 without a second derivative.
    R1FiniteDifference(SlopeConfig),
    /// Scores near the running means of the other side.
    Lecam(LecamConfig),
}

/// Settings of the substitute for R1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SlopeConfig {
    /// γ: the term is γ/2 times the mean squared slope.
    pub gamma: f64,
    /// Half the distance of the two looks, network values.
    pub epsilon: f64,
    /// Taken in every so many steps, as many times stronger.
    pub every: u64,
}

impl Default for SlopeConfig {
    fn default() -> Self {
        Self { gamma: 10.0, epsilon: 0.01, every: 16 }
    }
}

/// Settings of LeCam.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LecamConfig {
    /// Factor on the term.
    pub weight: f64,
    /// Share of the old mean in each step.
    pub decay: f64,
}

impl Default for LecamConfig {
    fn default() -> Self {
        Self { weight: 1e-3, decay: 0.99 }
    }
}

impl HingeConfig {
    /// Refuses numbers without a meaning.
    ///
    /// # Errors
    /// Names the setting.
    pub fn checked(&self) -> anyhow::Result<&Self> {
        let shares = [("discriminator_start", self.discriminator_start), ("generator_start", self.generator_start)];
        if let Some((name, value)) = shares.into_iter().find(|(_, share)| !(share.is_finite() && *share >= 0.0)) {
            bail!("loss.adversarial.hinge.{name} = {value}: needs a share of the run from 0");
        }
        if self.generator_start < self.discriminator_start {
            bail!(
                "loss.adversarial.hinge.generator_start = {} lies before discriminator_start = {}: a discriminator that has not learned \
                 cannot teach",
                self.generator_start,
                self.discriminator_start
            );
        }
        match self.regulariser {
            Regulariser::R1FiniteDifference(SlopeConfig { epsilon, every, .. })
                if every == 0 || epsilon.is_nan() || epsilon <= 0.0 =>
            {
                bail!("loss.adversarial.hinge.regulariser: every ({every}) and epsilon ({epsilon}) must be above 0")
            }
            Regulariser::Lecam(LecamConfig { decay, .. }) if !(0.0..1.0).contains(&decay) => {
                bail!("loss.adversarial.hinge.regulariser.lecam.decay = {decay}: needs a share from 0 to below 1")
            }
            _ => Ok(self),
        }
    }
}

impl Default for HingeConfig {
    fn default() -> Self {
        Self {
            weight: 0.1,
            discriminator_start: 0.05,
            generator_start: 0.06,
            views: 0,
            channels: 0,
            regulariser: Regulariser::None,
        }
    }
}

/// One optimizer per network.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Optimizers {
    /// Encoder, bottleneck, decoder.
    pub generator: OptimizerConfig,
    /// Discriminator.
    pub discriminator: OptimizerConfig,
}

/// What is measured, always with averaged weights.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EvaluationConfig {
    /// Frames of each validation dataset, spread evenly, in validations during training.
    pub frames: usize,
    /// The same at the end of the run; 0 for all.
    pub final_frames: usize,
    /// Training frames of each dataset that the mean pictures are made of.
    pub baseline_frames: usize,
    /// Turns of the rig for novel views, degrees; only datasets that can render ground truth have any.
    pub yaw_deg: Vec<f64>,
}

impl Default for EvaluationConfig {
    fn default() -> Self {
        Self { frames: 8, final_frames: 32, baseline_frames: 64, yaw_deg: vec![-30.0, 30.0] }
    }
}

impl Experiment {
    /// Pictures at network size, and the run's seed for shuffling.
    pub fn loader_config(&self) -> LoaderConfig {
        LoaderConfig { size: self.image_size(), seed: self.seed, ..self.data.loader.clone() }
    }

    /// Network picture size.
    pub fn image_size(&self) -> data::ImageSize {
        let image = &self.model.config.image;
        data::ImageSize { height: image.height as u32, width: image.width as u32 }
    }
}
