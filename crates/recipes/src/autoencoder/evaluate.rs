//! Held-out measurements of the autoencoder, and the scale of its latents.

use std::path::Path;
use std::sync::Arc;

use anyhow::Context;
use burn::tensor::{Device, Tensor};
use data::{ImageSize, PadViews, PoseMode, Sample, SampleOptions, SceneBatch, SceneDataset, assemble};
use stable_diffusion::AutoencoderKL;

use crate::bev_vae::{Contest, MeanPictures, Scores, pictures_of, spread};
use crate::sheet::Sheet;
use crate::tensors::{displayed_signed, pictures, signed};

/// Held-out datasets and the mean training pictures.
pub struct PictureEvaluator {
    datasets: Vec<Arc<dyn SceneDataset>>,
    means: MeanPictures,
    options: SampleOptions,
    device: Device,
}

impl PictureEvaluator {
    /// `device` is the one without a tape.
    pub fn new(
        datasets: Vec<Arc<dyn SceneDataset>>,
        means: MeanPictures,
        (size, pose_mode): (ImageSize, PoseMode),
        device: &Device,
    ) -> Self {
        Self { datasets, means, options: SampleOptions { size, pose_mode }, device: device.clone() }
    }

    /// PSNR of pictures decoded from the posterior's mean, and of the mean training picture, on `frames` frames of each held-out
    /// dataset (0 for all).
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn scores(&self, model: &AutoencoderKL, frames: usize) -> anyhow::Result<Scores> {
        let mut contest = Contest::default();
        for batch in self.frames(&self.datasets, frames) {
            let batch = batch?;
            let decoded = self.decoded(model, &batch);
            let views = pictures_of(&batch.target).zip(&decoded).zip(batch.channels.iter().flatten()).enumerate();
            for (view, ((truth, decoded), channel)) in views.filter(|(view, _)| batch.target.mask[*view]) {
                let counted = batch.target.counted_pixels(view);
                contest.model.update_where(decoded, truth, counted);
                if let Some(mean) = self.means.of(channel, 0.0) {
                    contest.mean.update_where(&mean, truth, counted);
                }
            }
        }
        contest.scores().context("there is no held-out picture to measure")
    }

    /// Contact sheets of the first held-out frame of each dataset: input over reconstruction.
    ///
    /// # Errors
    /// Whatever a frame's pictures report, or the file.
    pub fn pictures(&self, model: &AutoencoderKL, folder: &Path) -> anyhow::Result<()> {
        for (number, batch) in self.frames(&self.datasets, 1).enumerate() {
            let batch = batch?;
            let mut sheet = Sheet::new(self.options.size.height as usize, self.options.size.width as usize);
            sheet.row(pictures_of(&batch.target));
            sheet.row(self.decoded(model, &batch).iter().map(Vec::as_slice));
            sheet.save(&folder.join(format!("validation_{number}.png")))?;
        }
        Ok(())
    }

    /// Standard deviation of the latents of `frames` frames of each of these datasets, over all numbers.
    ///
    /// # Errors
    /// Whatever a frame's pictures report, or latents that carry nothing.
    pub fn latent_deviation(
        &self,
        model: &AutoencoderKL,
        datasets: &[Arc<dyn SceneDataset>],
        frames: usize,
    ) -> anyhow::Result<f64> {
        let (mut count, mut sum, mut squares) = (0.0, 0.0, 0.0);
        for batch in self.frames(datasets, frames) {
            let posterior = model.encode(self.network_pictures(&batch?));
            // A draw has the variance of its mean plus its own.
            for (mean, std) in [(posterior.mean.clone(), posterior.std())].map(|(m, s)| (host(m), host(s))) {
                count += mean.len() as f64;
                sum += mean.iter().sum::<f64>();
                squares += mean.iter().chain(&std).map(|v| v * v).sum::<f64>();
            }
        }
        let deviation = (squares / count - (sum / count).powi(2)).sqrt();
        anyhow::ensure!(deviation.is_finite() && deviation > 0.0, "the latents have a deviation of {deviation}");
        Ok(deviation)
    }

    fn frames<'d>(
        &self,
        datasets: &'d [Arc<dyn SceneDataset>],
        count: usize,
    ) -> impl Iterator<Item = anyhow::Result<SceneBatch>> + use<'d> {
        let options = self.options;
        let load = move |(dataset, index): (&Arc<dyn SceneDataset>, usize)| {
            Ok(assemble(vec![Sample::load(&dataset.frame(index)?, &options)?], PadViews::Largest)?)
        };
        let indices = move |dataset: &'d Arc<dyn SceneDataset>| {
            spread(dataset.len(), count).into_iter().map(move |index| (dataset, index))
        };
        datasets.iter().flat_map(indices).map(load)
    }

    /// All views of a frame, `[V, 3, H, W]`.
    fn network_pictures(&self, batch: &SceneBatch) -> Tensor<4> {
        let images = signed(pictures(&batch.input, &self.device));
        let [b, v, c, h, w] = images.dims();
        images.reshape([b * v, c, h, w])
    }

    fn decoded(&self, model: &AutoencoderKL, batch: &SceneBatch) -> Vec<Vec<f32>> {
        displayed_signed(model.decode(model.encode(self.network_pictures(batch)).mean))
    }
}

fn host(values: Tensor<4>) -> Vec<f64> {
    values.into_data().iter::<f64>().collect()
}
