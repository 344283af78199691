//! A model that paints the pictures of a dataset again, as the generated side, and the same pictures at its size, as the real side.

use std::ops::Range;
use std::sync::Arc;

use anyhow::Context;
use data::{ImageSize, PoseMode, Sample, SampleOptions, SceneDataset, SceneFrame};
use metrics::Raster;

use super::source::{Instant, PictureSource, instant, raster};
use crate::bev_vae::{PresentView, Viewer};
use crate::sheet::rgb_image;

/// One side of a reconstruction.
pub struct Painted<'a> {
    viewer: Viewer<'a>,
    dataset: Arc<dyn SceneDataset>,
    frames: Vec<usize>,
    size: ImageSize,
    /// The model's pictures, else those it was shown.
    decoded: bool,
}

impl<'a> Painted<'a> {
    /// The model's side for `decoded`, else the pictures it is shown; `size` is what the model sees. Looks at the given frames.
    pub fn new(
        viewer: Viewer<'a>,
        dataset: Arc<dyn SceneDataset>,
        frames: Vec<usize>,
        size: ImageSize,
        decoded: bool,
    ) -> Self {
        Self { viewer, dataset, frames, size, decoded }
    }

    fn frame(&self, index: usize) -> anyhow::Result<SceneFrame> {
        let frame = self.frames.get(index).context("an index beyond the last frame")?;
        Ok(self.dataset.frame(*frame)?)
    }

    /// Pictures by place in the rig; `None` where a camera has none.
    fn pictures(&self, frame: &SceneFrame) -> anyhow::Result<Vec<Option<Raster<u8>>>> {
        if !self.decoded {
            let options = SampleOptions { size: self.size, pose_mode: PoseMode::Static };
            let views = Sample::load(frame, &options)?.target.into_iter();
            return Ok(views.map(|view| view.image.map(|values| self.raster(&values))).collect());
        }
        let coded = self.viewer.encode(frame)?;
        let decoded = self.viewer.decode(&coded, coded.input());
        let mut pictures = vec![None; decoded.len()];
        for PresentView { view, .. } in coded.present() {
            if let (Some(place), Some(values)) = (pictures.get_mut(view), decoded.get(view)) {
                *place = Some(self.raster(values));
            }
        }
        Ok(pictures)
    }

    fn raster(&self, values: &[f32]) -> Raster<u8> {
        raster(rgb_image(values, self.size.height, self.size.width))
    }
}

impl PictureSource for Painted<'_> {
    fn describe(&self) -> String {
        let what = if self.decoded { "reconstruction of" } else { "pictures shown of" };
        format!("{what} {}", self.dataset.name())
    }

    fn len(&self) -> usize {
        self.frames.len()
    }

    fn scenes(&self) -> Vec<Range<usize>> {
        let place = |frame: usize| self.frames.partition_point(|at| *at < frame);
        let ranges = self.dataset.scene_ranges();
        ranges.into_iter().map(|range| place(range.start)..place(range.end)).filter(|range| !range.is_empty()).collect()
    }

    fn name(&self, index: usize) -> anyhow::Result<String> {
        let id = self.frame(index)?.id;
        Ok(format!("{}/{}", id.scene, id.frame))
    }

    fn instant(&self, index: usize) -> anyhow::Result<Instant> {
        let frame = self.frame(index)?;
        let pictures = self.pictures(&frame)?;
        let name = format!("{}/{}", frame.id.scene, frame.id.frame);
        instant(&frame, name, |view, _| Ok(pictures.get(view).cloned().flatten()))
    }
}
