//! Frames, rigid transforms, camera models, rigs, the BEV grid, the frustum and boxes.
//!
//! `dst_from_src` maps a point of frame `src` into frame `dst`. Frames: `ego` x forward, y left, z up; `cam` x right, y down,
//! z forward (OpenCV); pixels u right, v down with pixel centres at +0.5. Everything is f64: world coordinates of real maps
//! (millions of metres) lose half a metre in f32.

mod bev_grid;
mod box3d;
mod camera;
mod error;
mod frustum;
mod image_edit;
mod lens;
mod oriented_box;
mod rig;
mod rig_presets;
mod rigid;

pub use bev_grid::BevGrid;
pub use box3d::Box3d;
pub use camera::{Camera, Intrinsics};
pub use error::GeometryError;
pub use frustum::{Frustum, FrustumPixels};
pub use glam;
pub use image_edit::ImageEdit;
pub use lens::Lens;
pub use oriented_box::OrientedBox;
pub use rig::{Adjacency, CameraRig, RigCamera};
pub use rig_presets::RigPreset;
pub use rigid::{PoseTrack, Rigid, wrap_angle};
