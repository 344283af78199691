//! Encoding one frame and decoding any cameras: what evaluation, `reconstruct` and `novel-view` share.

use std::sync::Arc;

use burn::tensor::{Device, Tensor};
use data::{
    ImageSize, PadViews, PoseMode, Sample, SampleOptions, SceneDataset, SceneFrame, ViewArrays, assemble, novel_targets,
};
use geometry::{CameraRig, wrap_angle};
use vae::BevVae;
use vae::pixels::normalise;

use super::Experiment;
use super::baseline::{renders, spread};
use crate::tensors::{decode_cameras, displayed, encode_cameras, pictures};

/// A model without a tape and the picture size it sees.
#[derive(Debug, Clone, Copy)]
pub struct Viewer<'a> {
    model: &'a BevVae,
    device: &'a Device,
    options: SampleOptions,
}

/// One encoded frame.
#[derive(Debug, Clone)]
pub struct Coded {
    latent: Tensor<3>,
    input: ViewArrays,
    channels: Vec<String>,
    azimuths: Vec<f64>,
}

impl<'a> Viewer<'a> {
    /// With the picture size and poses of an experiment.
    pub fn new(experiment: &Experiment, model: &'a BevVae, device: &'a Device) -> Self {
        Self::with(model, device, experiment.image_size(), experiment.data.loader.pose_mode)
    }

    /// With picture size and poses.
    pub fn with(model: &'a BevVae, device: &'a Device, size: ImageSize, pose_mode: PoseMode) -> Self {
        Self { model, device, options: SampleOptions { size, pose_mode } }
    }

    /// `count` frames of each dataset, spread evenly; all for 0.
    pub fn frames<'d>(
        &self,
        datasets: &'d [Arc<dyn SceneDataset>],
        count: usize,
    ) -> impl Iterator<Item = anyhow::Result<SceneFrame>> + use<'d> {
        datasets
            .iter()
            .flat_map(move |dataset| spread(dataset.len(), count).into_iter().map(|index| Ok(dataset.frame(index)?)))
    }

    /// The posterior's mean of one frame.
    ///
    /// # Errors
    /// Whatever the frame's pictures report.
    pub fn encode(&self, frame: &SceneFrame) -> anyhow::Result<Coded> {
        let sample = Sample::load(frame, &self.options)?;
        let batch = assemble(vec![sample], PadViews::Largest)?;
        let images = normalise(pictures(&batch.input, self.device));
        let posterior = self.model.encode(images, &encode_cameras(&batch.input, self.device));
        let azimuths = frame.views.iter().map(|view| view.rig_camera().azimuth()).collect();
        let channels = batch.channels.into_iter().flatten().collect();
        Ok(Coded { latent: posterior.mean, input: batch.target, channels, azimuths })
    }

    /// RGB in [0, 1] of any cameras, one `[3, H, W]` per camera.
    pub fn decode(&self, coded: &Coded, cameras: &ViewArrays) -> Vec<Vec<f32>> {
        displayed(self.model.decode(coded.latent.clone(), &decode_cameras(cameras, self.device)).images)
    }

    /// Cameras without pictures.
    ///
    /// # Errors
    /// Unusable calibration.
    pub fn cameras(&self, rig: &CameraRig) -> anyhow::Result<ViewArrays> {
        Ok(ViewArrays::cameras(std::slice::from_ref(rig), self.options.size, PadViews::Largest)?)
    }

    /// What these cameras would have seen; `None` where the dataset cannot render it.
    ///
    /// # Errors
    /// Unusable calibration.
    pub fn truth(&self, frame: &SceneFrame, rig: &CameraRig) -> anyhow::Result<Option<ViewArrays>> {
        if !renders(frame) {
            return Ok(None);
        }
        let rigs = std::slice::from_ref(rig);
        Ok(Some(novel_targets(std::slice::from_ref(frame), rigs, self.options.size, PadViews::Largest)?))
    }
}

/// A camera with its clean picture.
pub struct PresentView<'a> {
    /// Position in the rig.
    pub view: usize,
    /// Its name.
    pub channel: &'a str,
    /// `[3, H, W]` RGB in [0, 1].
    pub picture: &'a [f32],
    /// `[H, W]`, false where the dataset says to ignore a pixel.
    pub counted: &'a [bool],
}

impl Coded {
    /// The clean input cameras and pictures.
    pub fn input(&self) -> &ViewArrays {
        &self.input
    }

    /// The clean input pictures, one per camera; black where the dataset has none.
    pub fn pictures(&self) -> impl Iterator<Item = &[f32]> {
        pictures_of(&self.input)
    }

    /// The cameras that have a picture.
    pub fn present(&self) -> impl Iterator<Item = PresentView<'_>> {
        let named = self.channels.iter().zip(pictures_of(&self.input)).enumerate();
        named.filter(|(view, _)| self.input.mask[*view]).map(|(view, (channel, picture))| PresentView {
            view,
            channel,
            picture,
            counted: self.input.counted_pixels(view),
        })
    }

    /// Channel of each camera.
    pub fn channels(&self) -> &[String] {
        &self.channels
    }

    /// The input view whose optical axis is closest to that of `view` after a turn by `yaw_rad`.
    pub fn nearest_view(&self, view: usize, yaw_rad: f64) -> usize {
        let asked = self.azimuths[view] + yaw_rad;
        let distance = |i: &usize| wrap_angle(self.azimuths[*i] - asked).abs();
        (0..self.azimuths.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(view)
    }
}

/// Pictures of a batch of one, view by view.
pub fn pictures_of(arrays: &ViewArrays) -> impl Iterator<Item = &[f32]> {
    arrays.images.chunks_exact(3 * arrays.height * arrays.width)
}
