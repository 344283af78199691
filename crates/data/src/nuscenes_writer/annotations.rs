//! Boxes of a scene: which actors are annotated, as what, and the chains of their instances.
//!
//! An actor is annotated at a key frame when a picture shows a pixel of it or the lidar meets it, as annotators can only draw what
//! sensors saw; so chains may skip samples.

use std::collections::BTreeMap;

use world::{ActorClass, ActorState};

use super::scene::{Evidence, Scene, sample_token, secs};
use super::tables::{AnnotationRow, InstanceRow, Tables, neighbours};
use super::tokens::TokenSpace;

/// Farthest annotated centre from the car, metres; lidar returns of the real sensor end about there.
pub(super) const RANGE_M: f64 = 80.0;
/// Slower actors count as standing, m/s.
const STANDING_MPS: f64 = 0.2;
/// Smaller people are children, metres.
const CHILD_HEIGHT_M: f64 = 1.4;

/// An annotation before its neighbours are known.
struct Sighting {
    sample: usize,
    state: ActorState,
}

/// Appends the annotations and instances of one scene.
pub(super) fn add(
    tokens: &TokenSpace,
    scene: &Scene<'_>,
    samples_us: &[i64],
    evidence: &[Evidence],
    tables: &mut Tables,
) {
    let mut tracks: BTreeMap<u32, Vec<Sighting>> = BTreeMap::new();
    for (sample, (time_us, evidence)) in samples_us.iter().zip(evidence).enumerate() {
        let ego = scene.world.world_from_ego(secs(*time_us)).translation;
        for state in scene.world.actors_at(secs(*time_us)) {
            let near = state.world_box.center.distance(ego) <= RANGE_M;
            let seen = evidence.sights.get(&state.id).is_some_and(|sight| sight.seen > 0.0);
            if near && (seen || evidence.lidar_points.contains_key(&state.id)) {
                tracks.entry(state.id).or_default().push(Sighting { sample, state });
            }
        }
    }
    for (actor, sightings) in &tracks {
        add_track(tokens, scene, *actor, sightings, evidence, tables);
    }
}

fn add_track(
    tokens: &TokenSpace,
    scene: &Scene<'_>,
    actor: u32,
    sightings: &[Sighting],
    evidence: &[Evidence],
    tables: &mut Tables,
) {
    let name =
        |sighting: &Sighting| tokens.token("sample_annotation", &format!("{}/{actor}/{}", scene.name, sighting.sample));
    let chain: Vec<String> = sightings.iter().map(name).collect();
    let (Some(first), Some(last), Some(start)) = (chain.first(), chain.last(), sightings.first()) else { return };
    let instance_token = tokens.token("instance", &format!("{}/{actor}", scene.name));
    for (index, Sighting { sample, state }) in sightings.iter().enumerate() {
        let (prev, next) = neighbours(&chain, index);
        let evidence = &evidence[*sample];
        let (size, half_yaw) = (state.world_box.size, 0.5 * state.world_box.yaw);
        tables.sample_annotation.push(AnnotationRow {
            token: chain[index].clone(),
            sample_token: sample_token(tokens, scene, *sample),
            instance_token: instance_token.clone(),
            visibility_token: evidence.sights.get(&actor).copied().unwrap_or_default().token().to_owned(),
            attribute_tokens: attribute(state).map(|name| tokens.token("attribute", name)).into_iter().collect(),
            translation: (state.world_box.center + scene.map_from_world.extend(0.0)).to_array(),
            size: [size.y, size.x, size.z],
            rotation: [half_yaw.cos(), 0.0, 0.0, half_yaw.sin()],
            prev,
            next,
            num_lidar_pts: evidence.lidar_points.get(&actor).copied().unwrap_or(0),
            num_radar_pts: 0,
        });
    }
    tables.instance.push(InstanceRow {
        token: instance_token,
        category_token: tokens.token("category", category(&start.state)),
        nbr_annotations: chain.len(),
        first_annotation_token: first.clone(),
        last_annotation_token: last.clone(),
    });
}

/// The release's category name.
fn category(state: &ActorState) -> &'static str {
    match state.class {
        ActorClass::Car => "vehicle.car",
        ActorClass::Truck => "vehicle.truck",
        ActorClass::Bus => "vehicle.bus.rigid",
        ActorClass::Trailer => "vehicle.trailer",
        ActorClass::ConstructionVehicle => "vehicle.construction",
        ActorClass::Motorcycle => "vehicle.motorcycle",
        ActorClass::Bicycle => "vehicle.bicycle",
        ActorClass::Pedestrian if state.world_box.size.z < CHILD_HEIGHT_M => "human.pedestrian.child",
        ActorClass::Pedestrian => "human.pedestrian.adult",
        ActorClass::TrafficCone => "movable_object.trafficcone",
        ActorClass::Barrier => "movable_object.barrier",
    }
}

/// The release's attribute name, for classes that have one.
fn attribute(state: &ActorState) -> Option<&'static str> {
    let moves = state.velocity.length() > STANDING_MPS;
    Some(match state.class {
        ActorClass::TrafficCone | ActorClass::Barrier => return None,
        ActorClass::Motorcycle | ActorClass::Bicycle if state.with_rider => "cycle.with_rider",
        ActorClass::Motorcycle | ActorClass::Bicycle => "cycle.without_rider",
        ActorClass::Pedestrian if moves => "pedestrian.moving",
        ActorClass::Pedestrian => "pedestrian.standing",
        _ if state.parked => "vehicle.parked",
        _ if moves => "vehicle.moving",
        _ => "vehicle.stopped",
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Box3d;
    use glam::{DVec2, DVec3};

    #[test]
    fn attributes_and_categories_are_names_of_the_tables() {
        let tables = Tables::with_vocabulary(&TokenSpace::new("v1.0-mini", 0));
        for class in ActorClass::ALL {
            for speed in [0.0, 3.0] {
                let state = ActorState {
                    id: 0,
                    class,
                    world_box: Box3d { center: DVec3::ZERO, size: DVec3::ONE, yaw: 0.0 },
                    velocity: DVec2::new(speed, 0.0),
                    parked: false,
                    with_rider: true,
                };
                assert!(tables.category.iter().any(|row| row.name == category(&state)));
                let shared = crate::taxonomy::from_nuscenes(category(&state)).unwrap();
                assert_eq!(shared.index(), class.index());
                if let Some(name) = attribute(&state) {
                    assert!(tables.attribute.iter().any(|row| row.name == name));
                }
            }
        }
    }
}
