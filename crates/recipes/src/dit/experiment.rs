//! The experiment file of `train-dit`.

use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use data::{AugmentConfig, LoaderConfig};
use diffusion::{Ddim, DpmSolver, FinalLevel, FlowEuler, SamplerConfig, Spacing};
use serde::{Deserialize, Serialize};
use train::{DeviceConfig, EmaConfig, OptimizerConfig, Schedule, TrainConfig};

use super::noising::Noising;
use super::settings::{
    ConditionSettings, DitEvaluation, DitSampling, DitSizes, LatentSettings, LatentSource, NoiseProcess,
    PreviewSettings,
};
use crate::Choice;
use crate::bev_vae::{DataConfig, RunConfig};

/// Everything a run of `train-dit` depends on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DitExperiment {
    /// Seed of everything random.
    pub seed: u64,
    /// Where to compute.
    #[serde(default)]
    pub device: DeviceConfig,
    /// Run folder or checkpoint of the frozen BEV-VAE.
    pub autoencoder: PathBuf,
    /// Where results go.
    pub run: RunConfig,
    /// Depth and widths; latent, grid and classes follow from the autoencoder and `condition`.
    pub model: Choice<DitSizes>,
    /// Where latents come from.
    #[serde(default)]
    pub latents: LatentSettings,
    /// Annotated datasets; not needed where `latents` are stored already.
    #[serde(default)]
    pub data: DataConfig,
    /// What steers the samples.
    #[serde(default)]
    pub condition: ConditionSettings,
    /// Noise and target.
    #[serde(default)]
    pub diffusion: NoiseProcess,
    /// AdamW; without the table the paper's.
    #[serde(default = "paper_optimizer")]
    pub optimizer: OptimizerConfig,
    /// Averaged weights, used for everything but training; without the table the paper's.
    #[serde(default = "paper_ema")]
    pub ema: EmaConfig,
    /// Length and rhythm.
    #[serde(default)]
    pub train: TrainConfig,
    /// How scenes are made.
    #[serde(default)]
    pub sampling: DitSampling,
    /// What is shown during training.
    #[serde(default)]
    pub preview: PreviewSettings,
    /// What is measured on held-out data.
    #[serde(default)]
    pub evaluation: DitEvaluation,
}

/// Section 7 of the specification: AdamW with weight decay of matrices and 5,000 steps of warm-up.
fn paper_optimizer() -> OptimizerConfig {
    OptimizerConfig {
        learning_rate: 1e-4,
        betas: [0.9, 0.95],
        weight_decay: 0.1,
        schedule: Schedule { warmup_steps: 5000, ..Schedule::default() },
        ..OptimizerConfig::default()
    }
}

const fn paper_ema() -> EmaConfig {
    EmaConfig { decay: 0.999, warmup: false }
}

impl DitExperiment {
    /// Batches of the datasets; where pictures are encoded at every step, the caller sets their size.
    pub fn loader_config(&self) -> LoaderConfig {
        LoaderConfig { seed: self.seed, ..self.data.loader.clone() }
    }

    /// The sampler of data generation.
    pub fn sampler(&self) -> SamplerConfig {
        self.sampling.sampler.clone().unwrap_or_else(|| match self.diffusion {
            NoiseProcess::Schedule(_) => {
                let (spacing, last) = (Spacing::Leading { offset: 1 }, FinalLevel::Zero);
                SamplerConfig::Ddim(Ddim { steps: 50, eta: 0.0, spacing, last, clip: false })
            }
            NoiseProcess::RectifiedFlow(_) => SamplerConfig::FlowEuler(FlowEuler { steps: 50, shift: 1.0 }),
        })
    }

    /// The quick sampler of previews.
    pub fn preview_sampler(&self) -> SamplerConfig {
        let (steps, last) = (self.preview.steps, FinalLevel::Zero);
        match &self.diffusion {
            // No solver of higher order leaves pure noise.
            NoiseProcess::Schedule(noise) if noise.schedule.zero_terminal_snr => {
                SamplerConfig::Ddim(Ddim { steps, eta: 0.0, spacing: Spacing::Trailing, last, clip: false })
            }
            NoiseProcess::Schedule(_) => {
                SamplerConfig::DpmSolver(DpmSolver { steps, spacing: Spacing::Linspace, last })
            }
            NoiseProcess::RectifiedFlow(_) => SamplerConfig::FlowEuler(FlowEuler { steps, shift: 1.0 }),
        }
    }

    /// Refuses settings that do not go together.
    ///
    /// # Errors
    /// Names the setting.
    pub fn checked(self) -> anyhow::Result<Self> {
        let dropout = self.condition.dropout;
        ensure!((0.0..=1.0).contains(&dropout), "condition.dropout must lie in 0..=1, not {dropout}");
        ensure!(self.sampling.guidance.scale().is_finite(), "sampling.guidance must be a number");
        ensure!(self.latents.encode_batch > 0, "latents.encode_batch must be at least 1");
        ensure!(self.data.loader.batch_size > 0, "data.loader.batch_size must be at least 1");
        self.condition.classes.classes().check()?;
        self.check_samplers()?;
        self.check_augmentation()?;
        Ok(self)
    }

    fn check_samplers(&self) -> anyhow::Result<()> {
        self.check_sampler(&self.sampler()).context("in sampling.sampler")?;
        self.check_sampler(&self.preview_sampler()).context("in preview.steps")
    }

    /// Refuses a sampler that cannot run on this noise process.
    ///
    /// # Errors
    /// A sentence with the reason.
    pub fn check_sampler(&self, sampler: &SamplerConfig) -> anyhow::Result<()> {
        let noising = Noising::new(&self.diffusion)?;
        let is_flow = matches!(self.diffusion, NoiseProcess::RectifiedFlow(_));
        if matches!(sampler, SamplerConfig::FlowEuler(_)) != is_flow {
            bail!("flow_euler samples rectified flows, and only it does");
        }
        Ok(sampler.checked(noising.schedule(), noising.target())?)
    }

    /// Latents are not turned or mirrored: the autoencoder is not equivariant and rigs are not symmetric (trap 13). Colours may change
    /// where pictures are encoded at every step.
    fn check_augmentation(&self) -> anyhow::Result<()> {
        let asked = &self.data.loader.augment;
        let allowed = match self.latents.source {
            LatentSource::Online { .. } => AugmentConfig {
                color_jitter: asked.color_jitter,
                grayscale_probability: asked.grayscale_probability,
                drop_view_probability: asked.drop_view_probability,
                ..AugmentConfig::default()
            },
            LatentSource::Moments(_) | LatentSource::NpyTree(_) => AugmentConfig::default(),
        };
        ensure!(
            *asked == allowed,
            "data.loader.augment: latents are neither mirrored nor turned with their boxes; only the colours and views of an `online` \
             source may change"
        );
        Ok(())
    }
}
