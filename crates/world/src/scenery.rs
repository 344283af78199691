//! Everything static beside the roads except buildings: kerbs, lamps, signals, signs, trees, hedges.

use glam::{DVec2, Vec2, Vec3};

use crate::config::WorldConfig;
use crate::dice::Dice;
use crate::fleet::rgb;
use crate::math::sin_cos;
use crate::network::{Network, Road};
use crate::outline::{AtCarpark, offset_line, side_lines};
use crate::palette::Palette;
use crate::script::Footprint;
use crate::shape::{Form, Look, Shape, Surface};

/// Occ3D classes of static things.
pub const SIDEWALK: u8 = 13;
/// Buildings, poles, walls.
pub const MANMADE: u8 = 15;
/// Trees, bushes.
pub const VEGETATION: u8 = 16;

/// Collects static shapes.
pub struct Site<'a> {
    /// Roads to keep clear of.
    pub network: &'a Network,
    /// Colours.
    pub palette: &'a Palette,
    /// World position of the scene's origin.
    pub origin: DVec2,
    /// Shapes so far.
    pub parts: Vec<(Shape, Surface)>,
    /// Ground that is taken: buildings, car park.
    pub taken: Vec<Footprint>,
    /// Heads of street lamps, relative to the origin.
    pub lamps: Vec<Vec3>,
}

impl<'a> Site<'a> {
    /// An empty site; the car park and its driveway are taken from the start.
    pub fn new(network: &'a Network, palette: &'a Palette, origin: DVec2) -> Self {
        let mut site = Self { network, palette, origin, parts: Vec::new(), taken: Vec::new(), lamps: Vec::new() };
        if let Some(park) = &network.carpark {
            for (s, d) in [(park.s, park.d), (park.driveway, [0.0, park.d[0]])] {
                let station = network.main().curve.at(0.5 * (s[0] + s[1]));
                let center = station.offset(park.side * 0.5 * (d[0] + d[1]));
                site.taken.push(Footprint::new(center, station.heading, s[1] - s[0] + 1.0, d[1] - d[0] + 1.0));
            }
        }
        site
    }

    /// Adds a shape: centre on the ground plan, height of its centre, heading, half extents.
    pub fn put(&mut self, form: Form, at: DVec2, z: f64, yaw: f64, half: Vec3, surface: Surface) {
        let (sin, cos) = sin_cos(yaw);
        let center = (at - self.origin).as_vec2().extend(z as f32);
        self.parts.push((Shape { center, turn: Vec2::new(cos as f32, sin as f32), half, form }, surface));
    }

    /// A surface without a pattern of its own.
    pub fn surface(look: Look, color: Vec3, label: u8, salt: u32) -> Surface {
        Surface { look, color, accent: color, label, instance: 0, salt, lit: true }
    }

    /// Whether a disc is clear of roads (by `clearance`) and of taken ground.
    pub fn clear(&self, at: DVec2, radius: f64, clearance: f64) -> bool {
        let disc = Footprint::new(at, 0.0, 2.0 * radius, 2.0 * radius);
        self.network.outside_roads(at) > clearance && !self.taken.iter().any(|t| t.overlaps(&disc, 0.0))
    }

    /// All street furniture.
    pub fn furnish(&mut self, dice: &mut Dice) {
        self.kerbs();
        self.street_lamps(dice);
        self.signals();
        self.signs(dice);
    }

    fn kerbs(&mut self) {
        let network = self.network;
        let surface = Self::surface(Look::Plain, self.palette.kerb, SIDEWALK, 1);
        for side in [-1.0, 1.0] {
            for line in side_lines(network, side, AtCarpark::Break) {
                for pair in offset_line(&line, side * 0.08).windows(2) {
                    self.kerb(pair[0], pair[1], surface);
                }
            }
        }
        if let Some(park) = &network.carpark {
            let ring = park.ring(network.main(), park.island_s, park.island_d);
            for i in 0..ring.len() {
                self.kerb(ring[i], ring[(i + 1) % ring.len()], surface);
            }
        }
    }

    fn kerb(&mut self, a: DVec2, b: DVec2, surface: Surface) {
        let along = b - a;
        let yaw = crate::math::atan2(along.y, along.x);
        let half = Vec3::new(along.length() as f32 * 0.5 + 0.03, 0.08, 0.06);
        self.put(Form::Block, (a + b) * 0.5, 0.06, yaw, half, surface);
    }

    fn street_lamps(&mut self, dice: &mut Dice) {
        let network = self.network;
        let height = dice.range(6.2, 8.5);
        let step = dice.range(22.0, 30.0);
        let metal = Self::surface(Look::Plain, self.palette.metal, MANMADE, 2);
        let glow =
            Surface { accent: self.palette.lamp * 6.0, ..Self::surface(Look::Lamp, Vec3::splat(0.7), MANMADE, 3) };
        for road in &network.roads {
            let mut side = dice.sign();
            let mut s = dice.range(4.0, step);
            while s < road.curve.length() - 4.0 {
                let station = road.curve.at(s);
                let foot = station.offset(side * (road.half() + network.main().sidewalk_width + 0.3));
                if self.clear(foot, 0.3, network.main().sidewalk_width) {
                    let half = Vec3::new(0.10, 0.10, height as f32 * 0.5);
                    self.put(Form::Cone { top: 0.05 }, foot, height * 0.5, station.heading, half, metal);
                    let reach = network.main().sidewalk_width + 1.2;
                    let inward = station.normal() * -side;
                    let arm = Vec3::new(0.05, reach as f32 * 0.5, 0.05);
                    self.put(Form::Block, foot + inward * (reach * 0.5), height, station.heading, arm, metal);
                    let head = foot + inward * reach;
                    self.put(Form::Block, head, height - 0.05, station.heading, Vec3::new(0.14, 0.4, 0.07), glow);
                    self.lamps.push((head - self.origin).as_vec2().extend(height as f32 - 0.2));
                }
                side = -side;
                s += step;
            }
        }
    }

    /// Traffic lights at the corners of every junction: green for the main road, red for the side streets.
    fn signals(&mut self) {
        let network = self.network;
        for junction in &network.junctions {
            let road = &network.roads[junction.side_road];
            for direction in [-1.0, 1.0] {
                let s = junction.main_s - direction * (road.half() + junction.fillet + 0.4);
                let side = direction * network.traffic_side;
                self.signal(network.main(), s, side, direction, 2);
                let arm = if direction > 0.0 { junction.side_s > 0.0 } else { true };
                if arm {
                    let s = junction.side_s - direction * (network.main().half() + junction.fillet + 0.4);
                    self.signal(road, s, side, direction, 0);
                }
            }
        }
    }

    /// A signal that faces traffic of `direction`; `lit` 0 red, 1 amber, 2 green.
    fn signal(&mut self, road: &Road, s: f64, side: f64, direction: f64, lit: usize) {
        let station = road.curve.at(s);
        let foot = station.offset(side * (road.half() + 1.15));
        let metal = Self::surface(Look::Plain, rgb(60, 62, 64), MANMADE, 4);
        self.put(Form::Cone { top: 0.06 }, foot, 1.7, 0.0, Vec3::new(0.07, 0.07, 1.7), metal);
        let case = Self::surface(Look::Plain, rgb(28, 30, 30), MANMADE, 5);
        self.put(Form::Block, foot, 3.3, station.heading, Vec3::new(0.16, 0.2, 0.55), case);
        let colors = [rgb(255, 40, 30), rgb(255, 190, 40), rgb(40, 255, 130)];
        for (index, color) in colors.into_iter().enumerate() {
            let on = index == lit;
            let shade = if on { color } else { color * 0.12 };
            let look = if on { Look::Lamp } else { Look::Plain };
            let surface = Surface { accent: color * 4.0, ..Self::surface(look, shade, MANMADE, 6) };
            let at = foot - station.tangent * (direction * 0.14);
            self.put(Form::Ball, at, 3.66 - 0.36 * index as f64, 0.0, Vec3::splat(0.13), surface);
        }
    }

    fn signs(&mut self, dice: &mut Dice) {
        let network = self.network;
        for road in &network.roads {
            for _ in 0..dice.count(road.curve.length() / 60.0) {
                let (s, side) = (dice.range(4.0, road.curve.length() - 4.0), dice.sign());
                let station = road.curve.at(s);
                let foot = station.offset(side * (road.half() + network.main().sidewalk_width + 0.25));
                let [r, g, b] =
                    dice.pick(&[[200, 30, 30], [25, 70, 160], [235, 235, 235], [230, 180, 30], [20, 110, 60]]);
                let (height, width) = (dice.range(2.3, 3.0), dice.range_f32(0.25, 0.45));
                if !self.clear(foot, 0.5, network.main().sidewalk_width * 0.9) {
                    continue;
                }
                let metal = Self::surface(Look::Plain, self.palette.metal, MANMADE, 7);
                self.put(
                    Form::Cone { top: 0.035 },
                    foot,
                    height * 0.5,
                    0.0,
                    Vec3::new(0.035, 0.035, height as f32 * 0.5),
                    metal,
                );
                let plate = Self::surface(Look::Plain, rgb(r, g, b), MANMADE, 8);
                self.put(Form::Block, foot, height, station.heading, Vec3::new(0.04, width, width), plate);
            }
        }
    }

    /// Street trees, trees and bushes on lawns, hedges.
    pub fn plant(&mut self, dice: &mut Dice, config: &WorldConfig) {
        let network = self.network;
        let density = config.tree_density.clamp(0.0, 3.0);
        let conifers = dice.range(0.0, 0.5);
        let sidewalk = network.main().sidewalk_width;
        for road in &network.roads {
            let length = road.curve.length();
            for side in [-1.0, 1.0] {
                // Alleys come in stretches.
                let spacing = dice.range(7.0, 13.0) / density.max(0.05);
                let (from, to) = (dice.range(0.0, length * 0.4), dice.range(length * 0.5, length));
                let mut s = from;
                while density > 0.02 && s < to {
                    let at = road.curve.at(s).offset(side * (road.half() + sidewalk + dice.range(0.8, 1.4)));
                    if dice.chance(0.8) && self.clear(at, 1.0, sidewalk + 0.4) {
                        let scale = dice.range(0.75, 1.1);
                        self.tree(dice, at, false, scale);
                    }
                    s += spacing;
                }
            }
            for _ in 0..dice.count(length / 3.2 * density) {
                let reach = dice.range(0.0, 1.0);
                let d = road.half() + sidewalk + 3.5 + reach * reach * network.extent_m;
                let at = road.curve.at(dice.range(0.0, length)).offset(dice.sign() * d);
                let conifer = dice.chance(conifers);
                if self.clear(at, 1.8, sidewalk + 2.5) {
                    let scale = dice.range(0.8, 1.7);
                    self.tree(dice, at, conifer, scale);
                }
            }
            for _ in 0..dice.count(length / 9.0 * density) {
                let d = road.half() + sidewalk + dice.range(0.8, 9.0);
                let station = road.curve.at(dice.range(0.0, length));
                let at = station.offset(dice.sign() * d);
                if self.clear(at, 0.8, sidewalk + 0.5) {
                    self.bush(dice, at, station.heading);
                }
            }
        }
        if let Some(park) = &network.carpark {
            for t in [0.25, 0.5, 0.75] {
                let s = park.island_s[0] + (park.island_s[1] - park.island_s[0]) * t;
                let d = 0.5 * (park.island_d[0] + park.island_d[1]);
                self.tree(dice, network.main().curve.at(s).offset(park.side * d), false, 0.7);
            }
        }
    }

    fn tree(&mut self, dice: &mut Dice, at: DVec2, conifer: bool, scale: f64) {
        let bark = rgb(88, 70, 52) * dice.range_f32(0.6, 1.2);
        let trunk = Self::surface(Look::Plain, bark, VEGETATION, dice.bits());
        let leaves = dice.pick(&self.palette.leaves) * dice.range_f32(0.75, 1.25);
        let crown = Self::surface(Look::Foliage, leaves, VEGETATION, dice.bits());
        let size = scale as f32;
        if conifer {
            let height = dice.range(5.0, 9.0) * scale;
            self.put(Form::Cone { top: 0.12 }, at, 0.6, 0.0, Vec3::new(0.16, 0.16, 0.6), trunk);
            for (low, high, radius) in [(0.12, 0.6, 0.24), (0.38, 0.82, 0.18), (0.62, 1.0, 0.12)] {
                let half =
                    Vec3::new((radius * height) as f32, (radius * height) as f32, (0.5 * (high - low) * height) as f32);
                self.put(Form::Cone { top: 0.02 }, at, 0.5 * (high + low) * height, 0.0, half, crown);
            }
            return;
        }
        let stem = dice.range(2.2, 3.2) * scale.max(0.85);
        let radius = dice.range_f32(1.2, 1.9) * size;
        let half = Vec3::new(0.16 * size, 0.16 * size, stem as f32 * 0.5 + 0.25);
        self.put(Form::Cone { top: 0.09 * size }, at, stem * 0.5 + 0.25, 0.0, half, trunk);
        let tall = dice.range_f32(0.9, 1.4);
        let middle = stem + f64::from(radius * tall) * 0.75;
        self.put(Form::Ball, at, middle, dice.range(0.0, 3.0), Vec3::new(radius, radius * 0.92, radius * tall), crown);
        for _ in 0..dice.int(1, 2) {
            let (sin, cos) = sin_cos(dice.range(0.0, std::f64::consts::TAU));
            let shift = DVec2::new(cos, sin) * f64::from(radius) * 0.55;
            let r = radius * dice.range_f32(0.55, 0.75);
            let z = middle + dice.range(-0.35, 0.45) * f64::from(radius);
            self.put(Form::Ball, at + shift, z, 0.0, Vec3::new(r, r, r * 0.9), Surface { salt: dice.bits(), ..crown });
        }
    }

    fn bush(&mut self, dice: &mut Dice, at: DVec2, yaw: f64) {
        let leaves = dice.pick(&self.palette.leaves) * dice.range_f32(0.7, 1.2);
        let surface = Self::surface(Look::Foliage, leaves, VEGETATION, dice.bits());
        if dice.chance(0.35) {
            let half = Vec3::new(dice.range_f32(1.0, 3.0), 0.35, dice.range_f32(0.4, 0.7));
            // A hedge must be clear over its whole length.
            let hedge = Footprint::new(at, yaw, f64::from(half.x) * 2.0, 0.8);
            let sidewalk = self.network.main().sidewalk_width;
            let free = hedge.corners().iter().all(|c| self.clear(*c, 0.2, sidewalk + 0.1));
            if free {
                self.put(Form::Block, at, f64::from(half.z), yaw, half, surface);
            }
        } else {
            let r = dice.range_f32(0.4, 0.85);
            self.put(Form::Ball, at, f64::from(r) * 0.6, 0.0, Vec3::new(r, r, r * 0.85), surface);
        }
    }
}
