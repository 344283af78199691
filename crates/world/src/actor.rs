//! Actors as callers see them.

use geometry::Box3d;
use glam::DVec2;
use serde::{Deserialize, Serialize};

/// Kind of an actor: the ten nuScenes detection classes, in the order of the shared taxonomy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ActorClass {
    /// Sedans, hatchbacks, estate cars, vans.
    Car,
    /// Rigid trucks and pickups.
    Truck,
    /// City buses.
    Bus,
    /// Box trailers, parked or behind a truck.
    Trailer,
    /// Excavators.
    ConstructionVehicle,
    /// Motorcycles; the box includes the rider.
    Motorcycle,
    /// Bicycles; the box includes the rider.
    Bicycle,
    /// People on foot.
    Pedestrian,
    /// Cones.
    TrafficCone,
    /// Work-zone barriers.
    Barrier,
}

impl ActorClass {
    /// All classes in order.
    pub const ALL: [Self; 10] = [
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
    ];

    /// Index in the shared taxonomy, 0 to 9.
    pub fn index(self) -> usize {
        self as usize
    }

    /// The Occ3D-nuScenes label of this class.
    pub fn semantic(self) -> u8 {
        match self {
            Self::Car => 4,
            Self::Truck => 10,
            Self::Bus => 3,
            Self::Trailer => 9,
            Self::ConstructionVehicle => 5,
            Self::Motorcycle => 6,
            Self::Bicycle => 2,
            Self::Pedestrian => 7,
            Self::TrafficCone => 8,
            Self::Barrier => 1,
        }
    }

    /// nuScenes detection name, such as `traffic_cone`.
    pub fn name(self) -> &'static str {
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
        }
    }
}

/// One actor at one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct ActorState {
    /// Identity over the whole scene; `instance` images hold `id + 1`.
    pub id: u32,
    /// Kind.
    pub class: ActorClass,
    /// Bounding box in the world frame, standing on z = 0; yaw is the heading.
    pub world_box: Box3d,
    /// Velocity over ground, world axes, m/s.
    pub velocity: DVec2,
    /// True for vehicles that stay parked for the whole scene.
    pub parked: bool,
    /// True for two-wheelers with a rider on them.
    pub with_rider: bool,
}
