//! What a caller may choose about a world, and what the generator chose.

use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Knobs of the generator. The defaults give the mixed urban scenes that training uses.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WorldConfig {
    /// Times of day that may occur, drawn with equal weight; empty means all.
    pub times_of_day: Vec<TimeOfDay>,
    /// Weathers that may occur, drawn with equal weight; empty means all.
    pub weathers: Vec<Weather>,
    /// Which side traffic keeps to: `Some(true)` left, `Some(false)` right, `None` drawn (one in four scenes is left-hand).
    pub left_hand: Option<bool>,
    /// Moving vehicles, relative to the usual number (0 to 3).
    pub traffic_density: f64,
    /// Parked vehicles, relative to the usual number (0 to 3).
    pub parked_density: f64,
    /// Pedestrians and cyclists, relative to the usual number (0 to 3).
    pub pedestrian_density: f64,
    /// Buildings, relative to the usual number (0 to 1).
    pub building_density: f64,
    /// Trees and bushes, relative to the usual number (0 to 3).
    pub tree_density: f64,
    /// Length of a scene in seconds (1 to 60); the ego drives all the time.
    pub duration_secs: f64,
    /// How far scenery reaches to the sides of the roads, metres (30 to 120).
    pub extent_m: f64,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            times_of_day: vec![TimeOfDay::Day, TimeOfDay::Day, TimeOfDay::Dusk, TimeOfDay::Night],
            weathers: vec![Weather::Clear, Weather::Clear, Weather::Overcast, Weather::Rain],
            left_hand: None,
            traffic_density: 1.0,
            parked_density: 1.0,
            pedestrian_density: 1.0,
            building_density: 1.0,
            tree_density: 1.0,
            duration_secs: 20.0,
            extent_m: 70.0,
        }
    }
}

/// Part of the day, which sets sun, exposure and lamps.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeOfDay {
    /// Sun well above the horizon.
    Day,
    /// Low, warm sun.
    Dusk,
    /// No sun; lamps and lit windows.
    Night,
}

/// Weather of the whole scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Weather {
    /// Blue sky and sharp shadows.
    Clear,
    /// Grey sky, no sun shadows.
    Overcast,
    /// Grey, with a dark wet road that mirrors.
    Rain,
}

/// The side of the road that traffic keeps to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrafficSide {
    /// As in Boston.
    Right,
    /// As in Singapore.
    Left,
}

/// What the generator chose for one scene.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Conditions {
    /// Part of the day.
    pub time_of_day: TimeOfDay,
    /// Weather.
    pub weather: Weather,
    /// Unit vector from the scene toward the sun, world frame; at night toward the moon.
    pub sun_direction: DVec3,
    /// Side that traffic keeps to.
    pub traffic_side: TrafficSide,
}
