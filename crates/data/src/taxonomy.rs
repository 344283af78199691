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

    /// The name in files, configs and layouts.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Car => "car",
            Self::Truck => "truck",
            Self::Bus => "bus",
            Self::Trailer => "trailer",
            Self::ConstructionVehicle => "construction_vehicle",
            Self::Motorcycle => "motorcycle",
            Self::Bicycle => "bicycle",
            Self::Pedestrian => "pedestrian",
            Self::TrafficCone => "traffic_cone",
            Self::Barrier => "barrier",
            Self::Sign => "sign",
            Self::Animal => "animal",
            Self::Other => "other",
        }
    }
}

/// The annotated categories of Argoverse 2 in the order of the official enumeration.
pub(crate) const ARGOVERSE2: [&str; 30] = [
    "ANIMAL",
    "ARTICULATED_BUS",
    "BICYCLE",
    "BICYCLIST",
    "BOLLARD",
    "BOX_TRUCK",
    "BUS",
    "CONSTRUCTION_BARREL",
    "CONSTRUCTION_CONE",
    "DOG",
    "LARGE_VEHICLE",
    "MESSAGE_BOARD_TRAILER",
    "MOBILE_PEDESTRIAN_CROSSING_SIGN",
    "MOTORCYCLE",
    "MOTORCYCLIST",
    "OFFICIAL_SIGNALER",
    "PEDESTRIAN",
    "RAILED_VEHICLE",
    "REGULAR_VEHICLE",
    "SCHOOL_BUS",
    "SIGN",
    "STOP_SIGN",
    "STROLLER",
    "TRAFFIC_LIGHT_TRAILER",
    "TRUCK",
    "TRUCK_CAB",
    "VEHICULAR_TRAILER",
    "WHEELCHAIR",
    "WHEELED_DEVICE",
    "WHEELED_RIDER",
];

/// What to do with a native class, where a config overrides the tables below.
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

/// The nuScenes category that stands for a shared class; `None` for signs and [`ObjectClass::Other`], for which the release has none.
pub const fn nearest_nuscenes(class: ObjectClass) -> Option<&'static str> {
    use ObjectClass::*;
    Some(match class {
        Car => "vehicle.car",
        Truck => "vehicle.truck",
        Bus => "vehicle.bus.rigid",
        Trailer => "vehicle.trailer",
        ConstructionVehicle => "vehicle.construction",
        Motorcycle => "vehicle.motorcycle",
        Bicycle => "vehicle.bicycle",
        Pedestrian => "human.pedestrian.adult",
        TrafficCone => "movable_object.trafficcone",
        Barrier => "movable_object.barrier",
        Animal => "animal",
        Sign | Other => return None,
    })
}

/// The shared class of an Argoverse 2 category; `None` for a name the taxonomy has no rule for. Riders have boxes of their own there.
pub fn from_argoverse2(category: &str) -> Option<ObjectClass> {
    use ObjectClass::*;
    Some(match category {
        "REGULAR_VEHICLE" => Car,
        "TRUCK" | "BOX_TRUCK" | "TRUCK_CAB" | "LARGE_VEHICLE" => Truck,
        "BUS" | "ARTICULATED_BUS" | "SCHOOL_BUS" => Bus,
        "VEHICULAR_TRAILER" | "MESSAGE_BOARD_TRAILER" | "TRAFFIC_LIGHT_TRAILER" => Trailer,
        "MOTORCYCLE" => Motorcycle,
        "BICYCLE" => Bicycle,
        "PEDESTRIAN" | "OFFICIAL_SIGNALER" | "BICYCLIST" | "MOTORCYCLIST" | "WHEELED_RIDER" => Pedestrian,
        "CONSTRUCTION_CONE" | "CONSTRUCTION_BARREL" => TrafficCone,
        // The annotation guide and the files name the same sign differently.
        "SIGN" | "STOP_SIGN" | "MOBILE_PEDESTRIAN_CROSSING_SIGN" | "MOBILE_PEDESTRIAN_SIGN" => Sign,
        "ANIMAL" | "DOG" => Animal,
        "BOLLARD" | "RAILED_VEHICLE" | "STROLLER" | "WHEELCHAIR" | "WHEELED_DEVICE" => Other,
        _ => return None,
    })
}

/// The Argoverse 2 category nearest to a shared class; `None` for [`ObjectClass::Other`].
///
/// Construction vehicles become `LARGE_VEHICLE` and barriers `BOLLARD`, which read back as truck and other: nothing is nearer.
pub const fn nearest_argoverse2(class: ObjectClass) -> Option<&'static str> {
    use ObjectClass::*;
    Some(match class {
        Car => "REGULAR_VEHICLE",
        Truck => "TRUCK",
        Bus => "BUS",
        Trailer => "VEHICULAR_TRAILER",
        ConstructionVehicle => "LARGE_VEHICLE",
        Motorcycle => "MOTORCYCLE",
        Bicycle => "BICYCLE",
        Pedestrian => "PEDESTRIAN",
        TrafficCone => "CONSTRUCTION_CONE",
        Barrier => "BOLLARD",
        Sign => "SIGN",
        Animal => "ANIMAL",
        Other => return None,
    })
}

/// The shared class of a nuPlan category; `None` for a name the taxonomy has no rule for. `vehicle` is every motor vehicle.
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

/// The shared class of a Waymo label type by its name; `None` for a name the taxonomy has no rule for. `VEHICLE` is every motor vehicle,
/// `CYCLIST` includes the bicycle.
pub fn from_waymo(label: &str) -> Option<ObjectClass> {
    use ObjectClass::*;
    Some(match label {
        "VEHICLE" => Car,
        "PEDESTRIAN" => Pedestrian,
        "SIGN" => Sign,
        "CYCLIST" => Bicycle,
        "UNKNOWN" => Other,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many of the names go to each class, in class order.
    fn counts(of: fn(&str) -> Option<ObjectClass>, names: &[&str]) -> [usize; 13] {
        let mut counts = [0; 13];
        for name in names {
            counts[of(name).unwrap_or_else(|| panic!("no rule for {name}")).index()] += 1;
        }
        counts
    }

    #[test]
    fn the_first_ten_are_the_detection_classes() {
        let names = ObjectClass::ALL.map(|class| serde_json::to_value(class).unwrap());
        let official = [
            "car",
            "truck",
            "bus",
            "trailer",
            "construction_vehicle",
            "motorcycle",
            "bicycle",
            "pedestrian",
            "traffic_cone",
            "barrier",
        ];
        assert_eq!(names[..10], official.map(serde_json::Value::from));
        assert_eq!(names, ObjectClass::ALL.map(|class| serde_json::Value::from(class.name())));
        assert!(ObjectClass::ALL.iter().enumerate().all(|(at, class)| class.index() == at));
    }

    #[test]
    fn nearest_categories_lead_back_to_their_class() {
        for class in ObjectClass::ALL {
            assert!(nearest_nuscenes(class).is_none_or(|name| from_nuscenes(name) == Some(class)), "{class:?}");
            let back = nearest_argoverse2(class).and_then(from_argoverse2);
            let changes = matches!(class, ObjectClass::ConstructionVehicle | ObjectClass::Barrier | ObjectClass::Other);
            assert_eq!(back == Some(class), !changes, "{class:?}");
        }
    }

    #[test]
    fn all_names_of_nuscenes_have_a_class() {
        let names = [
            "human.pedestrian.adult",
            "human.pedestrian.child",
            "human.pedestrian.wheelchair",
            "human.pedestrian.stroller",
            "human.pedestrian.personal_mobility",
            "human.pedestrian.police_officer",
            "human.pedestrian.construction_worker",
            "animal",
            "vehicle.car",
            "vehicle.motorcycle",
            "vehicle.bicycle",
            "vehicle.bus.bendy",
            "vehicle.bus.rigid",
            "vehicle.truck",
            "vehicle.construction",
            "vehicle.emergency.ambulance",
            "vehicle.emergency.police",
            "vehicle.trailer",
            "movable_object.barrier",
            "movable_object.trafficcone",
            "movable_object.pushable_pullable",
            "movable_object.debris",
            "static_object.bicycle_rack",
        ];
        assert_eq!(counts(from_nuscenes, &names), [1, 1, 2, 1, 1, 1, 1, 4, 1, 1, 0, 1, 8]);
        assert_eq!(from_nuscenes("vehicle.Car"), None);
    }

    #[test]
    fn all_names_of_argoverse_2_have_a_class() {
        assert_eq!(counts(from_argoverse2, &ARGOVERSE2), [1, 4, 3, 3, 0, 1, 1, 5, 2, 0, 3, 2, 5]);
        assert_eq!(from_argoverse2("HOVERBOARD"), None);
    }

    #[test]
    fn all_names_of_nuplan_and_waymo_have_a_class() {
        let nuplan = ["vehicle", "bicycle", "pedestrian", "traffic_cone", "barrier", "czone_sign", "generic_object"];
        assert_eq!(counts(from_nuplan, &nuplan), [1, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 0, 1]);
        let waymo = ["UNKNOWN", "VEHICLE", "PEDESTRIAN", "SIGN", "CYCLIST"];
        assert_eq!(counts(from_waymo, &waymo), [1, 0, 0, 0, 0, 0, 1, 1, 0, 0, 1, 0, 1]);
        assert_eq!((from_nuplan("VEHICLE"), from_waymo("vehicle")), (None, None));
    }
}
