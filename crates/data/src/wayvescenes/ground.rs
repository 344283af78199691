//! Which way is up, and where the ground is: the dominant plane of sparse points below the cameras.

use geometry::glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::scale::median;

/// Points further than this from every forward camera do not tell about the road under the car, metres.
const REACH_M: f64 = 20.0;
/// Height of the forward camera above the road, metres: no car carries it lower or higher.
const CAMERA_HEIGHT_M: std::ops::Range<f64> = 0.5..3.5;
/// A point belongs to the plane within this distance, metres.
const INLIER_M: f64 = 0.1;
/// The cameras are mounted nearly level: the plane's normal lies this close to their mean up direction, cosine of 10 degrees.
const LEVEL_COSINE: f64 = 0.984_807_753_012_208;
/// Fewer points, or a smaller share of the candidates, are no dominant plane.
const FEWEST_INLIERS: usize = 12;
const SMALLEST_SHARE: f64 = 0.1;
/// Enough to meet three points of a plane that holds a fifth of the candidates with certainty of 98 %.
const TRIALS: usize = 500;
/// More points add time and no knowledge.
const MOST_POINTS: usize = 50_000;
const MOST_CANDIDATES: usize = 5_000;

/// `normal · p = offset`, normal upwards, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Plane {
    pub normal: DVec3,
    pub offset: f64,
    /// Points within 10 cm of it, among those looked at.
    pub inliers: usize,
}

impl Plane {
    /// Height of a point above the plane, metres.
    pub fn height(&self, point: DVec3) -> f64 {
        self.normal.dot(point) - self.offset
    }

    /// Median height of points above the plane, metres: over a hilly scene a single plane fits most of it only.
    pub fn median_height(&self, points: &[DVec3]) -> Option<f64> {
        let mut heights: Vec<f64> = points.iter().map(|point| self.height(*point)).collect();
        heights.sort_by(f64::total_cmp);
        median(&heights)
    }
}

/// The road under the cameras; `None` where the points show none. All lengths in metres, `up` a unit vector in their frame.
///
/// The same points give the same plane: the trials are drawn from a fixed seed.
pub(super) fn find_plane(points: &[DVec3], cameras: &[DVec3], up: DVec3) -> Option<Plane> {
    let near = candidates(points, cameras, up);
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let mut best: Option<Plane> = None;
    if near.len() < FEWEST_INLIERS {
        return None;
    }
    for _ in 0..TRIALS {
        let [a, b, c] = [(); 3].map(|()| near.get(rng.random_range(0..near.len())).copied().unwrap_or_default());
        let Some(normal) = (b - a).cross(c - a).try_normalize() else { continue };
        let normal = if normal.dot(up) < 0.0 { -normal } else { normal };
        if normal.dot(up) < LEVEL_COSINE {
            continue;
        }
        let plane = counted(normal, normal.dot(a), &near);
        if best.is_none_or(|best| plane.inliers > best.inliers) {
            best = Some(plane);
        }
    }
    let mut plane = best?;
    for _ in 0..3 {
        plane = refined(&plane, &near, up)?;
    }
    let dominant = plane.inliers >= FEWEST_INLIERS && plane.inliers as f64 >= SMALLEST_SHARE * near.len() as f64;
    let below = CAMERA_HEIGHT_M.contains(&plane.median_height(cameras)?);
    (dominant && below && plane.normal.dot(up) >= LEVEL_COSINE).then_some(plane)
}

/// Points below and around the cameras.
fn candidates(points: &[DVec3], cameras: &[DVec3], up: DVec3) -> Vec<DVec3> {
    let is_near = |point: &DVec3| {
        cameras.iter().any(|camera| {
            let offset = *point - *camera;
            let height = -offset.dot(up);
            let flat = offset + up * height;
            // A plane tilted by 10 degrees rises by 3.5 m over the reach, so far points are not held to the camera's height.
            flat.length_squared() <= REACH_M * REACH_M
                && height > 0.0
                && height < CAMERA_HEIGHT_M.end + 0.2 * flat.length()
        })
    };
    let thinned = thin(points, MOST_POINTS).filter(is_near).collect::<Vec<_>>();
    thin(&thinned, MOST_CANDIDATES).collect()
}

/// At most so many, evenly over the list.
fn thin(points: &[DVec3], most: usize) -> impl Iterator<Item = DVec3> + '_ {
    points.iter().copied().step_by(points.len().div_ceil(most).max(1))
}

fn counted(normal: DVec3, offset: f64, points: &[DVec3]) -> Plane {
    let mut plane = Plane { normal, offset, inliers: 0 };
    plane.inliers = points.iter().filter(|point| plane.height(**point).abs() < INLIER_M).count();
    plane
}

/// The plane of least squares, heights measured along `up`, through the points that belong to this one.
fn refined(plane: &Plane, points: &[DVec3], up: DVec3) -> Option<Plane> {
    let own: Vec<DVec3> = points.iter().copied().filter(|point| plane.height(*point).abs() < INLIER_M).collect();
    let mean = own.iter().sum::<DVec3>() / own.len() as f64;
    let (east, north) = up.any_orthonormal_pair();
    let [mut xx, mut xy, mut yy, mut xz, mut yz] = [0.0; 5];
    for point in &own {
        let offset = *point - mean;
        let (x, y, z) = (offset.dot(east), offset.dot(north), offset.dot(up));
        xx += x * x;
        xy += x * y;
        yy += y * y;
        xz += x * z;
        yz += y * z;
    }
    let determinant = xx * yy - xy * xy;
    // Points on one line carry a plane in any direction.
    if determinant <= 1e-9 * (xx + yy).powi(2) {
        return None;
    }
    let (slope_x, slope_y) = ((xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant);
    let normal = (up - slope_x * east - slope_y * north).try_normalize()?;
    Some(counted(normal, normal.dot(mean), points))
}

#[cfg(test)]
mod tests {
    use geometry::glam::DQuat;

    use super::*;

    /// A road at z = 0, walls and clutter around it, seen from 1.4 m above.
    fn street() -> (Vec<DVec3>, Vec<DVec3>) {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut at = |range: f64| rng.random_range(-range..range);
        let mut points: Vec<DVec3> = (0..300).map(|_| DVec3::new(at(15.0), at(6.0), at(0.03))).collect();
        points.extend((0..400).map(|_| DVec3::new(at(15.0), at(15.0), 3.0 + at(2.9))));
        points.extend((0..200).map(|_| DVec3::new(at(500.0), at(500.0), -20.0 + at(10.0))));
        let cameras = (0..5).map(|i| DVec3::new(f64::from(i), 0.0, 1.4)).collect();
        (points, cameras)
    }

    #[test]
    fn the_road_is_found_in_any_world_and_from_a_tilted_guess() {
        let (points, cameras) = street();
        for (turn, tilt) in
            [(DQuat::IDENTITY, 0.0), (DQuat::from_rotation_x(2.1), 0.1), (DQuat::from_rotation_y(-1.0), 0.14)]
        {
            let moved = |p: &DVec3| turn * *p + DVec3::new(10.0, -20.0, 5.0);
            let points: Vec<DVec3> = points.iter().map(moved).collect();
            let cameras: Vec<DVec3> = cameras.iter().map(moved).collect();
            let guess = turn * (DQuat::from_rotation_x(tilt) * DVec3::Z);
            let plane = find_plane(&points, &cameras, guess).unwrap();
            assert!(plane.normal.angle_between(turn * DVec3::Z).to_degrees() < 0.1, "{plane:?}");
            assert!(plane.inliers >= 300);
            for camera in cameras {
                assert!((plane.height(camera) - 1.4).abs() < 0.02);
            }
        }
    }

    #[test]
    fn where_there_is_no_road_there_is_no_plane() {
        let (points, cameras) = street();
        let far: Vec<DVec3> = points.iter().map(|p| *p + DVec3::X * 100.0).collect();
        assert_eq!(find_plane(&far, &cameras, DVec3::Z), None);
        assert_eq!(find_plane(&[], &cameras, DVec3::Z), None);
        assert_eq!(find_plane(&points, &cameras, DVec3::Y), None);
        let line: Vec<DVec3> = (0..40).map(|i| DVec3::new(f64::from(i) * 0.2, 0.0, 0.0)).collect();
        assert_eq!(find_plane(&line, &cameras, DVec3::Z), None);
    }
}
