//! Draws a road network.

use glam::DVec2;

use crate::config::WorldConfig;
use crate::curve::Curve;
use crate::dice::Dice;
use crate::map::Paint;
use crate::math::sin_cos;
use crate::network::{Carpark, Junction, Network, Road, StopBar, Stripe};

/// Fastest the ego may go on average, m/s; the main road must be long enough for it.
const EGO_TOP_MEAN_MPS: f64 = 11.0;
/// Length of a side street's arm.
const ARM_M: f64 = 115.0;
/// Gap between the junction and its crossing, depth of the crossing, gap to the stop line, depth of the stop line.
const CROSSING: [f64; 4] = [0.8, 3.2, 1.0, 0.4];

impl Network {
    /// A network; `traffic_side` +1 is left-hand.
    pub fn generate(dice: &mut Dice, config: &WorldConfig, traffic_side: f64) -> Self {
        let (main, joints) = main_road(dice, config.duration_secs);
        let mut network = Self {
            ego_start_s: 0.0,
            ego_lane: dice.int(0, i64::from(main.lanes) - 1) as u32,
            roads: vec![main],
            junctions: Vec::new(),
            carpark: None,
            traffic_side,
            extent_m: config.extent_m.clamp(30.0, 120.0),
        };
        let (first_arc_s, second_straight, first_turn) = joints;
        // A third of the scenes have a further street that meets the first straight on the outer side of the bend.
        if dice.chance(0.35) {
            let at = first_arc_s - dice.range(30.0, 55.0);
            network.add_side_street(dice, at, first_turn < 0.0, first_turn > 0.0);
        }
        let middle = 0.5 * (second_straight[0] + second_straight[1]) + dice.range(-6.0, 6.0);
        let arms = dice.pick(&[(true, true), (true, true), (true, false), (false, true)]);
        network.add_side_street(dice, middle, arms.0, arms.1);
        network.ego_start_s = first_arc_s - dice.range(45.0, 75.0);
        network.carpark = carpark(dice, &network, first_arc_s, second_straight);
        for road in &mut network.roads {
            road.stripes = stripes(dice, road);
        }
        network.shift_to_positive();
        network
    }

    fn add_side_street(&mut self, dice: &mut Dice, main_s: f64, left: bool, right: bool) {
        let station = self.main().curve.at(main_s);
        let arm = self.main().half() + ARM_M;
        // The axis starts at the far end of the right arm, or on the main axis when there is only one arm.
        let turn = if left { 1.0 } else { -1.0 };
        let start = if left && right { station.offset(-arm) } else { station.point };
        let length = if left && right { 2.0 * arm } else { arm };
        let side_s = if left && right { arm } else { 0.0 };
        let heading = station.heading + turn * std::f64::consts::FRAC_PI_2;
        let fillet = dice.range(4.5, 7.5);
        let mut road = Road {
            curve: Curve::new(start, heading, &[(length, 0.0)]),
            lanes: 1,
            lane_width: dice.range(3.0, 3.5),
            parking_width: if dice.chance(0.5) { 2.2 } else { 0.0 },
            sidewalk_width: self.main().sidewalk_width,
            stripes: Vec::new(),
            zones: Vec::new(),
            bare: Vec::new(),
            crossings: Vec::new(),
            stops: Vec::new(),
        };
        let side = self.traffic_side;
        let main_zone = road.half() + fillet;
        add_zone(dice, &mut self.roads[0], main_s, main_zone, [true, true], side);
        let side_zone = self.main().half() + fillet;
        add_zone(dice, &mut road, side_s, side_zone, [left && right, true], side);
        self.roads.push(road);
        let side_road = self.roads.len() - 1;
        self.junctions.push(Junction { main_s, side_road, side_s, turn, left, right, fillet });
    }

    /// Map coordinates of real datasets are positive, with the origin at the south-west corner.
    fn shift_to_positive(&mut self) {
        let (low, _) = self.bounds();
        let shift = (DVec2::splat(20.0) - low).ceil();
        for piece in self.roads.iter_mut().flat_map(|r| &mut r.curve.pieces) {
            piece.start += shift;
        }
    }
}

/// The main road, and (start of the first arc, extent of the middle straight, sign of the first turn).
fn main_road(dice: &mut Dice, duration_secs: f64) -> (Road, (f64, [f64; 2], f64)) {
    let lead = 190.0;
    let first = arc(dice);
    let middle = dice.range(105.0, 150.0);
    let second = arc(dice);
    let tail = (EGO_TOP_MEAN_MPS * duration_secs).max(220.0) + 60.0;
    let heading = dice.range(0.0, std::f64::consts::TAU);
    let (sin, cos) = sin_cos(heading);
    let start = DVec2::new(cos, sin) * -lead;
    let curve = Curve::new(start, heading, &[(lead, 0.0), first, (middle, 0.0), second, (tail, 0.0)]);
    let straight = [lead + first.0, lead + first.0 + middle];
    let lanes = if dice.chance(0.5) { 2 } else { 1 };
    let road = Road {
        curve,
        lanes,
        lane_width: dice.range(3.2, 3.7),
        parking_width: if dice.chance(0.55) { dice.range(2.2, 2.5) } else { 0.0 },
        sidewalk_width: dice.range(2.0, 3.8),
        stripes: Vec::new(),
        zones: Vec::new(),
        bare: Vec::new(),
        crossings: Vec::new(),
        stops: Vec::new(),
    };
    (road, (lead, straight, first.1.signum()))
}

/// Length and curvature of a bend.
fn arc(dice: &mut Dice) -> (f64, f64) {
    let radius = dice.range(38.0, 85.0);
    let angle = dice.range(0.45, 1.25);
    (radius * angle, dice.sign() / radius)
}

/// Junction zone around `at` with crossings and stop lines on the arms that exist (before, after).
fn add_zone(dice: &mut Dice, road: &mut Road, at: f64, zone: f64, arms: [bool; 2], side: f64) {
    road.zones.push([at - zone, at + zone]);
    let mut bare = [at - zone, at + zone];
    for (arm, direction) in arms.into_iter().zip([-1.0, 1.0]) {
        if !arm {
            continue;
        }
        let span = |near: f64, far: f64| {
            let (a, b) = (at + direction * (zone + near), at + direction * (zone + far));
            if a < b { [a, b] } else { [b, a] }
        };
        let [gap, depth, stop_gap, stop_depth] = CROSSING;
        let mut near = 0.3;
        if dice.chance(0.85) {
            road.crossings.push(span(gap, gap + depth));
            near = gap + depth + stop_gap;
        }
        // Traffic toward the junction drives against `direction`.
        let lanes = f64::from(road.lanes) * road.lane_width;
        let approach = -direction * side;
        let d = if approach > 0.0 { [0.1, lanes] } else { [-lanes, -0.1] };
        road.stops.push(StopBar { s: span(near, near + stop_depth), d });
        let end = span(near, near + stop_depth + 0.3);
        bare = [bare[0].min(end[0]), bare[1].max(end[1])];
    }
    road.bare.push(bare);
}

/// Painted lines of a road.
fn stripes(dice: &mut Dice, road: &Road) -> Vec<Stripe> {
    let yellow = dice.chance(0.5);
    let center = if road.lanes > 1 {
        if yellow { Paint::DoubleSolidYellow } else { Paint::DoubleSolidWhite }
    } else {
        dice.pick(&[if yellow { Paint::SolidYellow } else { Paint::SolidWhite }, Paint::DashedWhite])
    };
    let mut out = vec![Stripe { d: 0.0, paint: center }];
    let edge = f64::from(road.lanes) * road.lane_width;
    for side in [-1.0, 1.0] {
        out.extend(
            (1..road.lanes).map(|i| Stripe { d: side * f64::from(i) * road.lane_width, paint: Paint::DashedWhite }),
        );
        if road.parking_width > 0.0 || dice.chance(0.6) {
            out.push(Stripe { d: side * edge, paint: Paint::SolidWhite });
        }
    }
    out
}

/// A car park on the ego's way: beside the first or the middle straight, clear of junctions.
fn carpark(dice: &mut Dice, network: &Network, first_arc_s: f64, middle: [f64; 2]) -> Option<Carpark> {
    if !dice.chance(0.75) {
        return None;
    }
    let main = network.main();
    let length = dice.range(30.0, 38.0);
    let candidates = [first_arc_s - length - 4.0, middle[0] + 4.0, middle[1] - length - 4.0];
    let first = dice.int(0, 2) as usize;
    for turn in 0..3 {
        let s = candidates[(first + turn) % 3];
        let range = [s, s + length];
        // 5 m beyond a junction zone keep the side street's sidewalk clear of the car park.
        if main.zones.iter().any(|z| z[0] - 5.0 < range[1] && z[1] + 5.0 > range[0]) {
            continue;
        }
        let side = dice.sign();
        let near = main.half() + main.sidewalk_width + 1.2;
        let depth = 2.0 * Carpark::STALL_DEPTH + 2.0 * 6.2 + 3.0;
        let d = [near, near + depth];
        let island_near = near + Carpark::STALL_DEPTH + 6.2;
        return Some(Carpark {
            side,
            s: range,
            d,
            driveway: [s + length * 0.5 - 3.2, s + length * 0.5 + 3.2],
            island_s: [s + 8.0, s + length - 8.0],
            island_d: [island_near, island_near + 3.0],
        });
    }
    None
}
