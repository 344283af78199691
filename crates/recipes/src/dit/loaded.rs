//! A trained transformer out of a checkpoint.

use std::path::Path;

use anyhow::{Context, ensure};
use burn::tensor::{Device, Tensor};
use data::latents::LatentStatistics;
use data::layout::{Layout, LayoutClasses};
use diffusion::SamplerConfig;
use dit::{Dit, DitConfig};
use nn::Init;
use train::{CheckpointReader, DeviceConfig, find_checkpoint};

use super::noising::Noising;
use super::sample::{LatentSampler, Scaling};
use super::{Conditioner, DitExperiment, Guidance, NoiseKey};
use crate::config_file;
use crate::latents::FrozenVae;

/// Averaged weights, no tape, with everything that makes their samples decodable.
#[derive(Debug)]
pub struct LoadedDit {
    /// The experiment as it was resolved.
    pub experiment: DitExperiment,
    /// The network.
    pub network: Dit,
    /// Classes, grid and rule of layouts.
    pub conditioner: Conditioner,
    /// Of the latents it was trained on; `vae_hash` names the autoencoder.
    pub statistics: LatentStatistics,
    /// Where it computes.
    pub device: Device,
    /// Steps it was trained for.
    pub step: u64,
    noising: Noising,
    scaling: Scaling,
}

/// What a checkpoint of the transformer carries beside weights and config.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Carried {
    pub statistics: LatentStatistics,
    pub classes: LayoutClasses,
    pub network: DitConfig,
}

impl Carried {
    pub fn read(reader: &CheckpointReader) -> anyhow::Result<Self> {
        let statistics: LatentStatistics = reader.value("latent_statistics")?;
        let statistics = statistics.checked().map_err(|why| {
            anyhow::anyhow!("latent statistics: {why}; the checkpoint is damaged: {}", reader.folder().display())
        })?;
        let network: DitConfig = reader.value("network")?;
        Ok(Self { statistics, classes: reader.value("classes")?, network: network.checked()? })
    }

    pub fn write(&self, writer: &mut train::CheckpointWriter) -> Result<(), train::TrainError> {
        writer.value("latent_statistics", &self.statistics)?;
        writer.value("classes", &self.classes)?;
        writer.value("network", &self.network)
    }

    /// Refuses a checkpoint of other latents or classes, naming what differs.
    pub fn check_same(&self, stored: &Self) -> anyhow::Result<()> {
        let (ours, theirs) = (&self.classes.names, &stored.classes.names);
        ensure!(ours == theirs, "the checkpoint was trained with the classes {theirs:?}, the config asks for {ours:?}");
        self.statistics
            .check_origin(&stored.statistics.vae_hash, &stored.statistics.grid)
            .map_err(anyhow::Error::msg)?;
        ensure!(
            self.statistics == stored.statistics,
            "the statistics of the latents differ from those of the checkpoint; the latents were made again or from other frames"
        );
        ensure!(self.network == stored.network, "the checkpoint's network has other sizes: {:?}", stored.network);
        Ok(())
    }
}

impl LoadedDit {
    /// Opens a checkpoint folder, or the newest checkpoint of a run folder.
    ///
    /// # Errors
    /// Names the folder or file that is missing, damaged, or of another kind of run.
    pub fn open(path: &Path, device: Option<DeviceConfig>) -> anyhow::Result<Self> {
        let reader = find_checkpoint(path)?;
        let folder = reader.folder().display().to_string();
        let experiment: DitExperiment = config_file::parse(&reader.config_text("model")?, &[])
            .with_context(|| format!("in the config that the checkpoint carries, is it one of train-dit? {folder}"))?;
        let carried = Carried::read(&reader)?;
        let device = device.unwrap_or(experiment.device).open()?;
        let network = Dit::new(&carried.network, &mut Init::new(0, &device));
        let network = reader.module("ema", network)?;
        let step = reader.state().step;
        tracing::info!(step, checkpoint = folder, "averaged weights loaded");
        Ok(Self {
            conditioner: Conditioner {
                classes: carried.classes,
                grid: carried.statistics.grid,
                rule: experiment.condition.rasterise,
            },
            noising: Noising::new(&experiment.diffusion)?,
            scaling: Scaling::new(&carried.statistics, experiment.latents.scale, &device),
            statistics: carried.statistics,
            experiment,
            network,
            device,
            step,
        })
    }

    /// The autoencoder whose latents it makes, from `path` or from where it was during training.
    ///
    /// # Errors
    /// Another autoencoder than the one it was trained on; a missing or damaged checkpoint.
    pub fn autoencoder(&self, path: Option<&Path>) -> anyhow::Result<FrozenVae> {
        let path = path.unwrap_or(&self.experiment.autoencoder);
        let vae = FrozenVae::open(path, &self.device)?;
        self.statistics
            .check_origin(vae.hash(), vae.grid())
            .map_err(|why| anyhow::anyhow!("{why}: {}", path.display()))?;
        Ok(vae)
    }

    /// Latents of layouts, ready for the decoder. A sample depends on its own layout and key only.
    ///
    /// # Shapes
    /// - layouts, keys: B
    /// - output: `[B, C, h, w]`
    ///
    /// # Errors
    /// A layout that cannot be rasterised, naming the box; a sampler that does not fit the noise process.
    pub fn sample(
        &self,
        layouts: &[Layout],
        keys: &[NoiseKey],
        sampler: &SamplerConfig,
        guidance: Guidance,
    ) -> anyhow::Result<Tensor<4>> {
        self.experiment.check_sampler(sampler)?;
        let layouts: Vec<&Layout> = layouts.iter().collect();
        self.sampler().sample(&layouts, keys, sampler, guidance)
    }

    fn sampler(&self) -> LatentSampler<'_> {
        LatentSampler {
            network: &self.network,
            noising: &self.noising,
            conditioner: &self.conditioner,
            scaling: &self.scaling,
            device: &self.device,
        }
    }
}
