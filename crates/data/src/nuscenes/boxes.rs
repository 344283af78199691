//! Boxes at any instant: as annotated at the samples, interpolated between them, with velocities.

use geometry::glam::{DQuat, DVec3};
use geometry::{Box3d, Rigid};

use super::annotations::{Annotation, Annotations};
use super::config::BoxMode;
use super::tables::Base;
use crate::{ObjectBox, ObjectClass};

/// A box with its full rotation in the world frame; [`ObjectBox`] is upright in the ego frame, which costs up to two pixels because
/// the car rolls and pitches.
#[derive(Debug, Clone, PartialEq)]
pub struct WorldBox {
    /// Box axes (x forward, y left, z up, origin at the centre) to world.
    pub world_from_box: Rigid,
    /// Length, width, height, metres.
    pub size: DVec3,
    /// Shared taxonomy.
    pub class: ObjectClass,
    /// The dataset's own class name.
    pub source_class: String,
    /// Instance token.
    pub track: String,
    /// Token of the annotation the box or its later end comes from.
    pub annotation: String,
    /// m/s in world axes, over ground; `None` where undefined.
    pub velocity: Option<DVec3>,
    /// Attribute names.
    pub attributes: Vec<String>,
    /// Lidar points inside.
    pub lidar_points: Option<u32>,
    /// Radar points inside.
    pub radar_points: Option<u32>,
    /// 1 (hardly visible) to 4.
    pub visibility: Option<u8>,
    /// True for a box that is not itself annotated at this instant.
    pub interpolated: bool,
}

impl WorldBox {
    /// The eight corners in world, in the order of [`Box3d::corners`].
    pub fn corners(&self) -> [DVec3; 8] {
        let upright = Box3d { center: DVec3::ZERO, size: self.size, yaw: 0.0 };
        upright.corners().map(|corner| self.world_from_box * corner)
    }

    /// The box in the ego frame of an instant.
    pub fn in_ego(&self, world_from_ego: &Rigid) -> ObjectBox {
        let ego_from_world = world_from_ego.inverse();
        let ego_from_box = ego_from_world * self.world_from_box;
        let velocity = self.velocity.map(|velocity| {
            let velocity = ego_from_world.transform_vector(velocity);
            [velocity.x, velocity.y]
        });
        ObjectBox {
            box3d: Box3d { center: ego_from_box.translation, size: self.size, yaw: ego_from_box.yaw() },
            class: self.class,
            track: self.track.clone(),
            source_class: self.source_class.clone(),
            velocity,
            attributes: self.attributes.clone(),
            points: self.lidar_points,
            visibility: self.visibility,
            interpolated: self.interpolated,
        }
    }
}

/// Longest time between two annotations whose difference still is a velocity: the devkit's limit, doubled when the box lies between.
const MAX_STEP_SECS: f64 = 1.5;

/// The boxes of a sample as annotated.
pub(super) fn at_sample(annotations: &Annotations, base: &Base, sample: usize) -> Vec<WorldBox> {
    let rows = &annotations.rows[annotations.by_sample[sample].clone()];
    rows.iter().filter_map(|row| world_box(annotations, row, velocity(annotations, base, row), false)).collect()
}

/// The boxes of an instant at or before sample `after` and behind its predecessor in the scene; `None` where nothing is defined.
pub(super) fn before_sample(
    annotations: &Annotations,
    base: &Base,
    after: usize,
    time_ns: i64,
    mode: BoxMode,
) -> Option<Vec<WorldBox>> {
    let scene = &base.scenes[base.samples[after].scene as usize];
    let rows = &annotations.rows[annotations.by_sample[after].clone()];
    let unmoved = |row: &Annotation| world_box(annotations, row, velocity(annotations, base, row), true);
    if after == scene.samples.start {
        return (mode == BoxMode::Devkit).then(|| rows.iter().filter_map(unmoved).collect());
    }
    let (start_ns, end_ns) = (base.samples[after - 1].time_ns, base.samples[after].time_ns);
    let amount = if end_ns > start_ns { (time_ns - start_ns) as f64 / (end_ns - start_ns) as f64 } else { 1.0 };
    let amount = amount.clamp(0.0, 1.0);
    let boxes = rows.iter().filter_map(|row| {
        let previous = row.before.map(|before| &annotations.rows[before as usize]);
        match previous.filter(|previous| previous.sample as usize == after - 1) {
            Some(previous) => {
                let secs = (end_ns - start_ns) as f64 * 1e-9;
                let velocity = (secs > 0.0 && secs <= MAX_STEP_SECS).then(|| (row.center - previous.center) / secs);
                let from = pose(previous.rotation, previous.center);
                let moved = from.interpolate(&pose(row.rotation, row.center), amount);
                let row = Annotation { center: moved.translation, rotation: moved.rotation, ..*row };
                world_box(annotations, &row, velocity, true)
            }
            None if mode == BoxMode::Devkit => unmoved(row),
            None => None,
        }
    });
    Some(boxes.collect())
}

fn pose(rotation: DQuat, translation: DVec3) -> Rigid {
    Rigid { rotation, translation }
}

/// From the neighbours in the track, one-sided at its ends; the neighbours may skip samples.
fn velocity(annotations: &Annotations, base: &Base, row: &Annotation) -> Option<DVec3> {
    let at = |link: Option<u32>| link.map_or(row, |link| &annotations.rows[link as usize]);
    let (first, last) = (at(row.before), at(row.after));
    let time = |row: &Annotation| base.samples[row.sample as usize].time_ns;
    let secs = (time(last) - time(first)) as f64 * 1e-9;
    let limit = if row.before.is_some() && row.after.is_some() { 2.0 * MAX_STEP_SECS } else { MAX_STEP_SECS };
    (secs > 0.0 && secs <= limit).then(|| (last.center - first.center) / secs)
}

/// `None` for a class that the config drops.
fn world_box(
    annotations: &Annotations,
    row: &Annotation,
    velocity: Option<DVec3>,
    interpolated: bool,
) -> Option<WorldBox> {
    let (source_class, class) = annotations.category(row);
    Some(WorldBox {
        world_from_box: pose(row.rotation, row.center),
        size: row.size,
        class: class?,
        source_class: source_class.to_owned(),
        track: annotations.instances[row.instance as usize].token.to_string(),
        annotation: annotations.token(row),
        velocity,
        attributes: annotations.attributes(row).to_vec(),
        lidar_points: row.lidar_points,
        radar_points: row.radar_points,
        visibility: row.visibility,
        interpolated,
    })
}
