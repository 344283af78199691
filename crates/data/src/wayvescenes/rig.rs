//! From COLMAP's world to a car: metric scale, up, the ground, and where each camera is mounted.
//!
//! The dataset defines no car frame, so this reader does: x along the forward camera's optical axis, level; z away from the ground;
//! the origin on the ground below the forward camera.

use std::collections::BTreeMap;
use std::path::Path;

use geometry::glam::{DMat3, DQuat, DVec3};
use geometry::{GeometryError, Rigid};

use super::REFERENCE_CHANNEL;
use super::config::Scale;
use super::ground::find_plane;
use super::scale::{Baselines, choose, median};
use super::sets::Set;
use crate::{DataError, colmap};

/// Height of the forward camera where no ground is found, metres.
const ASSUMED_HEIGHT_M: f64 = 1.5;

/// How a scene was brought to metres and to a car.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Measured {
    /// The region whose baselines fit; `None` where the scale was given.
    pub region: Option<String>,
    pub metres_per_unit: f64,
    /// Turns COLMAP's world upright.
    pub upright: DQuat,
    /// Height of the forward camera above the ground, metres.
    pub camera_height_m: f64,
    /// Sparse points that carry the ground; `None` where its height was assumed.
    pub ground_points: Option<usize>,
    /// Mounting poses by channel.
    pub ego_from_cam: BTreeMap<String, Rigid>,
}

impl Measured {
    /// A pose of COLMAP's world in metres, z up.
    pub fn upright_metric(&self, pose: &Rigid) -> Rigid {
        Rigid::new(self.upright * pose.rotation, self.upright * (pose.translation * self.metres_per_unit))
    }
}

/// Measures a scene. `path` is the file of the poses, for messages.
pub(super) fn measure(
    sets: &[Set],
    points: &[colmap::Point3d],
    scale: Scale,
    baselines: &Baselines,
    path: &Path,
) -> Result<Measured, DataError> {
    let fronts = fronts(sets, path)?;
    let (region, metres) = match scale {
        Scale::MetresPerUnit(metres_per_unit) => (None, metres_per_unit),
        Scale::Baselines => {
            let fit = choose(baselines, &distances(sets), path)?;
            (Some(fit.region), fit.metres_per_unit)
        }
    };
    let no_up = || {
        let source = GeometryError::NotPositive { what: "mean up direction of the cameras", value: 0.0 };
        DataError::Calibration { row: REFERENCE_CHANNEL.to_owned(), source, path: path.to_owned() }
    };
    let level = level(sets).ok_or_else(no_up)?;
    let centres: Vec<DVec3> = fronts.iter().map(|pose| pose.translation * metres).collect();
    let points: Vec<DVec3> = points.iter().map(|point| DVec3::from_array(point.xyz) * metres).collect();
    let plane = find_plane(&points, &centres, level);
    let up = plane.map_or(level, |plane| plane.normal);
    let camera_height_m = plane.and_then(|plane| plane.median_height(&centres)).unwrap_or(ASSUMED_HEIGHT_M);
    let ego_from_front = ego_from_front(&fronts, up, camera_height_m).ok_or_else(no_up)?;
    let mounted = |(channel, pose): (String, Rigid)| {
        (channel, ego_from_front * Rigid::new(pose.rotation, pose.translation * metres))
    };
    Ok(Measured {
        region,
        metres_per_unit: metres,
        upright: DQuat::from_rotation_arc(up, DVec3::Z),
        camera_height_m,
        ground_points: plane.map(|plane| plane.inliers),
        ego_from_cam: front_from_cam(sets).into_iter().map(mounted).collect(),
    })
}

/// Poses of the forward camera, to which every other camera must have been seen.
fn fronts(sets: &[Set], path: &Path) -> Result<Vec<Rigid>, DataError> {
    let bad = |why: String| DataError::Format { format: "WayveScenes101", why, path: path.to_owned() };
    let fronts: Vec<Rigid> = sets.iter().filter_map(|set| Some(set.get(REFERENCE_CHANNEL)?.world_from_cam)).collect();
    if fronts.is_empty() {
        return Err(bad(format!("no picture of {REFERENCE_CHANNEL}, from which the car's frame is taken")));
    }
    match super::sets::strangers(sets, REFERENCE_CHANNEL).first() {
        Some(stranger) => Err(bad(format!(
            "no picture of {stranger} belongs to one of {REFERENCE_CHANNEL}; is `pairing_window_ms` too small?"
        ))),
        None => Ok(fronts),
    }
}

/// Minus the mean of all cameras' y axes: they are mounted nearly level.
fn level(sets: &[Set]) -> Option<DVec3> {
    let down: DVec3 =
        sets.iter().flat_map(|set| set.values()).map(|picture| picture.world_from_cam.transform_vector(DVec3::Y)).sum();
    (-down).try_normalize()
}

/// The mounting pose of the forward camera: level on average over the scene.
fn ego_from_front(fronts: &[Rigid], up: DVec3, height_m: f64) -> Option<Rigid> {
    let up_in_front: DVec3 = fronts.iter().map(|pose| pose.inverse().transform_vector(up)).sum();
    let z = up_in_front.try_normalize()?;
    let x = (DVec3::Z - z * z.z).try_normalize()?;
    let front_from_ego = DMat3::from_cols(x, z.cross(x), z);
    Some(Rigid::new(DQuat::from_mat3(&front_from_ego.transpose()), DVec3::Z * height_m))
}

/// For each camera its pose in the forward camera's frame at every instant both have a picture.
fn relative_poses(sets: &[Set]) -> BTreeMap<String, Vec<Rigid>> {
    let mut poses: BTreeMap<String, Vec<Rigid>> = BTreeMap::new();
    for set in sets {
        let Some(front) = set.get(REFERENCE_CHANNEL) else { continue };
        let front_from_world = front.world_from_cam.inverse();
        for (channel, picture) in set {
            poses.entry(channel.clone()).or_default().push(front_from_world * picture.world_from_cam);
        }
    }
    poses
}

/// Median distances of the other cameras to the forward one, COLMAP units.
fn distances(sets: &[Set]) -> BTreeMap<String, f64> {
    let others = relative_poses(sets).into_iter().filter(|(channel, _)| channel != REFERENCE_CHANNEL);
    let distance = |(channel, poses): (String, Vec<Rigid>)| {
        let mut all: Vec<f64> = poses.iter().map(|pose| pose.translation.length()).collect();
        all.sort_by(f64::total_cmp);
        Some((channel, median(&all)?))
    };
    others.filter_map(distance).collect()
}

/// The rig is rigid: median translation and mean rotation over the scene, COLMAP units.
fn front_from_cam(sets: &[Set]) -> BTreeMap<String, Rigid> {
    let average = |(channel, poses): (String, Vec<Rigid>)| {
        let middle = |axis: fn(&DVec3) -> f64| {
            let mut all: Vec<f64> = poses.iter().map(|pose| axis(&pose.translation)).collect();
            all.sort_by(f64::total_cmp);
            median(&all)
        };
        let translation = DVec3::new(middle(|t| t.x)?, middle(|t| t.y)?, middle(|t| t.z)?);
        let first = poses.first()?.rotation;
        // q and -q are one rotation; on one side of the first their sum is their mean for nearly equal rotations.
        let sum = poses.iter().map(|pose| pose.rotation).fold(DQuat::from_xyzw(0.0, 0.0, 0.0, 0.0), |sum, rotation| {
            if rotation.dot(first) < 0.0 { sum - rotation } else { sum + rotation }
        });
        Some((channel, Rigid::new(sum, translation)))
    };
    relative_poses(sets).into_iter().filter_map(average).collect()
}
