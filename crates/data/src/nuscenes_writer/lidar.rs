//! The lidar of the layout: turns of the coarse lidar in the release's file form.
//!
//! All rays of a turn are cast at the sample's time. Point files are headerless little-endian f32: x, y, z (lidar frame: x right,
//! y forward, z up), intensity, ring. The intensity is the semantic label, since the world knows no reflectances.

use std::collections::BTreeMap;

use geometry::Rigid;
use glam::{DQuat, DVec3};
use world::Snapshot;

/// The one lidar of the layout.
pub(super) const CHANNEL: &str = "LIDAR_TOP";

/// Mounting pose of the real car n015's lidar.
pub(super) fn ego_from_lidar() -> Rigid {
    let rotation = DQuat::from_xyzw(-0.006492, 0.010646, -0.706307, 0.707796);
    Rigid::new(rotation, DVec3::new(0.94371, 0.0, 1.84023))
}

/// One turn.
#[derive(Debug, Default)]
pub(super) struct Turn {
    /// The file's bytes.
    pub(super) bytes: Vec<u8>,
    /// Returns per actor id.
    pub(super) points: BTreeMap<u32, u32>,
}

/// Casts `columns` directions of all beams.
pub(super) fn cast(snapshot: &Snapshot, world_from_lidar: &Rigid, columns: u32) -> Turn {
    let mut turn = Turn::default();
    for found in crate::lidar::cast(snapshot, world_from_lidar, columns) {
        let point = found.point.as_vec3();
        let numbers = [point.x, point.y, point.z, f32::from(found.semantic), f32::from(found.ring)];
        turn.bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        if let Some(actor) = found.actor {
            *turn.points.entry(actor).or_default() += 1;
        }
    }
    turn
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lidar_is_mounted_with_its_y_axis_ahead() {
        let ahead = ego_from_lidar().transform_vector(DVec3::Y);
        let right = ego_from_lidar().transform_vector(DVec3::X);
        assert!(ahead.x > 0.99 && right.y < -0.99, "{ahead} {right}");
    }
}
