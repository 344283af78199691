//! Boxes of a log in the UTM frame, and their tracks.

use std::collections::BTreeMap;

use geometry::Rigid;
use geometry::glam::DVec3;

use super::plan::{Plan, PlannedFrame, Tokens};
use super::rows::{Rows, row};
use super::schema::CATEGORIES;
use crate::nuplan::Token;
use crate::{DataError, ObjectBox, ObjectClass};

/// A box at one lidar turn.
struct Sighting<'a> {
    token: Token,
    lidar: Token,
    planned: &'a PlannedFrame<'a>,
    found: &'a ObjectBox,
}

/// Appends tracks and boxes.
pub(super) fn add(plan: &Plan<'_>, tokens: Tokens, rows: &mut Rows) -> Result<(), DataError> {
    let mut tracks: BTreeMap<&str, Vec<Sighting<'_>>> = BTreeMap::new();
    for planned in &plan.frames {
        let (Some(lidar), Some(boxes)) = (planned.lidar, &planned.frame.boxes) else { continue };
        for (at, found) in boxes.iter().enumerate() {
            check(found, planned)?;
            let token = tokens.of("lidar_box", &format!("{}/{lidar}/{at}", plan.name));
            tracks.entry(&found.track).or_default().push(Sighting { token, lidar, planned, found });
        }
    }
    for (track, sightings) in &tracks {
        add_track(plan, tokens, track, sightings, rows)?;
    }
    Ok(())
}

fn check(found: &ObjectBox, planned: &PlannedFrame<'_>) -> Result<(), DataError> {
    let b = &found.box3d;
    let finite =
        b.center.is_finite() && b.yaw.is_finite() && found.velocity.is_none_or(|v| v.iter().all(|v| v.is_finite()));
    if finite && b.size.is_finite() && b.size.cmpgt(DVec3::ZERO).all() {
        return Ok(());
    }
    let id = &planned.frame.id;
    Err(DataError::Config(format!("frame {} of {} has a box that is none: {b:?}", id.frame, id.scene)))
}

fn add_track(
    plan: &Plan<'_>,
    tokens: Tokens,
    track: &str,
    sightings: &[Sighting<'_>],
    rows: &mut Rows,
) -> Result<(), DataError> {
    let Some(first) = sightings.first() else { return Ok(()) };
    let category = category(first.found);
    if let Some(other) = sightings.iter().map(|seen| self::category(seen.found)).find(|other| *other != category) {
        return Err(DataError::Config(format!("track {track} of {} is {category} and {other}", plan.name)));
    }
    let token = tokens.kept("track", track, &plan.name);
    let size = first.found.box3d.size;
    rows.push("track", row![token, tokens.of("category", category), size.y, size.x, size.z]);
    for (at, seen) in sightings.iter().enumerate() {
        let neighbour = |at: Option<usize>| at.and_then(|at| sightings.get(at)).map(|seen| seen.token);
        let (next, previous) = (neighbour(Some(at + 1)), neighbour(at.checked_sub(1)));
        let utm_from_ego = &seen.planned.utm_from_ego;
        let b = &seen.found.box3d;
        let (center, size) = (*utm_from_ego * b.center, b.size);
        let heading = level(utm_from_ego, [b.yaw.cos(), b.yaw.sin()]);
        let velocity = seen.found.velocity.map(|velocity| level(utm_from_ego, velocity));
        let (vx, vy, vz) = (velocity.map(|v| v.x), velocity.map(|v| v.y), velocity.map(|_| 0.0));
        let keys = row![seen.token, seen.lidar, token, next, previous];
        let shape = row![center.x, center.y, center.z, size.y, size.x, size.z];
        let motion = row![vx, vy, vz, heading.y.atan2(heading.x), 1.0];
        rows.push("lidar_box", [keys, shape, motion].concat());
    }
    Ok(())
}

/// The level vector of the world whose first two coordinates in the ego frame are these. The layout knows only level headings; turning the ego
/// vector alone would lose its direction by the square of the car's tilt.
fn level(utm_from_ego: &Rigid, [x, y]: [f64; 2]) -> DVec3 {
    let up = utm_from_ego.rotation.inverse() * DVec3::Z;
    // A car on its side has no level vectors of that kind; its heading is what it is.
    let z = if up.z.abs() < 0.1 { 0.0 } else { -(up.x * x + up.y * y) / up.z };
    utm_from_ego.transform_vector(DVec3::new(x, y, z))
}

/// The layout's name: the box's own where it is one, else that of its class. All motor vehicles are one category.
fn category(found: &ObjectBox) -> &'static str {
    if let Some(own) = CATEGORIES.into_iter().find(|name| *name == found.source_class) {
        return own;
    }
    match found.class {
        ObjectClass::Car
        | ObjectClass::Truck
        | ObjectClass::Bus
        | ObjectClass::Trailer
        | ObjectClass::ConstructionVehicle
        | ObjectClass::Motorcycle => "vehicle",
        ObjectClass::Bicycle => "bicycle",
        ObjectClass::Pedestrian => "pedestrian",
        ObjectClass::TrafficCone => "traffic_cone",
        ObjectClass::Barrier => "barrier",
        ObjectClass::Sign => "czone_sign",
        ObjectClass::Animal | ObjectClass::Other => "generic_object",
    }
}

#[cfg(test)]
mod tests {
    use geometry::glam::DQuat;

    use super::*;

    #[test]
    fn level_vectors_keep_their_direction_in_a_tilted_car() {
        let tilt = DQuat::from_rotation_z(0.7) * DQuat::from_rotation_y(0.2) * DQuat::from_rotation_x(-0.15);
        let utm_from_ego = Rigid::new(tilt, DVec3::new(664_430.0, 3_997_650.0, 606.0));
        for yaw in [-3.0_f64, -0.4, 0.0, 1.0, 2.5] {
            let vector = level(&utm_from_ego, [yaw.cos(), yaw.sin()]);
            assert!(vector.z.abs() < 1e-15);
            let back = utm_from_ego.inverse().transform_vector(vector);
            assert!((back.truncate() - geometry::glam::DVec2::new(yaw.cos(), yaw.sin())).length() < 1e-15);
        }
    }

    #[test]
    fn every_class_has_a_category_the_reader_knows() {
        for class in ObjectClass::ALL {
            let found = ObjectBox {
                box3d: geometry::Box3d { center: DVec3::ZERO, size: DVec3::ONE, yaw: 0.0 },
                class,
                track: String::new(),
                source_class: "vehicle.car".into(),
                velocity: None,
                attributes: Vec::new(),
                points: None,
                visibility: None,
                interpolated: false,
            };
            let back = crate::taxonomy::from_nuplan(category(&found)).unwrap();
            let motor = class.index() <= ObjectClass::Motorcycle.index();
            let coarse = match class {
                ObjectClass::Animal => ObjectClass::Other,
                _ if motor => ObjectClass::Car,
                other => other,
            };
            assert_eq!(back, coarse);
            assert_eq!(category(&ObjectBox { source_class: "czone_sign".into(), ..found }), "czone_sign");
        }
    }
}
