//! The world itself: one static scene and the scripts of all its actors.

use std::sync::Arc;

use geometry::{BevGrid, Box3d, Rigid, wrap_angle};
use glam::{DQuat, DVec3};

use crate::actor::ActorState;
use crate::bodies;
use crate::bvh::Bvh;
use crate::caption::caption;
use crate::cast::{Cast, EGO_CENTER_M, EGO_SIZE};
use crate::config::{Conditions, TrafficSide, WorldConfig};
use crate::dice::{Dice, Purpose};
use crate::light::HeadLamps;
use crate::map::VectorMap;
use crate::math::sin_cos;
use crate::network::Network;
use crate::scene::Scene;
use crate::script::{Actor, Motion, Place};
use crate::sky::draw_conditions;
use crate::snapshot::Snapshot;
use crate::traffic::{ego_motion, populate};

/// One static scene plus the scripts of all actors; a pure function of seed and config, byte for byte.
#[derive(Debug, Clone)]
pub struct World {
    seed: u64,
    duration_secs: f64,
    conditions: Conditions,
    network: Arc<Network>,
    scene: Arc<Scene>,
    actors: Arc<Vec<Actor>>,
    ego: Motion,
    map: Arc<VectorMap>,
}

impl World {
    /// Builds the world of a seed. Out-of-range numbers in the config are brought into their ranges.
    pub fn generate(seed: u64, config: &WorldConfig) -> Self {
        let duration_secs = config.duration_secs.clamp(1.0, 60.0);
        let config = WorldConfig { duration_secs, ..config.clone() };
        let mut look = Dice::new(seed, Purpose::Conditions);
        let conditions = draw_conditions(&mut look, &config);
        let side = if conditions.traffic_side == TrafficSide::Left { 1.0 } else { -1.0 };
        let network = Network::generate(&mut Dice::new(seed, Purpose::Network), &config, side);
        let ego = ego_motion(&mut Dice::new(seed, Purpose::Ego), &network);
        let mut cast = Cast::new(&network, ego, duration_secs);
        populate(&mut cast, seed, &config);
        let actors = cast.actors;
        let scene = Scene::new(seed, &config, &network, &actors, &conditions, &mut look);
        let map = VectorMap::of(&network);
        Self {
            seed,
            duration_secs,
            conditions,
            scene: Arc::new(scene),
            actors: Arc::new(actors),
            ego,
            map: Arc::new(map),
            network: Arc::new(network),
        }
    }

    /// The seed it came from.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Length of the scene; every time in `0..=duration_secs` is valid.
    pub fn duration_secs(&self) -> f64 {
        self.duration_secs
    }

    /// Pose of the ego (origin at the rear axle, on the ground).
    pub fn world_from_ego(&self, time_secs: f64) -> Rigid {
        let place = self.ego_place(time_secs);
        let (sin, cos) = sin_cos(place.yaw * 0.5);
        Rigid { rotation: DQuat::from_xyzw(0.0, 0.0, sin, cos), translation: place.point.extend(0.0) }
    }

    fn ego_place(&self, time_secs: f64) -> Place {
        // A little beyond the scene's ends is fine (uneven time stamps); the main road is long enough for that.
        let time_secs = time_secs.clamp(-5.0, self.duration_secs + 5.0);
        self.ego.at(&self.network, time_secs).expect("the main road is longer than the ego can drive")
    }

    /// Box of the ego's own body in the world frame.
    pub fn ego_box(&self, time_secs: f64) -> Box3d {
        let pose = self.world_from_ego(time_secs);
        let center = pose * DVec3::new(EGO_CENTER_M, 0.0, EGO_SIZE.z * 0.5);
        Box3d { center, size: EGO_SIZE, yaw: wrap_angle(self.ego_place(time_secs).yaw) }
    }

    /// All actors that exist at this time, sorted by id.
    pub fn actors_at(&self, time_secs: f64) -> Vec<ActorState> {
        let state = |actor: &Actor| Some(actor.state(&actor.motion.at(&self.network, time_secs)?));
        self.actors.iter().filter_map(state).collect()
    }

    /// The vector map, world frame.
    pub fn map(&self) -> &VectorMap {
        &self.map
    }

    /// Time of day, weather, sun and traffic side.
    pub fn conditions(&self) -> Conditions {
        self.conditions
    }

    /// One sentence that says what can be seen.
    pub fn caption(&self) -> String {
        caption(&self.conditions, &self.network, &self.actors)
    }

    /// Whether vehicles can drive at a point of the world's plan.
    pub fn drivable(&self, point: glam::DVec2) -> bool {
        self.network.drivable(point)
    }

    /// The scene frozen at one time, ready for rays; shares everything static.
    pub fn snapshot(&self, time_secs: f64) -> Snapshot {
        let mut parts = Vec::new();
        let ego = self.ego_place(time_secs);
        for actor in self.actors.iter().filter(|a| !a.motion.is_still()) {
            if let Some(place) = actor.motion.at(&self.network, time_secs) {
                let foot = self.scene.to_local(place.point.extend(0.0));
                bodies::build(actor, foot, place.yaw, place.travelled, &mut parts);
            }
        }
        let (sin, cos) = sin_cos(ego.yaw);
        let ahead = DVec3::new(cos, sin, 0.0);
        let from = self.scene.to_local(ego.point.extend(0.65) + ahead * 3.4);
        let ego_lamps = HeadLamps { from, ahead: ahead.as_vec3() };
        Snapshot { scene: self.scene.clone(), movers: Arc::new(Bvh::new(parts)), ego_lamps }
    }

    /// Occ3D-nuScenes label of every cell of a grid at `world_from_grid`, in the grid's memory order (z, y, x); 17 is free.
    pub fn occupancy(&self, time_secs: f64, world_from_grid: &Rigid, grid: &BevGrid) -> Vec<u8> {
        self.snapshot(time_secs).occupancy(world_from_grid, grid)
    }
}
