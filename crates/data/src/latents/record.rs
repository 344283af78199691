//! What is kept of a frame beside its latent: where it comes from and its boxes.

use geometry::glam::DVec3;
use geometry::{Box3d, Rigid};
use serde::{Deserialize, Serialize};

use crate::{FrameId, ObjectBox, ObjectClass, SceneFrame};

/// One frame without cameras, as stored.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Record {
    pub dataset: String,
    pub scene: String,
    pub frame: String,
    pub timestamp_ns: i64,
    /// `None` where the frame is not annotated.
    pub boxes: Option<Vec<StoredBox>>,
}

/// A box in the ego frame of the frame's instant, metres and radians.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct StoredBox {
    class: ObjectClass,
    source_class: String,
    track: String,
    center: [f64; 3],
    size: [f64; 3],
    yaw: f64,
}

impl Record {
    pub fn of(frame: &SceneFrame) -> Self {
        let FrameId { dataset, scene, frame: name } = frame.id.clone();
        let boxes = frame.boxes.as_ref().map(|boxes| boxes.iter().map(StoredBox::of).collect());
        Self { dataset, scene, frame: name, timestamp_ns: frame.timestamp_ns, boxes }
    }

    /// The frame, without views; the car stands at the origin of the world.
    pub fn frame(self) -> SceneFrame {
        SceneFrame {
            id: FrameId { dataset: self.dataset, scene: self.scene, frame: self.frame },
            timestamp_ns: self.timestamp_ns,
            world_from_ego: Rigid::IDENTITY,
            views: Vec::new(),
            boxes: self.boxes.map(|boxes| boxes.into_iter().map(StoredBox::object).collect()),
            scene_text: None,
        }
    }
}

impl StoredBox {
    fn of(object: &ObjectBox) -> Self {
        Self {
            class: object.class,
            source_class: object.source_class.clone(),
            track: object.track.clone(),
            center: object.box3d.center.to_array(),
            size: object.box3d.size.to_array(),
            yaw: object.box3d.yaw,
        }
    }

    fn object(self) -> ObjectBox {
        ObjectBox {
            box3d: Box3d { center: DVec3::from_array(self.center), size: DVec3::from_array(self.size), yaw: self.yaw },
            class: self.class,
            track: self.track,
            source_class: self.source_class,
            velocity: None,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        }
    }
}
