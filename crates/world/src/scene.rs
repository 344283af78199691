//! The static part of a world, ready for rays.

use glam::{DVec2, Vec3};

use crate::bodies;
use crate::bvh::Bvh;
use crate::config::{Conditions, WorldConfig};
use crate::dice::{Dice, Purpose};
use crate::ground::Ground;
use crate::light::Lamps;
use crate::network::Network;
use crate::palette::Palette;
use crate::pavement::Pavement;
use crate::scenery::Site;
use crate::script::Actor;
use crate::sky::Sky;

/// Light of a street lamp straight below it, times its height squared.
const LAMP_POWER: f32 = 42.0;

/// Ground, sky, lamps and all shapes that never move; coordinates are f32 relative to `origin`.
#[derive(Debug)]
pub struct Scene {
    /// World position of the local origin.
    pub origin: DVec2,
    /// Lookup of what the ground is.
    pub ground: Ground,
    /// What the ground looks like.
    pub pavement: Pavement,
    /// Buildings, plants, furniture, parked and standing actors.
    pub bvh: Bvh,
    /// Sun, sky, air.
    pub sky: Sky,
    /// Street lamps.
    pub lamps: Lamps,
}

impl Scene {
    /// Builds everything static.
    pub fn new(
        seed: u64,
        config: &WorldConfig,
        network: &Network,
        actors: &[Actor],
        conditions: &Conditions,
        look: &mut Dice,
    ) -> Self {
        let (low, high) = network.bounds();
        let origin = ((low + high) * 0.5).round();
        let palette = Palette::draw(look);
        let sky = Sky::new(look, conditions);
        let mut site = Site::new(network, &palette, origin);
        site.build(&mut Dice::new(seed, Purpose::Buildings), config);
        site.furnish(&mut Dice::new(seed, Purpose::Furniture));
        site.plant(&mut Dice::new(seed, Purpose::Plants), config);
        let (mut parts, heads) = (site.parts, site.lamps);
        for actor in actors.iter().filter(|a| a.motion.is_still()) {
            if let Some(place) = actor.motion.at(network, 0.0) {
                let foot = (place.point - origin).as_vec2().extend(0.0);
                bodies::build(actor, foot, place.yaw, place.travelled, &mut parts);
            }
        }
        let salt = look.bits();
        Self {
            origin,
            ground: Ground::new(network, origin, palette.blocks, salt),
            pavement: Pavement::new(network, &palette, sky.wet, salt),
            bvh: Bvh::new(parts),
            lamps: Lamps::new(heads, palette.lamp * (LAMP_POWER * sky.lamps)),
            sky,
        }
    }

    /// A world point relative to the origin.
    pub fn to_local(&self, point: glam::DVec3) -> Vec3 {
        (point - self.origin.extend(0.0)).as_vec3()
    }
}
