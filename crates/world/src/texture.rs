//! Procedural patterns of bodies. Detail fades out where a pixel is larger than the detail.

use glam::{Vec2, Vec3, Vec3Swizzles};

use crate::fleet::rgb;
use crate::math::{floor_i32, hash2, noise2, smoothstep, unit};
use crate::shape::{Look, Shape, Surface};

/// Optical properties at one point.
#[derive(Debug, Clone, Copy)]
pub struct Texel {
    /// Diffuse colour.
    pub color: Vec3,
    /// Light of its own.
    pub glow: Vec3,
    /// Share of the sky that it mirrors at normal incidence.
    pub gloss: f32,
}

impl Texel {
    fn matt(color: Vec3) -> Self {
        Self { color, glow: Vec3::ZERO, gloss: 0.0 }
    }
}

/// Where and how finely a body is looked at.
#[derive(Debug, Clone, Copy)]
pub struct Look3d {
    /// Point in the body's axes.
    pub local: Vec3,
    /// Normal in the body's axes.
    pub normal: Vec3,
    /// Height above the ground.
    pub height: f32,
    /// Size of a pixel on the surface, metres.
    pub pixel: f32,
    /// How bright lamps are, 0 by day to 1 at night.
    pub lamps: f32,
}

/// Box-filtered indicator of `low <= x <= high` with filter width `w`.
pub fn pulse(x: f32, low: f32, high: f32, w: f32) -> f32 {
    let w = w.max(1e-4);
    let a = ((x - low) / w + 0.5).clamp(0.0, 1.0);
    let b = ((high - x) / w + 0.5).clamp(0.0, 1.0);
    // For stripes narrower than the filter both ramps overlap and only their sum beyond one is covered.
    (a + b - 1.0).max(0.0)
}

/// Weight of detail of the given period under the given pixel size.
pub fn detail(period: f32, pixel: f32) -> f32 {
    1.0 - smoothstep(0.35, 1.0, pixel / period)
}

/// The pattern of a body at a point.
pub fn texel(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    match surface.look {
        Look::Plain => Texel::matt(surface.color),
        Look::Facade => facade(shape, surface, at),
        Look::Wall => Texel::matt(surface.color * masonry(surface, at)),
        Look::Roof => {
            let rows = at.local.z * 3.2 + at.local.y * 2.2;
            let fade = detail(0.4, at.pixel);
            let band = if (rows - rows.floor()) < 0.2 { 0.78 } else { 1.0 };
            Texel::matt(surface.color * (1.0 + (band - 1.0) * fade))
        }
        Look::Foliage => foliage(surface, at),
        Look::CarBody => car_body(shape, surface, at),
        Look::CarCabin => car_cabin(shape, surface, at),
        Look::BusBody => bus_body(shape, surface, at),
        Look::Cargo => cargo(shape, surface, at),
        Look::Warning => {
            let phase = (at.local.y + at.local.x + at.local.z) * 2.4;
            let mix = pulse(phase - phase.floor(), 0.0, 0.5, at.pixel * 2.4);
            Texel::matt(surface.color.lerp(surface.accent, mix + (0.5 - mix) * (1.0 - detail(0.4, at.pixel))))
        }
        Look::Bands => {
            let t = at.local.z / shape.half.z;
            let mix = pulse(t, -0.15, 0.25, at.pixel / shape.half.z).max(pulse(t, 0.55, 0.8, at.pixel / shape.half.z));
            Texel::matt(surface.color.lerp(surface.accent, mix))
        }
        Look::Lamp => {
            // Signals shine by day too.
            let strength =
                if surface.color.x > 0.69 && surface.color.z > 0.69 { at.lamps } else { 0.35 + 0.65 * at.lamps };
            Texel { color: surface.color, glow: surface.accent * strength, gloss: 0.0 }
        }
    }
}

fn masonry(surface: &Surface, at: &Look3d) -> f32 {
    let along = if at.normal.x.abs() > at.normal.y.abs() { at.local.y } else { at.local.x };
    let patches = 0.86 + 0.28 * noise2(along * 0.35, at.height * 0.5, surface.salt);
    let fine = noise2(along * 5.0, at.height * 9.0, surface.salt ^ 7) - 0.5;
    patches * (1.0 + 0.28 * fine * detail(0.25, at.pixel))
}

/// Windows: one cell per floor and bay.
fn facade(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    if at.normal.z > 0.7 {
        return Texel::matt(surface.color * 0.35 + 0.08);
    }
    let pick = |k: u32| unit(hash2(k as i32, 11, surface.salt));
    let (along, half) =
        if at.normal.x.abs() > at.normal.y.abs() { (at.local.y, shape.half.y) } else { (at.local.x, shape.half.x) };
    let floor_height = 2.9 + 0.8 * pick(0);
    let bays = (2.0 * half / (1.5 + 2.0 * pick(1))).round().max(1.0);
    let bay = 2.0 * half / bays;
    let (u, v) = ((along + half) / bay, at.height / floor_height);
    let (column, row) = (floor_i32(u), floor_i32(v));
    let (x, y) = (u - column as f32, v - row as f32);
    let share = 0.35 + 0.4 * pick(2);
    let ribbon = pick(3) < 0.25;
    let (x0, x1) = if ribbon { (-1.0, 2.0) } else { (0.5 - share * 0.5, 0.5 + share * 0.5) };
    let shop = row == 0 && pick(4) < 0.55 && shape.half.z > 3.0;
    let (y0, y1) = if shop { (0.08, 0.78) } else { (0.28, 0.30 + 0.5 * (0.6 + 0.4 * pick(5))) };
    let (x0, x1) = if shop { (0.06, 0.94) } else { (x0, x1) };
    let sharp = pulse(x, x0, x1, at.pixel / bay) * pulse(y, y0, y1, at.pixel / floor_height);
    let mean = (x1.min(1.0) - x0.max(0.0)) * (y1 - y0);
    let fade = detail(bay.min(floor_height), at.pixel);
    let window = mean + (sharp - mean) * fade;
    let wall = surface.color * masonry(surface, at);
    let sill = if shop && y > 0.8 { Vec3::new(pick(6), pick(7), pick(8)) * 0.5 } else { wall };
    let key = hash2(
        column,
        row + 64 * i32::from(at.normal.x.abs() > 0.5) + 128 * i32::from(at.normal.x + at.normal.y > 0.0),
        surface.salt,
    );
    let pane = surface.accent * (0.5 + unit(key.wrapping_mul(7)));
    let lit = if unit(key) < 0.34 || (shop && unit(key) < 0.7) { 1.0 } else { 0.0 };
    let lit = 0.34 + (lit - 0.34) * fade;
    let warm = Vec3::new(0.95, 0.66, 0.34).lerp(Vec3::new(0.75, 0.85, 1.0), unit(key.wrapping_mul(31)) * 0.6);
    Texel { color: sill.lerp(pane, window), glow: warm * (window * lit * at.lamps * 0.75), gloss: 0.3 * window }
}

fn foliage(surface: &Surface, at: &Look3d) -> Texel {
    let p = at.local;
    let (a, b) = (p.x + p.z * 0.7, p.y - p.z * 0.6);
    let coarse = noise2(a * 1.7, b * 1.7, surface.salt);
    let fine = noise2(a * 6.0, b * 6.0, surface.salt ^ 3);
    let mix = 0.55 + 0.55 * (coarse - 0.5) + 0.9 * (fine - 0.5) * detail(0.35, at.pixel);
    // Crowns are darker below.
    let depth = 0.62 + 0.38 * at.normal.z;
    Texel::matt(surface.color * ((0.45 + mix) * depth).max(0.12))
}

/// Head lamps in front, tail lamps at the rear.
fn end_lamps(at: &Look3d, half: Vec3, lit: bool, low: f32, high: f32) -> Option<Texel> {
    let z = at.local.z / half.z;
    let y = at.local.y.abs() / half.y;
    if at.normal.x.abs() < 0.6 || !(0.56..=0.95).contains(&y) || !(low..=high).contains(&z) {
        return None;
    }
    let power = if lit { at.lamps } else { 0.0 };
    Some(if at.normal.x > 0.0 {
        Texel { color: Vec3::splat(0.75), glow: Vec3::new(7.0, 6.6, 5.6) * power, gloss: 0.1 }
    } else {
        Texel { color: rgb(190, 20, 18), glow: Vec3::new(1.7, 0.06, 0.04) * power, gloss: 0.05 }
    })
}

fn car_body(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    if let Some(lamp) = end_lamps(at, shape.half, surface.lit, 0.1, 0.75) {
        return lamp;
    }
    let (p, half) = (at.local, shape.half);
    let paint = Texel { color: surface.color, glow: Vec3::ZERO, gloss: 0.16 };
    let dark = Texel { color: rgb(30, 31, 33), glow: Vec3::ZERO, gloss: 0.04 };
    if at.normal.x.abs() > 0.6 {
        let grille = at.normal.x > 0.0 && p.y.abs() < half.y * 0.5 && p.z.abs() < half.z * 0.45;
        let bumper = p.z < -half.z * 0.72;
        let plate = p.y.abs() < 0.26 && (p.z + half.z * 0.3).abs() < 0.07;
        return if plate {
            Texel { color: Vec3::splat(0.7), ..dark }
        } else if grille || bumper {
            dark
        } else {
            paint
        };
    }
    if at.normal.y.abs() > 0.5 {
        let arch = Vec2::new(p.x.abs() - half.x * 0.62, p.z + half.z - 0.11).length() < 0.42;
        let door = detail(0.2, at.pixel) * pulse((p.x / half.x).abs(), 0.25, 0.27, at.pixel / half.x);
        if arch || p.z < -half.z * 0.8 {
            return dark;
        }
        return Texel { color: surface.color * (1.0 - 0.6 * door), ..paint };
    }
    paint
}

fn car_cabin(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    let paint = Texel { color: surface.color, glow: Vec3::ZERO, gloss: 0.16 };
    if at.normal.z > 0.85 || at.local.z > shape.half.z * 0.8 {
        return paint;
    }
    let rim = if at.normal.y.abs() > 0.5 {
        // Pillars between the side windows.
        let x = at.local.x / shape.half.x;
        pulse(x, -0.08, 0.04, at.pixel / shape.half.x).max(pulse(x.abs(), 0.82, 2.0, at.pixel / shape.half.x))
    } else {
        pulse(at.local.y.abs() / shape.half.y, 0.88, 2.0, at.pixel / shape.half.y)
    };
    Texel { color: surface.accent.lerp(surface.color, rim), glow: Vec3::ZERO, gloss: 0.16 + 0.2 * (1.0 - rim) }
}

fn bus_body(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    if let Some(lamp) = end_lamps(at, shape.half, surface.lit, -0.72, -0.5) {
        return lamp;
    }
    let (p, half) = (at.local, shape.half);
    let z = p.z / half.z;
    let paint = Texel { color: surface.color, glow: Vec3::ZERO, gloss: 0.12 };
    if at.normal.z > 0.7 {
        return Texel { color: surface.color * 0.5 + 0.25, ..paint };
    }
    if at.normal.x.abs() > 0.6 {
        let screen = z > -0.25 && z < 0.6 && p.y.abs() < half.y * 0.9;
        let sign = at.normal.x > 0.0 && z > 0.68 && z < 0.9 && p.y.abs() < half.y * 0.6;
        let glow = Vec3::new(1.0, 0.55, 0.1) * if sign { 0.3 + at.lamps } else { 0.0 };
        let color = if screen || sign { surface.accent } else { surface.color };
        return Texel { color, glow, gloss: if screen { 0.35 } else { 0.1 } };
    }
    let bay = (p.x / 1.4).abs();
    let frame = pulse(bay - bay.floor(), 0.06, 0.94, at.pixel / 1.4);
    let band = pulse(z, -0.05, 0.62, at.pixel / half.z);
    let window = band * (0.88 + (frame - 0.88) * detail(1.4, at.pixel));
    let inside = if surface.lit { at.lamps * 0.55 } else { 0.0 };
    let stripe = pulse(z, -0.62, -0.4, at.pixel / half.z);
    let color = surface.color.lerp(surface.color.zxy() * 0.8, stripe).lerp(surface.accent, window);
    Texel { color, glow: Vec3::new(0.8, 0.85, 0.75) * (inside * window), gloss: 0.1 + 0.2 * window }
}

fn cargo(shape: &Shape, surface: &Surface, at: &Look3d) -> Texel {
    if at.normal.x < 0.0
        && let Some(lamp) = end_lamps(at, shape.half, surface.lit, -0.97, -0.82)
    {
        return lamp;
    }
    let along = if at.normal.x.abs() > 0.5 { at.local.y } else { at.local.x };
    let rib = along * 1.6;
    let line = pulse(rib - rib.floor(), 0.0, 0.1, at.pixel * 1.6) * detail(0.6, at.pixel);
    let z = at.local.z / shape.half.z;
    let logo = pulse(z, -0.2, 0.35, at.pixel / shape.half.z) * pulse(at.local.x / shape.half.x, -0.6, 0.5, 0.05);
    let painted = surface.color.lerp(surface.accent, logo * at.normal.y.abs() * 0.8);
    Texel { color: painted * (1.0 - 0.3 * line), glow: Vec3::ZERO, gloss: 0.06 }
}
