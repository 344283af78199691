//! Sun, sky, haze and exposure of a scene.

use glam::{DVec3, Vec3};

use crate::config::{Conditions, TimeOfDay, TrafficSide, Weather, WorldConfig};
use crate::dice::Dice;
use crate::math::{atan2_f32, fade_exp, hash2, noise2, sin_cos, smoothstep, unit};

/// Light and air of one scene; colours are linear.
#[derive(Debug, Clone)]
pub struct Sky {
    /// Toward the sun, or at night the moon.
    pub sun: Vec3,
    /// Sunlight on a surface that faces it; zero under clouds.
    pub sun_light: Vec3,
    /// Light from above on a level surface.
    pub ambient: Vec3,
    /// Light from below relative to that from above.
    pub bounce: f32,
    /// Sky overhead.
    pub zenith: Vec3,
    /// Sky at the horizon.
    pub horizon: Vec3,
    /// Colour around the sun.
    pub glow: Vec3,
    /// Share of the sky that clouds cover.
    pub clouds: f32,
    /// Extinction of the haze, 1/m.
    pub haze: f32,
    /// Multiplies all light before the tone curve.
    pub exposure: f32,
    /// How bright lamps are relative to night.
    pub lamps: f32,
    /// Wetness of the ground.
    pub wet: f32,
    salt: u32,
}

/// Draws time of day, weather, sun and traffic side.
pub fn draw_conditions(dice: &mut Dice, config: &WorldConfig) -> Conditions {
    let defaults = WorldConfig::default();
    let times = if config.times_of_day.is_empty() { &defaults.times_of_day } else { &config.times_of_day };
    let weathers = if config.weathers.is_empty() { &defaults.weathers } else { &config.weathers };
    let (time_of_day, weather) = (dice.pick(times), dice.pick(weathers));
    let left = dice.chance(0.25);
    let (low, high) = match time_of_day {
        TimeOfDay::Day => (0.42, 1.1),
        TimeOfDay::Dusk => (0.08, 0.2),
        TimeOfDay::Night => (0.5, 1.0),
    };
    let (sin_up, cos_up) = sin_cos(dice.range(low, high));
    let (sin, cos) = sin_cos(dice.range(0.0, std::f64::consts::TAU));
    let traffic_side = if config.left_hand.unwrap_or(left) { TrafficSide::Left } else { TrafficSide::Right };
    Conditions { time_of_day, weather, sun_direction: DVec3::new(cos * cos_up, sin * cos_up, sin_up), traffic_side }
}

impl Sky {
    /// The sky of given conditions, with drawn variation.
    pub fn new(dice: &mut Dice, conditions: &Conditions) -> Self {
        let base = Self {
            sun: conditions.sun_direction.as_vec3(),
            sun_light: Vec3::ZERO,
            ambient: Vec3::ZERO,
            bounce: 0.35,
            zenith: Vec3::ZERO,
            horizon: Vec3::ZERO,
            glow: Vec3::ZERO,
            clouds: dice.range_f32(0.1, 0.6),
            haze: dice.range_f32(0.0008, 0.0022),
            exposure: dice.range_f32(0.75, 1.25),
            lamps: 0.0,
            wet: 0.0,
            salt: dice.bits(),
        };
        let mut sky = base.at_time(dice, conditions);
        if conditions.weather == Weather::Rain {
            let dim = if conditions.time_of_day == TimeOfDay::Night { 1.0 } else { 0.62 };
            sky.ambient *= dim;
            sky.zenith *= dim;
            sky.horizon *= dim * 0.95;
            sky.haze *= 3.0;
            sky.wet = 1.0;
            sky.lamps = sky.lamps.max(0.35);
        }
        sky
    }

    /// Light of a time of day under a clear or a grey sky.
    fn at_time(self, dice: &mut Dice, conditions: &Conditions) -> Self {
        let v = Vec3::new;
        let clear = conditions.weather == Weather::Clear;
        match (conditions.time_of_day, clear) {
            (TimeOfDay::Day, true) => Self {
                sun_light: v(2.5, 2.3, 2.0),
                ambient: v(0.52, 0.62, 0.78),
                zenith: v(0.13, 0.29, 0.66) * dice.range_f32(0.8, 1.2),
                horizon: v(0.62, 0.74, 0.86),
                glow: v(1.0, 0.9, 0.7),
                ..self
            },
            (TimeOfDay::Day, false) => {
                let grey = dice.range_f32(0.75, 1.1);
                Self {
                    ambient: v(0.98, 1.0, 1.04) * grey,
                    zenith: v(0.56, 0.59, 0.63) * grey,
                    horizon: v(0.74, 0.76, 0.79) * grey,
                    clouds: 1.0,
                    ..self
                }
            }
            (TimeOfDay::Dusk, true) => Self {
                sun_light: v(1.7, 0.85, 0.38),
                ambient: v(0.24, 0.25, 0.36),
                zenith: v(0.10, 0.15, 0.34),
                horizon: v(0.50, 0.36, 0.34),
                glow: v(1.5, 0.62, 0.2),
                lamps: 0.5,
                exposure: self.exposure * 1.15,
                ..self
            },
            (TimeOfDay::Dusk, false) => Self {
                ambient: v(0.26, 0.29, 0.38),
                zenith: v(0.15, 0.18, 0.25),
                horizon: v(0.30, 0.31, 0.36),
                clouds: 1.0,
                lamps: 0.7,
                exposure: self.exposure * 1.15,
                ..self
            },
            (TimeOfDay::Night, clear) => Self {
                sun_light: v(0.02, 0.024, 0.035) * f32::from(u8::from(clear)),
                ambient: v(0.040, 0.042, 0.056),
                zenith: v(0.006, 0.009, 0.02),
                horizon: v(0.05, 0.042, 0.045),
                clouds: self.clouds * 0.5,
                haze: self.haze * 1.5,
                exposure: self.exposure * 1.6,
                lamps: 1.0,
                ..self
            },
        }
    }

    /// Whether the sun casts shadows worth a ray.
    pub fn sun_shines(&self) -> bool {
        self.sun_light.x > 0.1
    }

    /// Smooth part of the sky: what haze and reflections take.
    pub fn soft(&self, direction: Vec3) -> Vec3 {
        let up = direction.z.max(0.0);
        let low = (1.0 - up) * (1.0 - up);
        let toward = direction.dot(self.sun).max(0.0);
        let t2 = toward * toward;
        let t8 = t2 * t2 * t2 * t2;
        self.zenith.lerp(self.horizon, low * low) + self.glow * (0.10 * t2 * t2 + 0.22 * t8)
    }

    /// The sky as seen directly, with clouds, sun and the skyline.
    pub fn seen(&self, direction: Vec3) -> Vec3 {
        let mut color = self.soft(direction);
        let up = direction.z;
        if up > 0.02 {
            let scale = 1.0 / (up + 0.12);
            let (x, y) = (direction.x * scale * 1.6, direction.y * scale * 1.6);
            let mass = 0.55 * noise2(x, y, self.salt)
                + 0.3 * noise2(x * 2.3, y * 2.3, self.salt ^ 1)
                + 0.15 * noise2(x * 5.1, y * 5.1, self.salt ^ 2);
            let cover = smoothstep(0.78 - 0.5 * self.clouds, 1.05 - 0.45 * self.clouds, mass);
            let white = self.ambient * 1.1 + self.sun_light * 0.22 + self.glow * 0.15;
            let shade = if self.clouds >= 1.0 { self.zenith * 0.72 } else { white };
            color = color.lerp(shade, cover * 0.8 * smoothstep(0.02, 0.2, up));
        }
        let toward = direction.dot(self.sun);
        if self.glow.x > 0.0 && toward > 0.98 {
            color += self.glow * (2.0 * smoothstep(0.985, 1.0, toward) + 8.0 * smoothstep(0.9988, 0.9992, toward));
        } else if self.lamps >= 1.0 && self.sun_light.x > 0.0 {
            color += Vec3::splat(0.6 * smoothstep(0.9994, 0.9997, toward));
        }
        if up < 0.11 { self.skyline(direction, color) } else { color }
    }

    /// Far buildings and tree tops, so that the world does not end in a straight line.
    fn skyline(&self, direction: Vec3, behind: Vec3) -> Vec3 {
        let azimuth = atan2_f32(direction.y, direction.x);
        let ridge = 0.018 + 0.022 * noise2(azimuth * 9.0, 0.5, self.salt ^ 5);
        let column = (azimuth * 22.0).floor() as i32;
        let hash = hash2(column, 3, self.salt);
        let tower = if hash % 5 < 2 { 0.02 + 0.075 * unit(hash) } else { 0.0 };
        let top = ridge.max(tower);
        if direction.z > top {
            return behind;
        }
        let haze = self.soft(Vec3::new(direction.x, direction.y, 0.02).normalize());
        let dark = self.ambient * 0.12;
        let mut color = haze.lerp(dark, if tower > ridge { 0.35 } else { 0.45 });
        if self.lamps > 0.3 && tower > ridge {
            let cell = hash2((azimuth * 260.0).floor() as i32, (direction.z * 260.0).floor() as i32, self.salt);
            if cell.is_multiple_of(4) {
                color += Vec3::new(0.5, 0.38, 0.2) * (self.lamps * 0.5);
            }
        }
        color
    }

    /// A colour seen through `distance` metres of air.
    pub fn through_air(&self, color: Vec3, direction: Vec3, distance: f32) -> Vec3 {
        let clear = fade_exp(distance * self.haze);
        let air = self.soft(Vec3::new(direction.x, direction.y, direction.z.max(0.03)));
        air.lerp(color, clear)
    }

    /// Linear light to 8 bits: exposure, a shoulder for highlights, a gamma of 2.
    pub fn display(&self, light: Vec3) -> [f32; 3] {
        (light * self.exposure).to_array().map(|c| {
            let c = c.max(0.0);
            // Reinhard's curve with a white point of 3.
            (c * (1.0 + c * (1.0 / 9.0)) / (1.0 + c)).min(1.0).sqrt() * 255.0
        })
    }
}
