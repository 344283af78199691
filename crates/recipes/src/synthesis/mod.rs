//! Scenes from layouts: a transformer with its autoencoder, pictures of any rig out.

mod painter;
mod sweep;

use std::path::Path;

use burn::tensor::Tensor;
use data::PoseMode;
use data::export::Generator;
use data::layout::Layout;
use diffusion::{Ddim, Ddpm, DpmSolver, FinalLevel, FlowEuler, SamplerConfig, SolverVariant, Spacing, UniPc, Variance};
use geometry::CameraRig;
use image::RgbImage;
use train::{DeviceConfig, find_checkpoint, fingerprint};

use crate::dit::{Guidance, LoadedDit, NoiseKey};
use crate::latents::FrozenVae;
use crate::sheet::rgb_image;

pub use painter::{LayoutPainter, cameras_of, noise_key};
pub use sweep::{SweepPoint, SweepReport, sweep_guidance};

/// Samplers by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum SamplerName {
    /// Deterministic, 50 steps
    Ddim,
    /// Ancestral, 250 steps
    Ddpm,
    /// DPM-Solver++ 2M, 20 steps
    DpmSolver,
    /// UniPC, 20 steps
    Unipc,
    /// Euler's method, 50 steps; for rectified flows and only for them
    FlowEuler,
}

impl SamplerName {
    /// With this many steps, or the usual number.
    pub fn config(self, steps: Option<usize>) -> SamplerConfig {
        let (last, leading) = (FinalLevel::Zero, Spacing::Leading { offset: 1 });
        let steps_or = |usual| steps.unwrap_or(usual);
        match self {
            Self::Ddim => {
                SamplerConfig::Ddim(Ddim { steps: steps_or(50), eta: 0.0, spacing: leading, last, clip: false })
            }
            Self::Ddpm => {
                let (steps, variance) = (steps_or(250), Variance::FixedSmall);
                SamplerConfig::Ddpm(Ddpm { steps, spacing: leading, variance, clip: false })
            }
            Self::DpmSolver => {
                SamplerConfig::DpmSolver(DpmSolver { steps: steps_or(20), spacing: Spacing::Linspace, last })
            }
            Self::Unipc => {
                let (steps, variant, spacing) = (steps_or(20), SolverVariant::Bh2, Spacing::Linspace);
                SamplerConfig::UniPc(UniPc { steps, order: 2, variant, spacing, last })
            }
            Self::FlowEuler => SamplerConfig::FlowEuler(FlowEuler { steps: steps_or(50), shift: 1.0 }),
        }
    }
}

/// How a checkpoint is sampled, where it is not as the checkpoint says.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct SamplingArgs {
    /// From noise to latents [default: as the checkpoint says, usually ddim]
    #[arg(long, value_enum)]
    pub sampler: Option<SamplerName>,
    /// Network evaluations of a sample [default: as the checkpoint or the sampler says]
    #[arg(long, value_name = "N")]
    pub steps: Option<usize>,
    /// How strongly the layout steers: 0 ignores it, 1 is plain conditioning [default: as the checkpoint says]
    #[arg(long, value_name = "SCALE", value_parser = parse_scale)]
    pub guidance: Option<f64>,
}

fn parse_scale(text: &str) -> Result<f64, String> {
    let number = text.parse().ok().filter(|scale: &f64| scale.is_finite() && *scale >= 0.0);
    number.ok_or_else(|| "write a number from 0".to_owned())
}

/// Averaged weights of both stages and how they are sampled.
#[derive(Debug)]
pub struct Synthesiser {
    /// The transformer.
    pub dit: LoadedDit,
    /// Its autoencoder.
    pub vae: FrozenVae,
    /// From noise to latents.
    pub sampler: SamplerConfig,
    /// How strongly layouts steer.
    pub guidance: Guidance,
    checkpoint_sha256: String,
}

impl Synthesiser {
    /// Opens a checkpoint of `train-dit`, or the newest one of a run folder, and the autoencoder it was trained on, from `autoencoder` or
    /// from where it was during training.
    ///
    /// # Errors
    /// Names the folder or file that is missing, damaged or of another kind; a sampler that does not fit.
    pub fn open(
        checkpoint: &Path,
        autoencoder: Option<&Path>,
        sampling: &SamplingArgs,
        device: Option<DeviceConfig>,
    ) -> anyhow::Result<Self> {
        let dit = LoadedDit::open(checkpoint, device)?;
        let vae = dit.autoencoder(autoencoder)?;
        let (_, checkpoint_sha256) = fingerprint(&find_checkpoint(checkpoint)?.file("ema"))?;
        let stored = dit.experiment.sampler();
        let sampler = match (sampling.sampler, sampling.steps) {
            (Some(name), steps) => name.config(steps),
            (None, Some(steps)) => with_steps(stored, steps),
            (None, None) => stored,
        };
        dit.experiment.check_sampler(&sampler)?;
        let guidance = dit.experiment.sampling.guidance;
        let guidance = sampling.guidance.map_or(guidance, |scale| guidance.with_scale(scale));
        Ok(Self { dit, vae, sampler, guidance, checkpoint_sha256 })
    }

    /// Latents of layouts, one sample at a time in memory. A sample depends on its own layout and key only.
    ///
    /// # Errors
    /// A layout that cannot be rasterised, naming the box.
    pub fn latent(&self, layout: &Layout, key: &NoiseKey) -> anyhow::Result<Tensor<4>> {
        self.latent_guided(layout, key, self.guidance)
    }

    /// The same with another guidance.
    ///
    /// # Errors
    /// As [`Synthesiser::latent`].
    pub fn latent_guided(&self, layout: &Layout, key: &NoiseKey, guidance: Guidance) -> anyhow::Result<Tensor<4>> {
        self.dit.sample(std::slice::from_ref(layout), std::slice::from_ref(key), &self.sampler, guidance)
    }

    /// What the cameras of a rig see of one latent.
    ///
    /// # Errors
    /// Unusable calibration.
    pub fn pictures(&self, latent: Tensor<4>, rig: &CameraRig) -> anyhow::Result<Vec<RgbImage>> {
        let size = self.vae.image_size();
        let decoded = self.vae.decode(latent, &self.vae.cameras(rig)?);
        Ok(decoded.iter().map(|values| rgb_image(values, size.height, size.width)).collect())
    }

    /// Poses that the autoencoder was trained with.
    pub fn pose_mode(&self) -> PoseMode {
        self.vae.sample_options().pose_mode
    }

    /// For manifests.
    ///
    /// # Errors
    /// Settings that are no JSON.
    pub fn generator(&self, seed: u64, condition: String, edits: Vec<String>) -> anyhow::Result<Generator> {
        Ok(Generator {
            model: format!("BEV-VAE + DiT, step {}", self.dit.step),
            checkpoint_sha256: Some(self.checkpoint_sha256.clone()),
            seed,
            sampler: serde_json::to_string(&self.sampler)?,
            guidance: Some(self.guidance.scale()),
            condition,
            edits,
            config: serde_json::json!({
                "autoencoder_sha256": self.vae.hash(),
                "classes": self.dit.conditioner.classes.names,
                "guidance": self.guidance,
                "picture": self.vae.image_size(),
            }),
        })
    }
}

fn with_steps(mut sampler: SamplerConfig, steps: usize) -> SamplerConfig {
    let place = match &mut sampler {
        SamplerConfig::Ddpm(sampler) => &mut sampler.steps,
        SamplerConfig::Ddim(sampler) => &mut sampler.steps,
        SamplerConfig::UniPc(sampler) => &mut sampler.steps,
        SamplerConfig::DpmSolver(sampler) => &mut sampler.steps,
        SamplerConfig::Euler(sampler) => &mut sampler.steps,
        SamplerConfig::FlowEuler(sampler) => &mut sampler.steps,
    };
    *place = steps;
    sampler
}
