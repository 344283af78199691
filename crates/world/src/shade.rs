//! Light at a point that a ray has met.

use glam::{Vec2, Vec3};

use crate::bvh::Ray;
use crate::pavement::Footing;
use crate::snapshot::{Met, Snapshot};
use crate::texture::{Look3d, Texel, texel};

/// Rays toward the sun end here.
const SHADOW_M: f32 = 120.0;
/// Reflections in wet ground end here.
const MIRROR_M: f32 = 70.0;

/// A point ready for light.
struct Patch {
    point: Vec3,
    normal: Vec3,
    texel: Texel,
    /// Share of mirror-like water on it.
    water: f32,
    ground: bool,
}

impl Snapshot {
    /// Light that comes back along a ray that met something at distance `t`; `spread` is the pixel's angle in radians.
    pub(crate) fn shade(&self, ray: &Ray, t: f32, met: Met, spread: f32) -> Vec3 {
        let patch = self.patch(ray, t, met, spread);
        let sky = &self.scene.sky;
        let light = self.light(&patch);
        let mut color = patch.texel.color * light + patch.texel.glow;
        let facing = -ray.direction.dot(patch.normal);
        if patch.texel.gloss > 0.0 || patch.water > 0.0 {
            let mirrored = ray.direction + patch.normal * (2.0 * facing);
            let grazing = (1.0 - facing).clamp(0.0, 1.0);
            let g2 = grazing * grazing;
            let fresnel = g2 * g2 * grazing;
            if patch.water > 0.0 {
                let share = patch.water * (0.05 + 0.75 * fresnel);
                let seen = if share > 0.02 { self.mirror(patch.point, mirrored) } else { sky.soft(mirrored) };
                color = color.lerp(seen, share);
            } else {
                // Below the horizon paint mirrors the road, not the sky.
                let seen = if mirrored.z > 0.0 { sky.soft(mirrored) } else { sky.ambient * 0.1 };
                color = color.lerp(seen, (patch.texel.gloss + (1.0 - patch.texel.gloss) * fresnel * 0.5).min(0.9));
            }
        }
        sky.through_air(color, ray.direction, t)
    }

    fn patch(&self, ray: &Ray, t: f32, met: Met, spread: f32) -> Patch {
        let point = ray.at(t);
        if let Some((shape, surface)) = self.body(met) {
            let local = shape.local_of(point - shape.center);
            let normal = shape.local_normal(local);
            let scene_normal = shape.scene_of(normal);
            let facing = ray.direction.dot(scene_normal).abs().max(0.15);
            let look =
                Look3d { local, normal, height: point.z, pixel: t * spread / facing, lamps: self.scene.sky.lamps };
            let texel = texel(shape, surface, &look);
            return Patch { point, normal: scene_normal, texel, water: 0.0, ground: false };
        }
        let spot = self.spot(point);
        let flat = ray.direction.truncate();
        let across = t * spread;
        let footing = Footing {
            sight: flat.try_normalize().unwrap_or(Vec2::X),
            along: across / ray.direction.z.abs().max(0.01),
            across,
        };
        let (color, water) = self.scene.pavement.color(&spot, point.truncate(), &footing);
        let texel = Texel { color, glow: Vec3::ZERO, gloss: 0.0 };
        Patch { point: Vec3::new(point.x, point.y, 0.0), normal: Vec3::Z, texel, water, ground: true }
    }

    /// Light that falls on a patch.
    fn light(&self, patch: &Patch) -> Vec3 {
        let sky = &self.scene.sky;
        let up = 0.5 + 0.5 * patch.normal.z;
        let mut ambient = sky.ambient * (sky.bounce + (1.0 - sky.bounce) * up);
        let mut light = Vec3::ZERO;
        let above = patch.point + patch.normal * 0.01;
        if sky.sun_shines() {
            let facing = patch.normal.dot(sky.sun);
            if facing > 0.0 && !self.blocked(&Ray::new(above, sky.sun), SHADOW_M) {
                light += sky.sun_light * facing;
            }
        } else if patch.ground {
            // Under clouds things still darken the ground below them.
            let tilt = Vec3::new(0.16, 0.12, 0.98);
            if self.blocked(&Ray::new(above, tilt), 5.0) {
                ambient *= 0.42;
            }
        }
        if sky.lamps > 0.0 {
            let (mut sum, strongest) = self.scene.lamps.on(patch.point, patch.normal);
            if let Some((head, share)) = strongest.filter(|(_, share)| *share > 0.25 * sum && *share > 8e-4) {
                let to = head - above;
                let distance = to.length();
                if self.blocked(&Ray::new(above, to / distance), distance - 0.5) {
                    sum -= share;
                }
            }
            light += self.scene.lamps.color * sum;
            light += Vec3::new(1.0, 0.96, 0.86) * (self.ego_lamps.on(patch.point, patch.normal) * sky.lamps);
        }
        ambient + light
    }

    /// What wet ground mirrors, with cheap light.
    fn mirror(&self, from: Vec3, direction: Vec3) -> Vec3 {
        let sky = &self.scene.sky;
        let ray = Ray::new(from + Vec3::Z * 0.02, direction);
        let Some((t, met)) = self.trace(&ray, MIRROR_M) else { return sky.soft(direction) };
        let patch = self.patch(&ray, t, met, 0.02);
        let (sum, _) = self.scene.lamps.on(patch.point, patch.normal);
        let color = patch.texel.color * (sky.ambient * 0.8 + self.scene.lamps.color * sum) + patch.texel.glow;
        sky.through_air(color, direction, t)
    }
}
