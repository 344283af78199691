//! Annotated objects: how many of which class, and whether any picture shows them.

use std::collections::BTreeMap;

use geometry::glam::DVec3;
use geometry::{Box3d, Camera, Rigid};
use serde::Serialize;

use crate::{ObjectClass, SceneFrame};

/// Counts of annotated objects.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct BoxReport {
    /// Frames with a list of boxes, be it empty.
    pub annotated_frames: usize,
    /// All boxes.
    pub count: usize,
    /// Boxes by shared class.
    pub by_class: BTreeMap<ObjectClass, usize>,
    /// Boxes by the dataset's own class.
    pub by_source_class: BTreeMap<String, usize>,
    /// Boxes that were interpolated between annotations.
    pub interpolated: usize,
    /// Boxes of which no picture of their frame shows anything: too far, beside all views, or behind an open rig.
    pub outside_all_pictures: usize,
}

impl BoxReport {
    pub(super) fn add(&mut self, facts: &BoxFacts) {
        self.annotated_frames += usize::from(facts.annotated);
        self.interpolated += facts.interpolated;
        self.outside_all_pictures += facts.outside;
        for (class, source_class) in &facts.classes {
            self.count += 1;
            *self.by_class.entry(*class).or_default() += 1;
            *self.by_source_class.entry(source_class.clone()).or_default() += 1;
        }
    }
}

/// The boxes of one frame.
#[derive(Debug, Default)]
pub(super) struct BoxFacts {
    annotated: bool,
    classes: Vec<(ObjectClass, String)>,
    interpolated: usize,
    outside: usize,
}

impl BoxFacts {
    /// `cameras` in the order of the frame's views.
    pub(super) fn of(frame: &SceneFrame, cameras: &[Camera]) -> Self {
        let Some(boxes) = &frame.boxes else { return Self::default() };
        let views: Vec<(Rigid, &Camera)> = frame
            .views
            .iter()
            .zip(cameras)
            .filter(|(view, _)| view.image.is_some())
            .map(|(view, camera)| (view.ref_ego_from_cam(&frame.world_from_ego).inverse(), camera))
            .collect();
        Self {
            annotated: true,
            classes: boxes.iter().map(|found| (found.class, found.source_class.clone())).collect(),
            interpolated: boxes.iter().filter(|found| found.interpolated).count(),
            outside: boxes.iter().filter(|found| !is_shown(&found.box3d, &views)).count(),
        }
    }
}

/// Whether the centre, a corner or the middle of an edge falls into a picture.
fn is_shown(box3d: &Box3d, views: &[(Rigid, &Camera)]) -> bool {
    let corners = box3d.corners();
    let edges = (0..4).flat_map(|i| [(i, (i + 1) % 4), (i + 4, (i + 1) % 4 + 4), (i, i + 4)]);
    let middles = edges.map(|(a, b)| 0.5 * (corners[a] + corners[b]));
    let points: Vec<DVec3> = corners.into_iter().chain(middles).chain([box3d.center]).collect();
    views.iter().any(|(cam_from_ego, camera)| {
        let shown = |point: &DVec3| camera.project(*cam_from_ego * *point);
        points.iter().filter_map(shown).any(|pixel| camera.intrinsics.contains(pixel))
    })
}
