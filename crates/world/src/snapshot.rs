//! A world frozen at one time: rays and what they meet.

use std::sync::Arc;

use glam::{DVec3, Vec3};

use crate::bvh::{Bvh, Ray};
use crate::ground::Spot;
use crate::light::HeadLamps;
use crate::rendering::Hit;
use crate::scene::Scene;
use crate::shape::{Shape, Surface};

/// Rays end here; beyond is the sky.
pub const FAR_M: f32 = 420.0;

/// A world frozen at one time. Cheap to clone and to send between threads.
#[derive(Debug, Clone)]
pub struct Snapshot {
    pub(crate) scene: Arc<Scene>,
    pub(crate) movers: Arc<Bvh>,
    pub(crate) ego_lamps: HeadLamps,
}

/// What a ray met.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Met {
    /// The ground plane.
    Ground,
    /// A static shape.
    Static(u32),
    /// A shape of a moving actor.
    Mover(u32),
}

impl Snapshot {
    /// The nearest thing along a ray.
    pub(crate) fn trace(&self, ray: &Ray, far: f32) -> Option<(f32, Met)> {
        let mut reach = far;
        let mut found = None;
        if ray.direction.z < 0.0 && ray.origin.z > 0.0 {
            let t = -ray.origin.z / ray.direction.z;
            if t < reach {
                reach = t;
                found = Some((t, Met::Ground));
            }
        }
        if let Some((t, index)) = self.scene.bvh.nearest(ray, 0.0, reach) {
            reach = t;
            found = Some((t, Met::Static(index)));
        }
        if let Some((t, index)) = self.movers.nearest(ray, 0.0, reach) {
            found = Some((t, Met::Mover(index)));
        }
        found
    }

    /// Whether anything stands within `far` metres along a ray.
    pub(crate) fn blocked(&self, ray: &Ray, far: f32) -> bool {
        const SKIN_M: f32 = 0.01;
        self.movers.blocked(ray, SKIN_M, far) || self.scene.bvh.blocked(ray, SKIN_M, far)
    }

    /// Shape and surface of a met body.
    pub(crate) fn body(&self, met: Met) -> Option<(&Shape, &Surface)> {
        match met {
            Met::Ground => None,
            Met::Static(index) => Some(self.scene.bvh.part(index)),
            Met::Mover(index) => Some(self.movers.part(index)),
        }
    }

    /// The ground at a point relative to the scene's origin.
    pub(crate) fn spot(&self, point: Vec3) -> Spot {
        self.scene.ground.at(point.truncate())
    }

    /// The first thing a ray meets: `origin + direction * distance` is the point. `None` is sky.
    pub fn raycast(&self, origin: DVec3, direction: DVec3) -> Option<Hit> {
        let length = direction.length();
        if length <= 0.0 || !length.is_finite() {
            return None;
        }
        let ray = Ray::new(self.scene.to_local(origin), (direction / length).as_vec3());
        let (t, met) = self.trace(&ray, FAR_M)?;
        let (semantic, instance) = match self.body(met) {
            Some((_, surface)) => (surface.label, surface.instance),
            None => (self.spot(ray.at(t)).cover.label(), 0),
        };
        Some(Hit { distance: f64::from(t) / length, semantic, instance })
    }
}
