//! Held-out measurements of the UNet, and sheets of samples.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use burn::tensor::{Device, Tensor};
use data::{PadViews, Sample, SampleOptions, SceneBatch, SceneDataset, assemble};
use serde::Serialize;

use super::sample::Sampler;
use super::step::Frozen;
use super::{Denoiser, SamplingConfig};
use crate::bev_vae::{pictures_of, spread};
use crate::sheet::Sheet;

/// Timesteps at which the error is measured, as parts of the schedule.
const PARTS: usize = 4;

/// Mean squared error of the network's answer over held-out views and timesteps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DiffusionScores {
    /// Of the model, each scene with its own caption.
    pub loss: f64,
    /// With the caption of another scene.
    pub loss_other_caption: f64,
    /// With no caption.
    pub loss_no_caption: f64,
    /// Of an answer that is 0 everywhere.
    pub loss_of_zero: f64,
    /// Frames measured.
    pub frames: usize,
}

/// Held-out datasets.
pub struct DiffusionEvaluator {
    datasets: Vec<Arc<dyn SceneDataset>>,
    options: SampleOptions,
    seed: u64,
    device: Device,
}

impl DiffusionEvaluator {
    /// `device` is the one without a tape.
    pub fn new(datasets: Vec<Arc<dyn SceneDataset>>, options: SampleOptions, seed: u64, device: &Device) -> Self {
        Self { datasets, options, seed, device: device.clone() }
    }

    /// Errors on `frames` frames of each held-out dataset (0 for all), always with the same noise.
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn scores(&self, frozen: &Frozen, denoiser: &Denoiser, frames: usize) -> anyhow::Result<DiffusionScores> {
        let (mut sums, mut measured, mut previous) = ([0.0; 4], 0, String::new());
        if let Some((dataset, index)) = self.chosen(frames).pop() {
            previous = self.datasets[dataset].frame(index)?.scene_text.unwrap_or_default();
        }
        for (dataset, index) in self.chosen(frames) {
            let batch = self.batch(dataset, index)?;
            // One part of the schedule per frame, so that all are visited.
            let part = (2 * (measured % PARTS) + 1) * frozen.schedule.len() / (2 * PARTS);
            let mut rng = train::stream(self.seed, "validation", measured as u64);
            let mut problem = frozen.problem(&batch, &[part], &mut rng)?;
            let zero = Tensor::zeros(problem.noisy.dims(), &self.device);
            let own = problem.captions.first().cloned().unwrap_or_default();
            let captions = [own.clone(), std::mem::replace(&mut previous, own), String::new()];
            for (sum, caption) in sums.iter_mut().zip(captions) {
                problem.captions = vec![caption];
                *sum += number(frozen.loss(frozen.answer(denoiser, &problem)?, &problem));
            }
            sums[3] += number(frozen.loss(zero, &problem));
            measured += 1;
        }
        anyhow::ensure!(measured > 0, "there is no held-out frame to measure");
        let [loss, loss_other_caption, loss_no_caption, loss_of_zero] = sums.map(|sum| sum / measured as f64);
        Ok(DiffusionScores { loss, loss_other_caption, loss_no_caption, loss_of_zero, frames: measured })
    }

    /// A sheet of held-out frames: the true pictures over those painted from the same caption. Returns the captions in order.
    ///
    /// # Errors
    /// Whatever a frame's pictures report, or the file.
    pub fn pictures(
        &self,
        frozen: &Frozen,
        denoiser: &Denoiser,
        config: &SamplingConfig,
        path: &Path,
    ) -> anyhow::Result<Vec<String>> {
        let size = self.options.size;
        let mut sheet = Sheet::new(size.height as usize, size.width as usize);
        let mut captions = Vec::new();
        for (number, (dataset, index)) in self.chosen(config.frames.max(1)).into_iter().enumerate() {
            let batch = self.batch(dataset, index)?;
            let caption = batch.texts.first().cloned().flatten().unwrap_or_default();
            let sampler = Sampler { frozen, denoiser, config, device: &self.device };
            let mut rng = train::stream(self.seed, "samples", number as u64);
            sheet.row(pictures_of(&batch.target));
            sheet.row(sampler.paint(&caption, &batch, &mut rng)?.iter().map(Vec::as_slice));
            sheet.space();
            captions.push(caption);
        }
        sheet.save(path)?;
        Ok(captions)
    }

    /// Dataset and frame of the chosen frames.
    fn chosen(&self, frames: usize) -> Vec<(usize, usize)> {
        let of = |(number, dataset): (usize, &Arc<dyn SceneDataset>)| {
            spread(dataset.len(), frames).into_iter().map(move |index| (number, index)).collect::<Vec<_>>()
        };
        self.datasets.iter().enumerate().flat_map(of).collect()
    }

    fn batch(&self, dataset: usize, index: usize) -> anyhow::Result<SceneBatch> {
        let frame = self.datasets[dataset].frame(index)?;
        let sample = Sample::load(&frame, &self.options).context("loading a held-out frame")?;
        Ok(assemble(vec![sample], PadViews::Largest)?)
    }
}

fn number(value: Tensor<1>) -> f64 {
    value.into_data().iter::<f64>().next().unwrap_or(f64::NAN)
}
