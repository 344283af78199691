//! One sentence about a world, made from what is in it.

use crate::actor::ActorClass;
use crate::config::{Conditions, TimeOfDay, TrafficSide, Weather};
use crate::network::Network;
use crate::script::Actor;

/// Describes a world.
pub fn caption(conditions: &Conditions, network: &Network, actors: &[Actor]) -> String {
    let when = match (conditions.time_of_day, conditions.weather) {
        (TimeOfDay::Day, Weather::Clear) => "Sunny day",
        (TimeOfDay::Day, Weather::Overcast) => "Overcast day",
        (TimeOfDay::Day, Weather::Rain) => "Rainy day",
        (TimeOfDay::Dusk, Weather::Clear) => "Clear dusk",
        (TimeOfDay::Dusk, Weather::Overcast) => "Overcast dusk",
        (TimeOfDay::Dusk, Weather::Rain) => "Rainy dusk",
        (TimeOfDay::Night, Weather::Clear) => "Clear night",
        (TimeOfDay::Night, Weather::Overcast) => "Overcast night",
        (TimeOfDay::Night, Weather::Rain) => "Rainy night",
    };
    let lanes = if network.main().lanes > 1 { "four-lane road" } else { "two-lane road" };
    let bend = network.main().curve.pieces.iter().find(|p| p.curvature != 0.0);
    let bend = if bend.is_some_and(|p| p.curvature > 0.0) { "left" } else { "right" };
    let mut parts = vec![when.to_string(), format!("{lanes} with a bend to the {bend}")];
    parts.push(if network.junctions.iter().any(|j| j.left && j.right) { "intersection" } else { "T-junction" }.into());
    if network.carpark.is_some() {
        parts.push("car park".into());
    }
    let count = |test: &dyn Fn(&Actor) -> bool| actors.iter().filter(|a| test(a)).count();
    let vehicle = |a: &Actor| a.class <= ActorClass::Motorcycle;
    if count(&|a| vehicle(a) && a.parked) > 3 {
        parts.push("parked cars".into());
    }
    if count(&|a| a.class == ActorClass::Barrier) > 0 {
        parts.push("construction zone".into());
    }
    let moving = count(&|a| vehicle(a) && !a.parked && !a.motion.is_still());
    parts.push(match moving {
        0 => "no traffic".into(),
        1..=9 => "light traffic".into(),
        10..=24 => "moderate traffic".into(),
        _ => "dense traffic".to_string(),
    });
    for (class, word) in [
        (ActorClass::Bus, "bus"),
        (ActorClass::Truck, "truck"),
        (ActorClass::Pedestrian, "pedestrians"),
        (ActorClass::Bicycle, "cyclist"),
    ] {
        if count(&|a| a.class == class && !a.parked) > 0 {
            parts.push(word.into());
        }
    }
    if conditions.traffic_side == TrafficSide::Left {
        parts.push("left-hand traffic".into());
    }
    parts.join(", ")
}
