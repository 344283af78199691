//! Clips as a dataset of their first frames, so that a mixture weighs and orders clips as it does frames.

use std::ops::Range;
use std::sync::Arc;

use crate::{Capabilities, Clips, DataError, FrameOutline, ObjectClass, SceneDataset, SceneFrame};

/// Frame i is the first frame of clip i.
pub(super) struct ClipStarts(pub Arc<Clips>);

impl ClipStarts {
    fn dataset(&self) -> &dyn SceneDataset {
        self.0.dataset().as_ref()
    }

    fn first(&self, clip: usize) -> Result<usize, DataError> {
        let none = || DataError::Config("a clip without frames".to_owned());
        self.0.frame_indices(clip)?.first().copied().ok_or_else(none)
    }
}

impl SceneDataset for ClipStarts {
    fn len(&self) -> usize {
        self.0.len()
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        self.dataset().frame(self.first(index)?)
    }

    fn outline(&self, index: usize) -> Result<FrameOutline, DataError> {
        self.dataset().outline(self.first(index)?)
    }

    /// Those of all frames of the clip.
    fn box_classes(&self, index: usize) -> Result<Vec<ObjectClass>, DataError> {
        let classes = self.0.frame_indices(index)?.iter().map(|frame| self.dataset().box_classes(*frame));
        Ok(classes.collect::<Result<Vec<_>, _>>()?.concat())
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let starts: Vec<usize> = (0..self.len()).filter_map(|clip| self.first(clip).ok()).collect();
        let within = |scene: Range<usize>| {
            starts.partition_point(|start| *start < scene.start)..starts.partition_point(|start| *start < scene.end)
        };
        self.dataset().scene_ranges().into_iter().map(within).collect()
    }

    fn name(&self) -> &str {
        self.dataset().name()
    }

    fn capabilities(&self) -> Capabilities {
        self.dataset().capabilities()
    }

    fn max_views(&self) -> usize {
        self.dataset().max_views()
    }
}
