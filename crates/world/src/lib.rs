//! Procedural driving world: seeded streets, traffic and weather, exact images for any rig.
//!
//! [`World::generate`] draws a scene; [`World::snapshot`] freezes it at a time; [`Snapshot::render`] sees it through a camera.
//! World frame: x east, y north, z up, ground at z = 0, all coordinates positive. Everything is a pure function of seed and
//! config: no call into the platform's mathematics library takes part, so machines agree on every byte of a pinhole picture.

mod actor;
mod bodies;
mod buildings;
mod bvh;
mod caption;
mod cast;
mod config;
mod curve;
mod dice;
mod fleet;
mod ground;
mod light;
mod map;
mod map_build;
mod math;
mod network;
mod network_build;
mod occupancy;
mod outline;
mod palette;
mod pavement;
mod render;
mod rendering;
mod scene;
mod scenery;
mod script;
mod shade;
mod shape;
mod sky;
mod snapshot;
mod texture;
mod traffic;
mod world;

pub use actor::{ActorClass, ActorState};
pub use config::{Conditions, TimeOfDay, TrafficSide, Weather, WorldConfig};
pub use map::{MapArea, MapAreaKind, MapLane, MapLine, MapLineKind, Paint, VectorMap};
pub use rendering::{FREE_LABEL, Hit, RenderOptions, Rendering, SKY_LABEL};
pub use snapshot::Snapshot;
pub use world::World;
