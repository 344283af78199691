//! A dataset as a generator sees it: its boxes are the layouts that pictures are made from, its cameras those that are painted.

use std::ops::Range;
use std::sync::Arc;

use geometry::{CameraRig, wrap_angle};

use crate::layout::{Layout, LayoutClasses, LayoutEdit};
use crate::sample::in_frame;
use crate::{Capabilities, DataError, ObjectBox, SceneDataset, SceneFrame, rerig};

/// The frames of a dataset with the boxes of their layouts in place of their own.
pub struct Conditioned {
    /// Whose frames.
    pub dataset: Arc<dyn SceneDataset>,
    /// Classes that pictures are made from; boxes of no such class are left out.
    pub classes: LayoutClasses,
    /// Changes of every layout.
    pub edits: Vec<LayoutEdit>,
    /// Cameras in place of the frame's own.
    pub rig: Option<CameraRig>,
}

impl Conditioned {
    /// What a frame's pictures are made from.
    ///
    /// # Errors
    /// [`DataError::Frame`] around a frame without annotation and edits that cannot be made.
    pub fn layout(&self, index: usize) -> Result<Layout, DataError> {
        self.layout_of(&self.dataset.frame(index)?)
    }

    fn layout_of(&self, frame: &SceneFrame) -> Result<Layout, DataError> {
        let refuse = |why: String| in_frame(&frame.id, DataError::Config(why));
        if frame.boxes.is_none() {
            return Err(refuse("it is not annotated, so there is no layout; choose an annotated split".to_owned()));
        }
        let layout = Layout::of_frame(frame, &self.classes);
        layout.edited(&self.edits, &self.classes).map_err(|error| refuse(error.to_string()))
    }
}

impl SceneDataset for Conditioned {
    fn len(&self) -> usize {
        self.dataset.len()
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let frame = self.dataset.frame(index)?;
        let frame = conditioned(&frame, &self.layout_of(&frame)?);
        self.rig.as_ref().map_or_else(|| Ok(frame.clone()), |rig| rerig(&frame, rig))
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.dataset.scene_ranges()
    }

    fn name(&self) -> &str {
        self.dataset.name()
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { boxes: true, text: self.dataset.capabilities().text, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        self.rig.as_ref().map_or_else(|| self.dataset.max_views(), |rig| rig.cameras.len())
    }
}

/// The frame with the boxes of a layout in place of its own. A box that is still what the frame calls by its track keeps the frame's words
/// about it: native class, attributes, speed, counts.
#[must_use]
pub fn conditioned(frame: &SceneFrame, layout: &Layout) -> SceneFrame {
    let known = frame.boxes.as_deref().unwrap_or_default();
    let annotation = |made: ObjectBox| {
        let same = known.iter().find(|found| found.track == made.track);
        match same.filter(|found| found.class == made.class || found.source_class == made.source_class) {
            // An upright box makes the way through a quaternion; the frame's own numbers are exact.
            Some(found) if is_same_place(found, &made) => found.clone(),
            Some(found) => ObjectBox { box3d: made.box3d, ..found.clone() },
            None => made,
        }
    };
    SceneFrame { boxes: Some(layout.annotations().into_iter().map(annotation).collect()), ..frame.clone() }
}

fn is_same_place(a: &ObjectBox, b: &ObjectBox) -> bool {
    let turn = wrap_angle(a.box3d.yaw - b.box3d.yaw);
    a.box3d.center == b.box3d.center && a.box3d.size == b.box3d.size && turn.abs() < 1e-12
}
