//! The shared object classes and the native names that map onto them.

use serde::{Deserialize, Serialize};

/// Shared classes; the first ten are the nuScenes detection classes in their order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[allow(missing_docs, reason = "the names say it")]
pub enum ObjectClass {
    Car,
    Truck,
    Bus,
    Trailer,
    ConstructionVehicle,
    Motorcycle,
    Bicycle,
    Pedestrian,
    TrafficCone,
    Barrier,
    Sign,
    Animal,
    Other,
}

impl ObjectClass {
    /// All classes in index order.
    pub const ALL: [Self; 13] = [
        Self::Car,
        Self::Truck,
        Self::Bus,
        Self::Trailer,
        Self::ConstructionVehicle,
        Self::Motorcycle,
        Self::Bicycle,
        Self::Pedestrian,
        Self::TrafficCone,
        Self::Barrier,
        Self::Sign,
        Self::Animal,
        Self::Other,
    ];

    /// Position in the shared order, as layouts and metrics index it.
    pub const fn index(self) -> usize {
        self as usize
    }
}

/// What to do with a native category.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClassRule {
    /// Leave its boxes out.
    Drop,
    /// Give its boxes this class.
    #[serde(untagged)]
    As(ObjectClass),
}

/// The shared class of a nuScenes category name; `None` for a name the taxonomy has no rule for.
pub fn from_nuscenes(category: &str) -> Option<ObjectClass> {
    use ObjectClass::*;
    Some(match category {
        "vehicle.car" => Car,
        "vehicle.truck" => Truck,
        "vehicle.bus.bendy" | "vehicle.bus.rigid" => Bus,
        "vehicle.trailer" => Trailer,
        "vehicle.construction" => ConstructionVehicle,
        "vehicle.motorcycle" => Motorcycle,
        "vehicle.bicycle" => Bicycle,
        "human.pedestrian.adult"
        | "human.pedestrian.child"
        | "human.pedestrian.construction_worker"
        | "human.pedestrian.police_officer" => Pedestrian,
        "movable_object.trafficcone" => TrafficCone,
        "movable_object.barrier" => Barrier,
        "animal" => Animal,
        "human.pedestrian.wheelchair"
        | "human.pedestrian.stroller"
        | "human.pedestrian.personal_mobility"
        | "vehicle.emergency.ambulance"
        | "vehicle.emergency.police"
        | "movable_object.pushable_pullable"
        | "movable_object.debris"
        | "static_object.bicycle_rack" => Other,
        _ => return None,
    })
}

/// The shared class of a nuPlan category name; `None` for a name the taxonomy has no rule for. All motor vehicles are one category there.
pub fn from_nuplan(category: &str) -> Option<ObjectClass> {
    use ObjectClass::*;
    Some(match category {
        "vehicle" => Car,
        "bicycle" => Bicycle,
        "pedestrian" => Pedestrian,
        "traffic_cone" => TrafficCone,
        "barrier" => Barrier,
        "czone_sign" => Sign,
        "generic_object" => Other,
        _ => return None,
    })
}
