//! Sparse points on the ground around the car, with the pictures that see them: readers take up and height from them.

use std::collections::BTreeMap;

use geometry::Rigid;
use geometry::glam::DVec3;

use super::config::WayveScenesWriterConfig;
use super::scene::Shot;
use crate::colmap::{Model, Point2d, Point3d, TrackElement};

/// Points along each axis, and the distance between them, metres.
const GRID: i32 = 5;
const SPACING_M: f64 = 3.0;
/// Pictures of so many frames before and after are asked whether they see a point.
const NEIGHBOUR_FRAMES: usize = 2;
const GREY: [u8; 3] = [128; 3];

/// Adds a grid for every frame; a point that no picture sees is left out.
pub(super) fn add_points(config: &WayveScenesWriterConfig, shots: &[Shot<'_>], model: &mut Model) {
    let cars: BTreeMap<usize, Rigid> = shots.iter().map(|shot| (shot.frame_index, shot.frame.world_from_ego)).collect();
    for (frame, world_from_ego) in cars {
        let near = |shot: &&(usize, &Shot<'_>)| shot.1.frame_index.abs_diff(frame) <= NEIGHBOUR_FRAMES;
        let numbered: Vec<(usize, &Shot<'_>)> = shots.iter().enumerate().collect();
        let near: Vec<(usize, &Shot<'_>)> = numbered.iter().filter(near).copied().collect();
        for point in grid(config.ground_below_ego_m) {
            add_point(world_from_ego * point, config.units_per_metre, &near, model);
        }
    }
}

/// Ego frame, metres.
fn grid(below_m: f64) -> impl Iterator<Item = DVec3> {
    let at = |i: i32| f64::from(i - GRID / 2) * SPACING_M;
    (0..GRID).flat_map(move |x| (0..GRID).map(move |y| DVec3::new(at(x), at(y), -below_m)))
}

fn add_point(world: DVec3, units_per_metre: f64, shots: &[(usize, &Shot<'_>)], model: &mut Model) {
    let id = model.points.len() as u64 + 1;
    let mut track = Vec::new();
    for (at, shot) in shots {
        let seen = shot.camera.project(shot.world_from_cam.inverse() * world);
        let Some(pixel) = seen.filter(|pixel| shot.camera.intrinsics.contains(*pixel)) else { continue };
        let Some(image) = model.images.get_mut(*at) else { continue };
        track.push(TrackElement { image_id: image.id, point2d_index: image.points.len() as u32 });
        image.points.push(Point2d { xy: pixel.to_array(), point3d_id: Some(id) });
    }
    if !track.is_empty() {
        let xyz = (world * units_per_metre).to_array();
        model.points.push(Point3d { id, xyz, rgb: GREY, error: 0.0, track });
    }
}
