//! Rows of buildings along the streets.

use glam::{DVec2, Vec2, Vec3};

use crate::config::WorldConfig;
use crate::dice::Dice;
use crate::fleet::rgb;
use crate::math::hash2;
use crate::scenery::{MANMADE, Site};
use crate::script::Footprint;
use crate::shape::{Form, Look, Surface};

/// Character of a stretch of street.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum District {
    Downtown,
    Residential,
    Industrial,
    Park,
}

struct Plot {
    at: DVec2,
    yaw: f64,
    length: f64,
    depth: f64,
    /// Left (+1) or right (-1) of its street, so that doors face it.
    side: f64,
}

impl Site<'_> {
    /// Buildings along all roads.
    pub fn build(&mut self, dice: &mut Dice, config: &WorldConfig) {
        let share = config.building_density.clamp(0.0, 1.0);
        let salt = dice.bits();
        // A scene leans toward one character but mixes in others.
        let main_character =
            dice.pick(&[District::Downtown, District::Residential, District::Industrial, District::Residential]);
        let network = self.network;
        for (index, road) in network.roads.iter().enumerate() {
            for side in [-1.0, 1.0] {
                let mut s = dice.range(0.0, 8.0);
                while s < road.curve.length() {
                    let block = hash2((s / 75.0) as i32, index as i32 * 2 + i32::from(side > 0.0), salt);
                    let district = match block % 8 {
                        0 => District::Park,
                        1 => District::Residential,
                        2 => District::Downtown,
                        3 => District::Industrial,
                        _ => main_character,
                    };
                    s += self.plot_at(dice, index, s, side, district, share);
                }
            }
        }
    }

    /// Tries one plot and returns how far along the street it reaches.
    fn plot_at(&mut self, dice: &mut Dice, road: usize, s: f64, side: f64, district: District, share: f64) -> f64 {
        let (length, depth, setback, gap) = match district {
            District::Downtown => {
                (dice.range(12.0, 24.0), dice.range(12.0, 18.0), dice.range(1.8, 4.0), dice.range(0.0, 2.5))
            }
            District::Residential => {
                (dice.range(9.0, 14.0), dice.range(7.5, 10.0), dice.range(4.0, 9.0), dice.range(3.0, 9.0))
            }
            District::Industrial => {
                (dice.range(20.0, 38.0), dice.range(14.0, 22.0), dice.range(5.0, 14.0), dice.range(5.0, 14.0))
            }
            District::Park => return 22.0,
        };
        let network = self.network;
        let station = network.roads[road].curve.at(s + length * 0.5);
        let near = network.roads[road].half() + network.main().sidewalk_width + setback;
        let place = |near: f64, length: f64, depth: f64| Plot {
            at: station.offset(side * (near + depth * 0.5)),
            yaw: station.heading,
            length,
            depth,
            side,
        };
        let front = place(near, length, depth);
        if dice.chance(0.92 * share) && self.take(&front) {
            match district {
                District::Downtown => self.tower(dice, &front),
                District::Residential => self.house(dice, &front),
                _ => self.hall(dice, &front),
            }
        }
        // A second row gives the street a skyline.
        if dice.chance(0.45 * share) {
            let far = near + depth + dice.range(8.0, 20.0);
            let (length, depth) = (dice.range(14.0, 22.0), dice.range(12.0, 16.0));
            let back = place(far, length, depth);
            if far + depth < network.extent_m + 15.0 && self.take(&back) {
                if district == District::Residential && dice.chance(0.7) {
                    self.house(dice, &back);
                } else {
                    self.tower(dice, &back);
                }
            }
        }
        length + gap
    }

    /// Takes a plot if it is free.
    fn take(&mut self, plot: &Plot) -> bool {
        let footprint = Footprint::new(plot.at, plot.yaw, plot.length, plot.depth);
        if self.taken.iter().any(|other| other.overlaps(&footprint, 0.4)) {
            return false;
        }
        let clearance = self.network.main().sidewalk_width + 0.9;
        // Points every few metres around the plot: roads are wider than the gaps.
        let corners = footprint.corners();
        let free = (0..4).all(|i| {
            (0..8).all(|k| {
                let point = corners[i].lerp(corners[(i + 1) % 4], f64::from(k) / 8.0);
                self.network.outside_roads(point) > clearance
            })
        });
        if free {
            self.taken.push(footprint);
        }
        free
    }

    fn wall(&self, dice: &mut Dice, look: Look) -> Surface {
        let index = dice.int(0, self.palette.walls.len() as i64 - 1) as usize;
        let color = self.palette.walls[index] * dice.range_f32(0.85, 1.1);
        let glass = rgb(58, 74, 92) * dice.range_f32(0.5, 1.6);
        Surface { look, color, accent: glass, label: MANMADE, instance: 0, salt: dice.bits(), lit: true }
    }

    fn box_on(&mut self, plot: &Plot, z: [f64; 2], scale: f64, surface: Surface) {
        let half = Vec3::new(
            (plot.length * 0.5 * scale) as f32,
            (plot.depth * 0.5 * scale) as f32,
            ((z[1] - z[0]) * 0.5) as f32,
        );
        self.put(Form::Block, plot.at, 0.5 * (z[0] + z[1]), plot.yaw, half, surface);
    }

    fn tower(&mut self, dice: &mut Dice, plot: &Plot) {
        let facade = self.wall(dice, Look::Facade);
        let roll = dice.unit();
        let height = 9.0 + 30.0 * roll * roll;
        let trim = Surface { look: Look::Wall, color: facade.color * 0.75, ..facade };
        if height > 18.0 && dice.chance(0.5) {
            let podium = dice.range(4.0, 8.0);
            self.box_on(plot, [0.0, podium], 1.0, facade);
            self.box_on(plot, [podium, podium + 0.35], 1.01, trim);
            self.box_on(plot, [podium + 0.35, height], 0.8, facade);
            self.box_on(plot, [height, height + 0.5], 0.82, trim);
        } else {
            self.box_on(plot, [0.0, height], 1.0, facade);
            self.box_on(plot, [height, height + 0.5], 1.015, trim);
        }
        let shed = Surface { look: Look::Wall, color: self.palette.roofs[1], ..facade };
        self.box_on(plot, [height + 0.5, height + dice.range(2.0, 3.5)], 0.25, shed);
    }

    fn house(&mut self, dice: &mut Dice, plot: &Plot) {
        let facade = self.wall(dice, Look::Facade);
        let height = dice.pick(&[3.4, 5.8, 6.2]) + dice.range(0.0, 0.5);
        self.box_on(plot, [0.0, height], 1.0, facade);
        let roof = dice.pick(&self.palette.roofs) * dice.range_f32(0.7, 1.2);
        let surface = Site::surface(Look::Roof, roof, MANMADE, dice.bits());
        let rise = dice.range(1.6, 3.4);
        let half = Vec3::new((plot.length * 0.5 + 0.4) as f32, (plot.depth * 0.5 + 0.4) as f32, rise as f32 * 0.5);
        // Gables over the short sides, or a hip roof.
        let ridge = if dice.chance(0.6) { half.x } else { half.x * 0.45 };
        let form = Form::Taper { top: Vec2::new(ridge, 0.05), shift: 0.0 };
        self.put(form, plot.at, height + rise * 0.5, plot.yaw, half, surface);
        if dice.chance(0.6) {
            let at = plot.at + DVec2::new(dice.range(-1.5, 1.5), dice.range(-1.0, 1.0));
            let brick = Site::surface(Look::Wall, rgb(120, 70, 58), MANMADE, dice.bits());
            self.put(Form::Block, at, height + rise * 0.75, plot.yaw, Vec3::new(0.3, 0.3, rise as f32 * 0.55), brick);
        }
    }

    fn hall(&mut self, dice: &mut Dice, plot: &Plot) {
        let mut wall = self.wall(dice, Look::Wall);
        wall.color = wall.color * 0.7 + 0.12;
        let height = dice.range(5.0, 9.5);
        self.box_on(plot, [0.0, height], 1.0, wall);
        let band = Surface { look: Look::Plain, color: wall.accent.max(wall.color * 0.4), ..wall };
        self.box_on(plot, [height - 0.9, height + 0.3], 1.012, band);
        // Gates toward the street.
        let inward = DVec2::new(0.0, -plot.side * (plot.depth * 0.5 + 0.03));
        let (sin, cos) = crate::math::sin_cos(plot.yaw);
        for slot in 0..3 {
            let along = (f64::from(slot) - 1.0) * plot.length * 0.28;
            let local = inward + DVec2::new(along, 0.0);
            let at = plot.at + DVec2::new(cos, sin).rotate(local);
            let gate = Site::surface(Look::Roof, rgb(70, 80, 90) * dice.range_f32(0.6, 2.0), MANMADE, dice.bits());
            self.put(Form::Block, at, 1.8, plot.yaw, Vec3::new(1.9, 0.08, 1.8), gate);
        }
    }
}
