//! A coarse 32-beam lidar in the procedural world: what detection evaluations count points with.

use std::f64::consts::TAU;

use geometry::Rigid;
use glam::DVec3;
use rayon::prelude::*;
use world::Snapshot;

/// Beams of a Velodyne HDL-32E, degrees above the horizon.
const RINGS: u32 = 32;
const LOWEST_DEG: f64 = -30.67;
const HIGHEST_DEG: f64 = 10.67;
/// Farthest return of that lidar, metres.
const RANGE_M: f64 = 70.0;

/// One point.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Return {
    /// Beam, lowest first.
    pub(crate) ring: u8,
    /// Lidar frame: x right, y forward, z up; metres.
    pub(crate) point: DVec3,
    /// Semantic label: the world knows no reflectances.
    pub(crate) semantic: u8,
    /// Id of the actor that was hit.
    pub(crate) actor: Option<u32>,
}

/// Casts `columns` directions of all beams at one instant, clockwise from straight ahead. The order does not depend on the number of threads.
pub(crate) fn cast(snapshot: &Snapshot, world_from_lidar: &Rigid, columns: u32) -> Vec<Return> {
    let rays: Vec<(u32, u32)> = (0..columns).flat_map(|column| (0..RINGS).map(move |ring| (ring, column))).collect();
    let cast_one = |(ring, column): (u32, u32)| {
        let direction = beam(ring, column, columns);
        let hit = snapshot.raycast(world_from_lidar.translation, world_from_lidar.transform_vector(direction))?;
        let point = direction * hit.distance;
        let actor = hit.instance.checked_sub(1);
        (hit.distance <= RANGE_M).then_some(Return { ring: ring as u8, point, semantic: hit.semantic, actor })
    };
    let returns: Vec<_> = rays.into_par_iter().map(cast_one).collect();
    returns.into_iter().flatten().collect()
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
        let ahead = beam(0, 0, 4);
        assert!(ahead.y > 0.8 && ahead.x.abs() < 1e-12 && ahead.z < -0.4, "{ahead}");
        let right = beam(RINGS - 1, 1, 4);
        assert!(right.x > 0.9 && right.z > 0.1, "{right}");
    }
}
