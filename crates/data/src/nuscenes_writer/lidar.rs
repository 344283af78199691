//! A coarse 32-beam lidar: what the detection evaluation counts points with.
//!
//! All rays of a turn are cast at the sample's time. Point files are headerless little-endian f32: x, y, z (lidar frame: x right,
//! y forward, z up), intensity, ring. The intensity is the semantic label, since the world knows no reflectances.

use std::collections::BTreeMap;
use std::f64::consts::TAU;

use geometry::Rigid;
use glam::{DQuat, DVec3};
use rayon::prelude::*;
use world::Snapshot;

/// The one lidar of the layout.
pub(super) const CHANNEL: &str = "LIDAR_TOP";
/// Beams of a Velodyne HDL-32E, degrees above the horizon.
const RINGS: u32 = 32;
const LOWEST_DEG: f64 = -30.67;
const HIGHEST_DEG: f64 = 10.67;
/// Farthest return of that lidar, metres.
const RANGE_M: f64 = 70.0;

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
    let rays: Vec<(u32, DVec3)> =
        (0..columns).flat_map(|column| (0..RINGS).map(move |ring| (ring, beam(ring, column, columns)))).collect();
    let cast_one = |(ring, direction): &(u32, DVec3)| {
        let hit = snapshot.raycast(world_from_lidar.translation, world_from_lidar.transform_vector(*direction))?;
        (hit.distance <= RANGE_M).then_some((*ring, *direction * hit.distance, hit))
    };
    // `collect` keeps the order of the rays, so the file does not depend on the number of threads.
    let hits: Vec<_> = rays.par_iter().map(cast_one).collect();
    let mut turn = Turn::default();
    for (ring, point, hit) in hits.into_iter().flatten() {
        let numbers = [point.x as f32, point.y as f32, point.z as f32, f32::from(hit.semantic), ring as f32];
        turn.bytes.extend(numbers.iter().flat_map(|number| number.to_le_bytes()));
        if let Some(actor) = hit.instance.checked_sub(1) {
            *turn.points.entry(actor).or_default() += 1;
        }
    }
    turn
}

/// Unit direction in the lidar frame; columns run clockwise from straight ahead.
fn beam(ring: u32, column: u32, columns: u32) -> DVec3 {
    let share = f64::from(ring) / f64::from(RINGS - 1);
    let elevation = (LOWEST_DEG + share * (HIGHEST_DEG - LOWEST_DEG)).to_radians();
    let azimuth = TAU * f64::from(column) / f64::from(columns);
    DVec3::new(azimuth.sin() * elevation.cos(), azimuth.cos() * elevation.cos(), elevation.sin())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_column_looks_ahead_and_the_lidar_frame_is_right_forward_up() {
        let ego_from_lidar = ego_from_lidar();
        let ahead = ego_from_lidar.transform_vector(beam(0, 0, 4)).normalize();
        assert!(ahead.x > 0.8 && ahead.y.abs() < 0.02 && ahead.z < -0.4, "{ahead}");
        let right = ego_from_lidar.transform_vector(beam(RINGS - 1, 1, 4));
        assert!(right.y < -0.9 && right.z > 0.1, "{right}");
    }
}
