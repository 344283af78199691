//! What one frame tells.

use geometry::{CameraRig, ImageEdit};

use super::boxes::BoxFacts;
use crate::sample::in_frame;
use crate::{DataError, ImageSource, SceneDataset, SceneFrame, View};

/// Rendered pictures are tried at this share of their size: one ray per pixel takes seconds at full size.
const RENDERED_SHARE: u32 = 16;

/// Channel, exposure and whether it is a mask: a picture that serves several frames is one picture.
pub(super) type PictureKey = (String, i64, bool);

/// A picture or mask of a frame.
#[derive(Debug)]
pub(super) struct Picture {
    pub(super) key: PictureKey,
    pub(super) source: ImageSource,
}

impl Picture {
    /// All its pixels.
    pub(super) fn read(&self) -> Result<(), DataError> {
        let ImageSource::Rendered { camera, .. } = &self.source else { return self.source.decode().map(drop) };
        let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
        let small = (width.div_ceil(RENDERED_SHARE), height.div_ceil(RENDERED_SHARE));
        self.source.load(&ImageEdit::identity(width, height).resize(small.0, small.1)).map(drop)
    }
}

/// What is kept of a frame.
#[derive(Debug)]
pub(super) struct FrameFacts {
    pub(super) timestamp_ns: i64,
    pub(super) rig: CameraRig,
    pub(super) pictures: Vec<Picture>,
    pub(super) absent_views: usize,
    pub(super) boxes: BoxFacts,
    /// Longest time between a picture and the reference instant, ns.
    pub(super) longest_offset_ns: i64,
    /// Longest way of the car between a picture and the reference instant, metres.
    pub(super) longest_way_m: f64,
}

impl FrameFacts {
    pub(super) fn of(dataset: &dyn SceneDataset, index: usize) -> Result<Self, DataError> {
        let frame = dataset.frame(index)?;
        let cameras = frame.views.iter().map(|view| {
            let bad = |error| DataError::Config(format!("camera {}: {error}", view.channel));
            view.camera().map_err(bad).map_err(|error| in_frame(&frame.id, error))
        });
        let cameras = cameras.collect::<Result<Vec<_>, _>>()?;
        let taken = || frame.views.iter().filter(|view| view.image.is_some());
        let way = |view: &View| (view.world_from_ego.translation - frame.world_from_ego.translation).length();
        Ok(Self {
            timestamp_ns: frame.timestamp_ns,
            rig: frame.rig(),
            absent_views: frame.views.iter().filter(|view| view.image.is_none()).count(),
            boxes: BoxFacts::of(&frame, &cameras),
            longest_offset_ns: taken()
                .map(|view| (view.timestamp_ns.saturating_sub(frame.timestamp_ns)).saturating_abs())
                .max()
                .unwrap_or(0),
            longest_way_m: taken().map(way).fold(0.0, f64::max),
            pictures: pictures(frame),
        })
    }

    /// The larger of this and the frame's pictures, by area.
    pub(super) fn largest_picture(&self, so_far: (u32, u32)) -> (u32, u32) {
        let sizes = self.rig.cameras.iter().map(|camera| (camera.intrinsics.width, camera.intrinsics.height));
        sizes.chain([so_far]).max_by_key(|(w, h)| u64::from(*w) * u64::from(*h)).unwrap_or(so_far)
    }
}

fn pictures(frame: SceneFrame) -> Vec<Picture> {
    let mut pictures = Vec::new();
    for view in frame.views {
        let key = |mask| (view.channel.clone(), view.timestamp_ns, mask);
        pictures.extend(view.image.map(|source| Picture { key: key(false), source }));
        pictures.extend(view.mask.map(|source| Picture { key: key(true), source }));
    }
    pictures
}
