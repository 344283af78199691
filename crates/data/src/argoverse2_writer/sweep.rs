//! Lidar sweeps: points in the ego frame at the frame's reference instant.

use std::f64::consts::FRAC_PI_2;

use geometry::Rigid;
use geometry::glam::{DQuat, DVec3};
use half::f16;

use super::feather::Columns;
use crate::{DataError, ImageSource, SceneFrame, lidar};

/// Mounting poses of the two lidars, rounded from the real car's; the sweep holds both, in the ego frame.
pub(super) fn lidar_mounts() -> [(&'static str, Rigid); 2] {
    [
        ("up_lidar", Rigid { rotation: DQuat::IDENTITY, translation: DVec3::new(1.35, 0.0, 1.64) }),
        (
            "down_lidar",
            Rigid { rotation: DQuat::from_xyzw(1.0, 0.0, 0.0, 0.0), translation: DVec3::new(1.35, 0.0, 1.53) },
        ),
    ]
}

/// One turn.
#[derive(Debug, Default)]
pub(super) struct Sweep {
    /// Ego frame, metres; already rounded to what the file holds (6 cm at 70 m), so that counts of points agree with it.
    pub(super) points: Vec<DVec3>,
    /// Semantic label in place of a reflectance.
    intensity: Vec<u8>,
    laser: Vec<u8>,
}

/// Casts a turn where the frame shows the procedural world; `None` for any other frame and without `columns`.
pub(super) fn cast(frame: &SceneFrame, columns: u32) -> Option<Sweep> {
    if columns == 0 {
        return None;
    }
    let snapshot = frame.views.iter().find_map(|view| match &view.image {
        Some(ImageSource::Rendered { snapshot, .. }) => Some(snapshot),
        _ => None,
    })?;
    // The shared lidar looks along its y axis.
    let [(_, mount), _] = lidar_mounts();
    let ego_from_lidar = Rigid { rotation: DQuat::from_rotation_z(-FRAC_PI_2), translation: mount.translation };
    let returns = lidar::cast(snapshot, &(frame.world_from_ego * ego_from_lidar), columns);
    Some(Sweep {
        points: returns.iter().map(|found| rounded(ego_from_lidar * found.point)).collect(),
        intensity: returns.iter().map(|found| found.semantic).collect(),
        laser: returns.iter().map(|found| found.ring).collect(),
    })
}

fn rounded(point: DVec3) -> DVec3 {
    DVec3::from_array(point.to_array().map(|value| f16::from_f64(value).to_f64()))
}

impl Sweep {
    /// The file's bytes. All rays are cast at the sweep's stamp, so every offset is zero.
    pub(super) fn encode(self) -> Result<Vec<u8>, DataError> {
        let axis = |of: fn(&DVec3) -> f64| self.points.iter().map(|point| f16::from_f64(of(point))).collect();
        let (x, y, z) = (axis(|p| p.x), axis(|p| p.y), axis(|p| p.z));
        let offsets = vec![0; self.points.len()];
        let columns = Columns::default().f16("x", x).f16("y", y).f16("z", z);
        columns.u8("intensity", self.intensity).u8("laser_number", self.laser).i32("offset_ns", offsets).encode()
    }
}
