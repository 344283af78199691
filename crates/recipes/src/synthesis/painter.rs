//! Frames of a dataset painted from their layouts.

use data::export::Conditioned;
use data::{DataError, FrameId, PoseMode, SceneFrame};
use geometry::{CameraRig, RigCamera};
use image::RgbImage;

use super::Synthesiser;
use crate::dit::NoiseKey;

/// The noise of a frame's samples: equal for equal seeds and frames, whatever the layout, cameras and batch.
pub fn noise_key(seed: u64, id: &FrameId, draw: u64) -> NoiseKey {
    NoiseKey { seed, token: format!("{}/{}/{}", id.dataset, id.scene, id.frame), draw }
}

/// The cameras of a frame where the autoencoder expects them.
pub fn cameras_of(frame: &SceneFrame, pose_mode: PoseMode) -> CameraRig {
    let camera = |view: &data::View| RigCamera {
        ego_from_cam: match pose_mode {
            PoseMode::Static => view.ego_from_cam,
            PoseMode::Compensated => view.ref_ego_from_cam(&frame.world_from_ego),
        },
        ..view.rig_camera()
    };
    CameraRig { cameras: frame.views.iter().map(camera).collect() }
}

/// Paints every frame of a dataset from its layout.
pub struct LayoutPainter<'a> {
    /// The model.
    pub synthesiser: &'a Synthesiser,
    /// Frames with their layouts.
    pub source: &'a Conditioned,
    /// Seed.
    pub seed: u64,
}

impl LayoutPainter<'_> {
    /// All cameras of one frame, from one latent. Of a frame's own cameras, one without a picture gets none here either.
    ///
    /// # Errors
    /// [`DataError::Config`] with the model's complaint.
    pub fn paint(&self, index: usize, frame: &SceneFrame) -> Result<Vec<Option<RgbImage>>, DataError> {
        let layout = self.source.layout(index)?;
        let made = || -> anyhow::Result<Vec<RgbImage>> {
            let latent = self.synthesiser.latent(&layout, &noise_key(self.seed, &frame.id, 0))?;
            self.synthesiser.pictures(latent, &cameras_of(frame, self.synthesiser.pose_mode()))
        };
        let pictures = made().map_err(|error| DataError::Config(format!("{error:#}")))?;
        let painted = |view: &data::View| self.source.rig.is_some() || view.image.is_some();
        Ok(pictures.into_iter().zip(&frame.views).map(|(picture, view)| painted(view).then_some(picture)).collect())
    }
}
