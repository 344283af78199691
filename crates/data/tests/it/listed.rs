//! A dataset that a test lists frame by frame: times, rigs and classes, no pictures.

use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};

use data::{Capabilities, DataError, FrameId, FrameOutline, ObjectBox, ObjectClass, SceneDataset, SceneFrame, View};
use geometry::glam::DVec3;
use geometry::{Box3d, Intrinsics, Lens, Rigid};

/// One frame of a [`Listed`] dataset.
#[derive(Clone)]
pub struct Listing {
    pub time_ms: i64,
    /// Focal length of all cameras, to tell rigs apart.
    pub focal: f64,
    pub views: usize,
    /// `None`: not annotated.
    pub classes: Option<Vec<ObjectClass>>,
}

impl Listing {
    pub fn at(time_ms: i64) -> Self {
        Self { time_ms, focal: 100.0, views: 2, classes: Some(vec![ObjectClass::Car]) }
    }
}

/// Frames in scenes.
pub struct Listed {
    pub scenes: Vec<Vec<Listing>>,
    /// How often a whole frame was asked for; outlines do not count.
    pub made: AtomicUsize,
}

impl Listed {
    pub fn new(scenes: Vec<Vec<Listing>>) -> Self {
        Self { scenes, made: AtomicUsize::new(0) }
    }

    fn make(&self, index: usize) -> SceneFrame {
        let Listing { time_ms, focal, views, classes } = self.listing(index).clone();
        let timestamp_ns = time_ms * 1_000_000;
        let world_from_ego = Rigid::from_yaw(time_ms as f64 * 1e-4, DVec3::new(time_ms as f64 * 0.01, 0.0, 0.0));
        let view = |view: usize| View {
            channel: format!("CAM_{view}"),
            timestamp_ns,
            image: None,
            mask: None,
            intrinsics: Intrinsics { fx: focal, fy: focal, cx: 50.0, cy: 40.0, width: 100, height: 80 },
            lens: Lens::Pinhole,
            ego_from_cam: Rigid::IDENTITY,
            world_from_ego,
        };
        let object = |class: ObjectClass| ObjectBox {
            box3d: Box3d { center: DVec3::X, size: DVec3::ONE, yaw: 0.0 },
            class,
            track: String::new(),
            source_class: String::new(),
            velocity: None,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        };
        SceneFrame {
            id: FrameId { dataset: "listed".into(), scene: String::new(), frame: index.to_string() },
            timestamp_ns,
            world_from_ego,
            views: (0..views).map(view).collect(),
            boxes: classes.map(|classes| classes.into_iter().map(object).collect()),
            scene_text: None,
        }
    }

    fn listing(&self, index: usize) -> &Listing {
        self.scenes.iter().flatten().nth(index).unwrap()
    }
}

impl SceneDataset for Listed {
    fn len(&self) -> usize {
        self.scenes.iter().map(Vec::len).sum()
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        self.made.fetch_add(1, Ordering::Relaxed);
        Ok(self.make(index))
    }

    fn outline(&self, index: usize) -> Result<FrameOutline, DataError> {
        Ok(FrameOutline::of(&self.make(index)))
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let mut end = 0;
        let range = |scene: &Vec<Listing>| {
            end += scene.len();
            end - scene.len()..end
        };
        self.scenes.iter().map(range).collect()
    }

    fn name(&self) -> &str {
        "listed"
    }

    fn capabilities(&self) -> Capabilities {
        let boxes = self.scenes.iter().flatten().any(|listing| listing.classes.is_some());
        Capabilities { boxes, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        self.scenes.iter().flatten().map(|listing| listing.views).max().unwrap_or(0)
    }
}
