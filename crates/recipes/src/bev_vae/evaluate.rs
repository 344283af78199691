//! Held-out measurements of BEV-VAE: reconstruction and, where ground truth can be rendered, views that no camera took.

use std::path::Path;
use std::sync::Arc;

use burn::tensor::Device;
use data::{ImageSize, PoseMode, SceneDataset, SceneFrame};
use metrics::Psnr;
use serde::Serialize;
use vae::BevVae;

use super::MeanPictures;
use super::viewer::{Coded, PresentView, Viewer, pictures_of};
use crate::sheet::Sheet;

/// Mean PSNR over pictures, and what the baselines reach on the same pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scores {
    /// Of the model.
    pub psnr_db: f64,
    /// Of the best baseline.
    pub baseline_db: f64,
    /// Of the mean training picture of the same camera (turned alike for novel views).
    pub mean_image_db: f64,
    /// Of the input view that looks closest to the asked direction; only for novel views.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nearest_view_db: Option<f64>,
    /// Pictures measured.
    pub pictures: usize,
}

/// All held-out measurements of one model.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Evaluation {
    /// The input cameras decoded again.
    pub reconstruction: Scores,
    /// The turned rig decoded; `None` where no dataset can render its truth.
    pub novel_view: Option<Scores>,
    /// Turns of the novel views, degrees.
    pub yaw_deg: Vec<f64>,
}

/// Held-out datasets and the baselines of the training data.
pub struct Evaluator {
    datasets: Vec<Arc<dyn SceneDataset>>,
    means: MeanPictures,
    yaw_deg: Vec<f64>,
    size: ImageSize,
    pose_mode: PoseMode,
    device: Device,
}

/// PSNR collectors of the model and its rivals on the same pictures.
#[derive(Default)]
pub(crate) struct Contest {
    pub model: Psnr,
    pub mean: Psnr,
    pub nearest: Psnr,
}

impl Contest {
    /// None before the first picture.
    pub fn scores(&self) -> Option<Scores> {
        let db = |psnr: &Psnr| psnr.summary().mean_db;
        let (psnr_db, nearest_view_db) = (db(&self.model)?, db(&self.nearest));
        let mean_image_db = db(&self.mean).unwrap_or(f64::NEG_INFINITY);
        let baseline_db = nearest_view_db.map_or(mean_image_db, |nearest| nearest.max(mean_image_db));
        let pictures = self.model.summary().images;
        Some(Scores { psnr_db, baseline_db, mean_image_db, nearest_view_db, pictures })
    }
}

impl Evaluator {
    /// `device` is the one without a tape.
    pub fn new(
        datasets: Vec<Arc<dyn SceneDataset>>,
        means: MeanPictures,
        yaw_deg: Vec<f64>,
        size: ImageSize,
        pose_mode: PoseMode,
        device: &Device,
    ) -> Self {
        Self { datasets, means, yaw_deg, size, pose_mode, device: device.clone() }
    }

    /// Baselines of the training data.
    pub fn means(&self) -> &MeanPictures {
        &self.means
    }

    /// Reconstruction alone, on `frames` frames of each dataset (0 for all).
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn reconstruction(&self, model: &BevVae, frames: usize) -> anyhow::Result<Scores> {
        let viewer = self.viewer(model);
        let mut contest = Contest::default();
        for frame in viewer.frames(&self.datasets, frames) {
            self.score_reconstruction(&viewer, &viewer.encode(&frame?)?, &mut contest);
        }
        contest.scores().ok_or_else(nothing_to_measure)
    }

    /// Reconstruction and novel views on `frames` frames of each dataset (0 for all).
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn evaluate(&self, model: &BevVae, frames: usize) -> anyhow::Result<Evaluation> {
        let viewer = self.viewer(model);
        let (mut seen, mut novel) = (Contest::default(), Contest::default());
        for frame in viewer.frames(&self.datasets, frames) {
            let frame = frame?;
            let coded = viewer.encode(&frame)?;
            self.score_reconstruction(&viewer, &coded, &mut seen);
            for yaw in &self.yaw_deg {
                self.score_turned(&viewer, &frame, &coded, *yaw, &mut novel)?;
            }
        }
        let reconstruction = seen.scores().ok_or_else(nothing_to_measure)?;
        Ok(Evaluation { reconstruction, novel_view: novel.scores(), yaw_deg: self.yaw_deg.clone() })
    }

    /// Contact sheets of the first held-out frame of each dataset: input, reconstruction, then for each turn the decoded views
    /// over their truth.
    ///
    /// # Errors
    /// Whatever a frame's pictures report, or the file.
    pub fn pictures(&self, model: &BevVae, folder: &Path) -> anyhow::Result<()> {
        let viewer = self.viewer(model);
        for (number, frame) in viewer.frames(&self.datasets, 1).enumerate() {
            let frame = frame?;
            let coded = viewer.encode(&frame)?;
            let mut sheet = Sheet::new(self.size.height as usize, self.size.width as usize);
            sheet.row(coded.pictures());
            sheet.row(viewer.decode(&coded, coded.input()).iter().map(Vec::as_slice));
            for yaw in &self.yaw_deg {
                let Some(truth) = viewer.truth(&frame, &frame.rig().rotated(yaw.to_radians()))? else { continue };
                sheet.space();
                sheet.row(viewer.decode(&coded, &truth).iter().map(Vec::as_slice));
                sheet.row(pictures_of(&truth));
            }
            sheet.save(&folder.join(format!("validation_{number}.png")))?;
        }
        Ok(())
    }

    fn viewer<'a>(&'a self, model: &'a BevVae) -> Viewer<'a> {
        Viewer::with(model, &self.device, self.size, self.pose_mode)
    }

    fn score_reconstruction(&self, viewer: &Viewer, coded: &Coded, contest: &mut Contest) {
        let decoded = viewer.decode(coded, coded.input());
        for PresentView { view, channel, picture, counted } in coded.present() {
            contest.model.update_where(&decoded[view], picture, counted);
            self.score_mean(channel, 0.0, picture, counted, contest);
        }
    }

    fn score_turned(
        &self,
        viewer: &Viewer,
        frame: &SceneFrame,
        coded: &Coded,
        yaw_deg: f64,
        contest: &mut Contest,
    ) -> anyhow::Result<()> {
        let yaw_rad = yaw_deg.to_radians();
        let Some(truths) = viewer.truth(frame, &frame.rig().rotated(yaw_rad))? else { return Ok(()) };
        let decoded = viewer.decode(coded, &truths);
        let inputs: Vec<&[f32]> = coded.pictures().collect();
        for (view, truth) in pictures_of(&truths).enumerate() {
            contest.model.update(&decoded[view], truth);
            contest.nearest.update(inputs[coded.nearest_view(view, yaw_rad)], truth);
            self.score_mean(&coded.channels()[view], yaw_deg, truth, truths.counted_pixels(view), contest);
        }
        Ok(())
    }

    fn score_mean(&self, channel: &str, yaw_deg: f64, truth: &[f32], counted: &[bool], contest: &mut Contest) {
        if let Some(mean) = self.means.of(channel, yaw_deg) {
            contest.mean.update_where(&mean, truth, counted);
        }
    }
}

fn nothing_to_measure() -> anyhow::Error {
    anyhow::anyhow!("there is no held-out picture to measure")
}
