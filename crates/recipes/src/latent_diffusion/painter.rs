//! A trained model out of a checkpoint, for pictures of any caption.

use std::path::Path;

use anyhow::Context;
use burn::tensor::Device;
use data::SceneBatch;
use train::{DeviceConfig, find_checkpoint};

use super::sample::Sampler;
use super::start::{first_weights, learning};
use super::step::Frozen;
use super::{Denoiser, UNetExperiment};
use crate::config_file;

/// Averaged weights with everything frozen around them.
pub struct Painter {
    /// The experiment as it was resolved.
    pub experiment: UNetExperiment,
    frozen: Frozen,
    denoiser: Denoiser,
    device: Device,
}

impl Painter {
    /// Opens a checkpoint folder, or the newest checkpoint of a run folder.
    ///
    /// # Errors
    /// Names the folder or file that is missing or damaged.
    pub fn open(path: &Path, device: Option<DeviceConfig>) -> anyhow::Result<Self> {
        let reader = find_checkpoint(path)?;
        let experiment: UNetExperiment = config_file::parse(&reader.config_text("model")?, &[])
            .with_context(|| format!("in the config that the checkpoint carries: {}", reader.folder().display()))?;
        let device = device.unwrap_or(experiment.device).open()?;
        let frozen = Frozen::open(&experiment, &device)?;
        let adapted = experiment.adapter.is_some();
        // What the checkpoint holds whole needs no start.
        let start =
            UNetExperiment { init_from: experiment.init_from.clone().filter(|_| adapted), ..experiment.clone() };
        let denoiser = first_weights(&start, &frozen.captioner, &device)?;
        let denoiser = reader.module_part("ema", denoiser, learning(&experiment))?;
        Ok(Self { experiment, frozen, denoiser, device })
    }

    /// RGB in [0, 1] for the cameras of a batch of one rig, one `[3, H, W]` per view.
    ///
    /// # Errors
    /// Unusable camera matrices.
    pub fn paint(&self, caption: &str, batch: &SceneBatch, seed: u64) -> anyhow::Result<Vec<Vec<f32>>> {
        let config = &self.experiment.sampling;
        let sampler = Sampler { frozen: &self.frozen, denoiser: &self.denoiser, config, device: &self.device };
        sampler.paint(caption, batch, &mut train::stream(seed, "samples", 0))
    }
}
