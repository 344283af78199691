//! Detection score of nuScenes, configuration `detection_cvpr_2019`: mean average precision, five true-positive errors, NDS.
//!
//! Caesar et al., "nuScenes: A multimodal dataset for autonomous driving", section 3.1. The order of equal scores, the
//! interpolation and the treatment of undefined values follow the official devkit 1.2; parity: `tests/it/detection.rs`.

mod boxes;
mod curve;
mod filter;
mod results;
mod score;

pub use boxes::{DetectionBox, TrueBox};
pub use curve::{MatchCurve, TruePositiveError};
pub use filter::{Rack, keep_evaluated};
pub use results::{DetectionResults, ResultMeta};
pub use score::{ClassScore, DetectionScore, DetectionTally};

use serde::{Deserialize, Serialize};

/// The ten classes of the benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DetectionClass {
    /// Cars.
    Car,
    /// Trucks.
    Truck,
    /// Buses.
    Bus,
    /// Trailers.
    Trailer,
    /// Construction vehicles.
    ConstructionVehicle,
    /// Pedestrians.
    Pedestrian,
    /// Motorcycles.
    Motorcycle,
    /// Bicycles.
    Bicycle,
    /// Traffic cones.
    TrafficCone,
    /// Barriers.
    Barrier,
}

impl DetectionClass {
    /// All classes in the benchmark's order.
    pub const ALL: [Self; 10] = [
        Self::Car,
        Self::Truck,
        Self::Bus,
        Self::Trailer,
        Self::ConstructionVehicle,
        Self::Pedestrian,
        Self::Motorcycle,
        Self::Bicycle,
        Self::TrafficCone,
        Self::Barrier,
    ];

    /// As result files write it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Car => "car",
            Self::Truck => "truck",
            Self::Bus => "bus",
            Self::Trailer => "trailer",
            Self::ConstructionVehicle => "construction_vehicle",
            Self::Pedestrian => "pedestrian",
            Self::Motorcycle => "motorcycle",
            Self::Bicycle => "bicycle",
            Self::TrafficCone => "traffic_cone",
            Self::Barrier => "barrier",
        }
    }

    /// Distance from the ego in the ground plane at which boxes stop counting, metres.
    #[must_use]
    pub fn range_m(self) -> f64 {
        match self {
            Self::Pedestrian | Self::Motorcycle | Self::Bicycle => 40.0,
            Self::TrafficCone | Self::Barrier => 30.0,
            _ => 50.0,
        }
    }

    /// Turn after which a box looks the same, radians.
    fn yaw_period(self) -> f64 {
        if self == Self::Barrier { std::f64::consts::PI } else { std::f64::consts::TAU }
    }

    /// Whether this error is defined for the class.
    #[must_use]
    pub fn has_error(self, error: TruePositiveError) -> bool {
        use TruePositiveError::{Attribute, Orientation, Velocity};
        match self {
            Self::TrafficCone => !matches!(error, Orientation | Velocity | Attribute),
            Self::Barrier => !matches!(error, Velocity | Attribute),
            _ => true,
        }
    }
}

/// Distances of centres in the ground plane up to which a prediction matches, metres.
pub const DISTANCE_THRESHOLDS_M: [f64; 4] = [0.5, 1.0, 2.0, 4.0];

/// The threshold of [`DISTANCE_THRESHOLDS_M`] at which errors of true positives are measured.
pub(crate) const ERROR_THRESHOLD: usize = 2;

/// More predictions in one sample are against the rules.
pub const MOST_BOXES: usize = 500;
