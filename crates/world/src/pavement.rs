//! Colours of the ground: surfaces and painted markings, filtered over the pixel's footprint on the ground.

use glam::{Vec2, Vec3};

use crate::ground::{Abreast, Cover, Spot};
use crate::map::Paint;
use crate::math::noise2;
use crate::network::{Carpark, Network};
use crate::palette::Palette;
use crate::texture::{detail, pulse};

/// Half width of a painted line.
const HALF_LINE_M: f32 = 0.075;
/// Half distance of the two lines of a double line.
const DOUBLE_GAP_M: f32 = 0.16;
/// Dashes: painted length, period.
const DASH_M: [f32; 2] = [3.0, 8.0];
/// Period of a zebra's bars.
const ZEBRA_M: f32 = 1.0;

/// The pixel's footprint on the ground.
#[derive(Debug, Clone, Copy)]
pub struct Footing {
    /// Horizontal direction of sight, unit.
    pub sight: Vec2,
    /// Size along the direction of sight, metres.
    pub along: f32,
    /// Size across it.
    pub across: f32,
}

impl Footing {
    /// Size of the footprint along a unit direction.
    fn width(&self, axis: Vec2) -> f32 {
        let (a, b) = (self.along * self.sight.dot(axis), self.across * self.sight.perp_dot(axis));
        (a * a + b * b).sqrt()
    }
}

#[derive(Debug, Clone)]
struct Marks {
    half: f32,
    lane_width: f32,
    lanes_half: f32,
    stripes: Vec<(f32, Paint)>,
    bare: Vec<[f32; 2]>,
    crossings: Vec<[f32; 2]>,
    stops: Vec<([f32; 2], [f32; 2])>,
}

/// Everything painted on the ground, and its colours.
#[derive(Debug, Clone)]
pub struct Pavement {
    roads: Vec<Marks>,
    carpark: Option<Carpark>,
    palette: Palette,
    wet: f32,
    salt: u32,
}

impl Pavement {
    /// Prepares the markings of a network.
    pub fn new(network: &Network, palette: &Palette, wet: f32, salt: u32) -> Self {
        let range = |r: &[f64; 2]| [r[0] as f32, r[1] as f32];
        let roads = network.roads.iter().map(|road| Marks {
            half: road.half() as f32,
            lane_width: road.lane_width as f32,
            lanes_half: (f64::from(road.lanes) * road.lane_width) as f32,
            stripes: road.stripes.iter().map(|s| (s.d as f32, s.paint)).collect(),
            bare: road.bare.iter().map(range).collect(),
            crossings: road.crossings.iter().map(range).collect(),
            stops: road.stops.iter().map(|s| (range(&s.s), range(&s.d))).collect(),
        });
        Self { roads: roads.collect(), carpark: network.carpark, palette: palette.clone(), wet, salt }
    }

    /// Colour of a spot and how much it mirrors (0 dry to 1 puddle).
    pub fn color(&self, spot: &Spot, point: Vec2, footing: &Footing) -> (Vec3, f32) {
        let pixel = footing.along.min(footing.across * 6.0);
        let patches = noise2(point.x * 0.11, point.y * 0.11, self.salt);
        let grain = (noise2(point.x * 11.0, point.y * 11.0, self.salt ^ 1) - 0.5) * detail(0.12, pixel);
        let palette = &self.palette;
        let mut color = match spot.cover {
            Cover::Road => {
                let worn = self.tracks(spot);
                palette.asphalt * (0.84 + 0.32 * patches + 0.5 * grain) * worn
            }
            Cover::Carpark => palette.carpark * (0.84 + 0.32 * patches + 0.5 * grain),
            Cover::Sidewalk => palette.sidewalk * (0.9 + 0.2 * patches + 0.3 * grain) * slabs(spot, pixel),
            Cover::Paved => palette.paved * (0.85 + 0.3 * patches + 0.3 * grain),
            Cover::Grass => {
                let tufts = (noise2(point.x * 2.1, point.y * 2.1, self.salt ^ 2) - 0.5) * detail(0.8, pixel);
                palette.grass * (0.75 + 0.5 * patches + 0.5 * tufts + 0.7 * grain)
            }
            Cover::Soil => palette.soil * (0.75 + 0.5 * patches + 0.7 * grain),
        };
        let (paint, cover) = match spot.cover {
            Cover::Road => self.markings(spot, footing),
            Cover::Carpark => (Vec3::splat(0.62), self.stalls(spot, footing)),
            _ => (Vec3::ZERO, 0.0),
        };
        color = color.lerp(paint * (0.85 + 0.3 * patches), cover * 0.92);
        if self.wet > 0.0 {
            color *= 1.0 - 0.4 * self.wet;
        }
        let hard = matches!(spot.cover, Cover::Road | Cover::Carpark | Cover::Paved | Cover::Sidewalk);
        let puddle = if hard && self.wet > 0.0 {
            let pools = noise2(point.x * 0.35, point.y * 0.35, self.salt ^ 4);
            self.wet * (0.25 + 0.75 * ((pools - 0.45) * 4.0).clamp(0.0, 1.0))
        } else {
            0.0
        };
        (color, puddle)
    }

    /// Tyre tracks: lanes are a little darker where wheels run.
    fn tracks(&self, spot: &Spot) -> f32 {
        let Some(a) = spot.main.or(spot.side) else { return 1.0 };
        let marks = &self.roads[a.road];
        if a.d.abs() > marks.lanes_half {
            return 1.08;
        }
        let t = a.d.abs() / marks.lane_width;
        let t = t - t.floor() - 0.5;
        let off = (t.abs() - 0.25).abs();
        1.0 - 0.12 * (1.0 - off * 5.0).max(0.0)
    }

    fn markings(&self, spot: &Spot, footing: &Footing) -> (Vec3, f32) {
        let white = Vec3::splat(0.68);
        let mut best = (white, 0.0f32);
        for a in [spot.main, spot.side].into_iter().flatten() {
            let marks = &self.roads[a.road];
            if a.d.abs() > marks.half {
                continue;
            }
            let within = |r: &[f32; 2]| a.s >= r[0] && a.s <= r[1];
            if !marks.bare.iter().any(within) {
                let found = stripes(marks, &a, footing);
                if found.1 > best.1 {
                    best = found;
                }
                continue;
            }
            let (ws, wd) = (footing.width(a.tangent), footing.width(a.tangent.perp()));
            for crossing in &marks.crossings {
                let along = pulse(a.s, crossing[0], crossing[1], ws);
                if along > 0.0 && a.d.abs() < marks.half - 0.3 {
                    let phase = a.d / ZEBRA_M;
                    let bar = pulse(phase - phase.floor(), 0.0, 0.5, wd / ZEBRA_M);
                    let bar = 0.5 + (bar - 0.5) * detail(ZEBRA_M, wd);
                    best = (white, best.1.max(along * bar));
                }
            }
            for (s, d) in &marks.stops {
                let bar = pulse(a.s, s[0], s[1], ws) * pulse(a.d, d[0], d[1], wd);
                best = (white, best.1.max(bar));
            }
        }
        best
    }

    fn stalls(&self, spot: &Spot, footing: &Footing) -> f32 {
        let (Some(park), Some(a)) = (&self.carpark, spot.main) else { return 0.0 };
        let (s, d) = (a.s - park.s[0] as f32, a.d * park.side as f32);
        let depth = Carpark::STALL_DEPTH as f32;
        let near = d > park.d[0] as f32 && d < park.d[0] as f32 + depth;
        let far = d > park.d[1] as f32 - depth;
        let driveway = near && a.s > park.driveway[0] as f32 - 1.6 && a.s < park.driveway[1] as f32 + 1.6;
        if !(near || far) || driveway {
            return 0.0;
        }
        let period = Carpark::STALL_WIDTH as f32;
        let phase = s / period + 0.5;
        let off = (phase - phase.floor() - 0.5) * period;
        pulse(off, -HALF_LINE_M, HALF_LINE_M, footing.width(a.tangent))
    }
}

fn stripes(marks: &Marks, a: &Abreast, footing: &Footing) -> (Vec3, f32) {
    let wd = footing.width(a.tangent.perp());
    let mut best = (Vec3::ZERO, 0.0f32);
    for (d, paint) in &marks.stripes {
        let off = a.d - d;
        if off.abs() > DOUBLE_GAP_M + HALF_LINE_M + wd {
            continue;
        }
        let line = |at: f32| pulse(off - at, -HALF_LINE_M, HALF_LINE_M, wd);
        let (color, cover) = match paint {
            Paint::None => continue,
            Paint::SolidWhite => (Vec3::splat(0.68), line(0.0)),
            Paint::SolidYellow => (Vec3::new(0.72, 0.46, 0.06), line(0.0)),
            Paint::DoubleSolidWhite => (Vec3::splat(0.68), line(DOUBLE_GAP_M) + line(-DOUBLE_GAP_M)),
            Paint::DoubleSolidYellow => (Vec3::new(0.72, 0.46, 0.06), line(DOUBLE_GAP_M) + line(-DOUBLE_GAP_M)),
            Paint::DashedWhite => {
                let ws = footing.width(a.tangent);
                let [on, period] = DASH_M;
                let phase = a.s / period;
                let dash = pulse((phase - phase.floor()) * period, 0.0, on, ws);
                let share = on / period;
                (Vec3::splat(0.68), line(0.0) * (share + (dash - share) * detail(period, ws)))
            }
        };
        if cover > best.1 {
            best = (color, cover.min(1.0));
        }
    }
    best
}

/// Joints between the slabs of a sidewalk.
fn slabs(spot: &Spot, pixel: f32) -> f32 {
    let Some(a) = spot.main.or(spot.side) else { return 1.0 };
    let joint = |x: f32, period: f32| {
        let phase = x / period;
        pulse(phase - phase.floor(), 0.0, 0.04, pixel / period)
    };
    1.0 - 0.3 * joint(a.s, 1.3).max(joint(a.d, 0.9)) * detail(0.9, pixel)
}
