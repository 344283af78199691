//! Fills a world with actors: traffic, parked vehicles, a work zone, people.

use std::f64::consts::{FRAC_PI_2, PI};

use crate::actor::ActorClass;
use crate::cast::Cast;
use crate::config::WorldConfig;
use crate::dice::{Dice, Purpose};
use crate::fleet::Model;
use crate::network::{Carpark, Network, Road};
use crate::script::{Motion, Profile};

/// Usual distance between vehicles of one lane, metres.
const HEADWAY_M: f64 = 34.0;
/// Ground that scripts cover before and behind the ego's way.
const MARGIN_M: f64 = 110.0;

/// The ego's way: its lane, with a speed that swings slowly.
pub fn ego_motion(dice: &mut Dice, network: &Network) -> Motion {
    let d = network.main().lane_offset(network.ego_lane, 1.0, network.traffic_side);
    let speed = dice.range(6.5, 11.0);
    let profile = profile(dice, speed);
    Motion::Follow { road: 0, d, direction: 1.0, start_s: network.ego_start_s, profile }
}

fn profile(dice: &mut Dice, speed: f64) -> Profile {
    Profile { speed, swing: speed * dice.range(0.05, 0.25), rate: dice.range(0.2, 0.5), phase: dice.range(0.0, 6.2) }
}

/// All actors of a world.
pub fn populate(cast: &mut Cast, seed: u64, config: &WorldConfig) {
    let density = |value: f64| value.clamp(0.0, 3.0);
    let mut traffic = Dice::new(seed, Purpose::Traffic);
    // Some streets are nearly empty, some are full.
    let busy = traffic.range(0.15, 1.25);
    main_traffic(cast, &mut traffic, density(config.traffic_density) * busy);
    work_zone(cast, &mut Dice::new(seed, Purpose::WorkZone));
    parked(cast, &mut Dice::new(seed, Purpose::Parked), density(config.parked_density));
    people(cast, &mut Dice::new(seed, Purpose::People), density(config.pedestrian_density));
}

fn moving_model(dice: &mut Dice, outer_lane: bool) -> Model {
    let roll = dice.unit();
    let class = match roll {
        r if r < 0.68 => ActorClass::Car,
        r if r < 0.80 => ActorClass::Truck,
        r if r < 0.90 => {
            if outer_lane {
                ActorClass::Bus
            } else {
                ActorClass::Car
            }
        }
        _ => ActorClass::Motorcycle,
    };
    Model::draw(dice, class, true)
}

/// Vehicles of one lane share a speed profile, so that they keep their distances; the ego's lane uses the ego's.
fn main_traffic(cast: &mut Cast, dice: &mut Dice, density: f64) {
    let network = cast.network();
    let main = network.main();
    let [first_s, last_s] = cast.ego_range();
    let travel = last_s - first_s;
    for direction in [1.0, -1.0] {
        for index in 0..main.lanes {
            let d = main.lane_offset(index, direction, network.traffic_side);
            let is_ego_lane = direction > 0.0 && index == network.ego_lane;
            let speed = dice.range(6.0, 11.5);
            let own = profile(dice, speed);
            let profile = if is_ego_lane { cast.ego_profile() } else { own };
            // Where vehicles must be at time 0 to pass the ego's surroundings at some time.
            let (low, high) = if direction > 0.0 {
                (first_s - MARGIN_M - travel * 0.5, last_s + MARGIN_M)
            } else {
                (first_s - MARGIN_M, last_s + MARGIN_M + travel)
            };
            let mut s = low + dice.range(0.0, HEADWAY_M);
            while density > 0.05 && s < high {
                let model = moving_model(dice, index + 1 == main.lanes);
                let motion = |s: f64| Motion::Follow { road: 0, d, direction, start_s: s, profile };
                let added = cast.add(model, motion(s), false);
                if added && model.class == ActorClass::Truck && model.style.variant == 1 && dice.chance(0.4) {
                    let trailer = Model::draw(dice, ActorClass::Trailer, false);
                    let gap = (model.size.x + trailer.size.x) * 0.5 + 0.5;
                    cast.add(trailer, motion(s - direction * gap), false);
                }
                s += model.size.x + 7.0 + dice.range(0.0, 2.0) * HEADWAY_M / density.max(0.1);
            }
        }
    }
    side_traffic(cast, dice, density);
}

/// Side streets: vehicles that wait at their stop line, and vehicles that drive away.
fn side_traffic(cast: &mut Cast, dice: &mut Dice, density: f64) {
    let network = cast.network();
    for road_index in 1..network.roads.len() {
        let road = &network.roads[road_index];
        for stop in &road.stops {
            // The stop bar lies on the lanes of the direction that approaches.
            let direction = (stop.d[0] + stop.d[1]).signum() * network.traffic_side;
            let d = road.lane_offset(0, direction, network.traffic_side);
            let mut front = if direction > 0.0 { stop.s[0] - 0.6 } else { stop.s[1] + 0.6 };
            for _ in 0..dice.count(1.2 * density) {
                let model = moving_model(dice, true);
                let s = front - direction * model.size.x * 0.5;
                still_on_road(cast, road_index, s, d, direction, model, false);
                front -= direction * (model.size.x + dice.range(1.2, 2.5));
            }
            for _ in 0..dice.count(0.9 * density) {
                let outward = -direction;
                let d = road.lane_offset(0, outward, network.traffic_side);
                let class = dice.pick(&[ActorClass::Car, ActorClass::Car, ActorClass::Bicycle, ActorClass::Motorcycle]);
                let model = Model::draw(dice, class, true);
                let mean = if class == ActorClass::Bicycle { dice.range(3.0, 5.0) } else { dice.range(5.0, 9.0) };
                let profile = profile(dice, mean);
                let start_s = stop.s[0] + outward * dice.range(4.0, 60.0);
                cast.add(model, Motion::Follow { road: road_index, d, direction: outward, start_s, profile }, false);
            }
        }
    }
}

fn still_on_road(cast: &mut Cast, road: usize, s: f64, d: f64, direction: f64, model: Model, parked: bool) -> bool {
    let station = cast.network().roads[road].curve.at(s);
    let yaw = if direction > 0.0 { station.heading } else { station.heading + PI };
    cast.add(model, Motion::Still { point: station.offset(d), yaw }, parked)
}

/// Stretches of a road's strip at one side where something may stand: away from junctions, crossings and the driveway.
fn free_strip(network: &Network, road_index: usize, side: f64, range: [f64; 2]) -> Vec<[f64; 2]> {
    let road = &network.roads[road_index];
    let mut taken: Vec<[f64; 2]> = road.bare.iter().map(|b| [b[0] - 2.0, b[1] + 2.0]).collect();
    if let (0, Some(park)) = (road_index, &network.carpark)
        && park.side == side
    {
        taken.push([park.driveway[0] - 2.5, park.driveway[1] + 2.5]);
    }
    Road::without(&taken, range[0].max(3.0), range[1].min(road.curve.length() - 3.0))
}

/// Barriers, cones, an excavator and workers at the side of the ego's way.
fn work_zone(cast: &mut Cast, dice: &mut Dice) {
    if !dice.chance(0.6) {
        return;
    }
    let network = cast.network();
    let main = network.main();
    let side = dice.sign();
    let [first, last] = cast.ego_range();
    let strips: Vec<_> =
        free_strip(network, 0, side, [first + 10.0, last + 25.0]).into_iter().filter(|r| r[1] - r[0] > 24.0).collect();
    if strips.is_empty() {
        return;
    }
    let strip = dice.pick(&strips);
    let start = dice.range(strip[0], strip[1] - 23.0);
    // The zone takes the parking strip, or the sidewalk where there is none.
    let lanes = f64::from(main.lanes) * main.lane_width;
    let edge = if main.parking_width > 0.0 { lanes + 0.35 } else { main.half() + 0.4 };
    let middle = side * (edge + 1.75);
    let direction = side * network.traffic_side;
    for i in 0..8 {
        let cone = Model::draw(dice, ActorClass::TrafficCone, false);
        still_on_road(cast, 0, start + f64::from(i) * 3.1, side * edge, 1.0, cone, false);
    }
    for s in [start - 0.4, start + 22.6] {
        let barrier = Model::draw(dice, ActorClass::Barrier, false);
        still_on_road(cast, 0, s, side * (edge + 1.3), direction, barrier, false);
    }
    for i in 0..5 {
        let barrier = Model::draw(dice, ActorClass::Barrier, false);
        let station = main.curve.at(start + 6.0 + 2.5 * f64::from(i));
        let point = station.offset(side * (edge + 3.6));
        cast.add(barrier, Motion::Still { point, yaw: station.heading + FRAC_PI_2 }, false);
    }
    let excavator = Model::draw(dice, ActorClass::ConstructionVehicle, false);
    still_on_road(cast, 0, start + dice.range(8.0, 14.0), middle, direction, excavator, true);
    for _ in 0..2 {
        let worker = Model::draw(dice, ActorClass::Pedestrian, false);
        still_on_road(
            cast,
            0,
            start + dice.range(1.0, 22.0),
            middle + side * dice.range(-1.0, 1.0),
            1.0,
            worker,
            false,
        );
    }
}

fn parked_model(dice: &mut Dice) -> Model {
    let class = match dice.unit() {
        r if r < 0.80 => ActorClass::Car,
        r if r < 0.86 => ActorClass::Truck,
        r if r < 0.90 => ActorClass::Trailer,
        r if r < 0.95 => ActorClass::Motorcycle,
        _ => ActorClass::Bicycle,
    };
    Model::draw(dice, class, false)
}

fn parked(cast: &mut Cast, dice: &mut Dice, density: f64) {
    let network = cast.network();
    let [first, last] = cast.ego_range();
    for road_index in 0..network.roads.len() {
        let road = &network.roads[road_index];
        for side in [-1.0, 1.0] {
            let range = if road_index == 0 { [first - 60.0, last + 90.0] } else { [0.0, road.curve.length()] };
            let share = (dice.range(0.25, 0.85) * density).min(0.95);
            if road.parking_width == 0.0 {
                continue;
            }
            for [from, to] in free_strip(network, road_index, side, range) {
                let mut s = from;
                while s + 7.0 < to {
                    let model = parked_model(dice);
                    if dice.chance(share) && model.size.y < road.parking_width + 0.15 {
                        let d = road.parking_offset(side) + dice.range(-0.08, 0.08);
                        let at = s + model.size.x * 0.5;
                        still_on_road(cast, road_index, at, d, side * network.traffic_side, model, true);
                    }
                    s += model.size.x + dice.range(0.8, 1.8);
                }
            }
        }
    }
    if let Some(park) = network.carpark {
        carpark_rows(cast, dice, &park, density);
    }
}

fn carpark_rows(cast: &mut Cast, dice: &mut Dice, park: &Carpark, density: f64) {
    let share = (dice.range(0.35, 0.8) * density).min(0.95);
    let stalls = ((park.s[1] - park.s[0]) / Carpark::STALL_WIDTH) as usize;
    for (row, d) in [park.d[0] + Carpark::STALL_DEPTH * 0.5, park.d[1] - Carpark::STALL_DEPTH * 0.5].iter().enumerate()
    {
        for stall in 0..stalls {
            let s = park.s[0] + (stall as f64 + 0.5) * Carpark::STALL_WIDTH;
            let before_driveway = row == 0 && s > park.driveway[0] - 1.6 && s < park.driveway[1] + 1.6;
            let model = Model::draw(dice, ActorClass::Car, false);
            if before_driveway || !dice.chance(share) {
                continue;
            }
            let station = cast.network().main().curve.at(s);
            let yaw = station.heading + FRAC_PI_2 * dice.sign();
            cast.add(model, Motion::Still { point: station.offset(park.side * d), yaw }, true);
        }
    }
}

/// Walkers on the sidewalks, people who cross, cyclists beside the kerb.
fn people(cast: &mut Cast, dice: &mut Dice, density: f64) {
    let network = cast.network();
    let [first, last] = cast.ego_range();
    for road_index in 0..network.roads.len() {
        let road = &network.roads[road_index];
        let (from, to) = if road_index == 0 { (first - 30.0, last + 60.0) } else { (5.0, road.curve.length() - 5.0) };
        for side in [-1.0, 1.0] {
            for _ in 0..dice.count((to - from) / 32.0 * density) {
                let walker = Model::draw(dice, ActorClass::Pedestrian, false);
                let d = side * (road.half() + dice.range(0.9, network.main().sidewalk_width - 0.4));
                let direction = dice.sign();
                let start_s = dice.range(from, to);
                let mean = dice.range(0.8, 1.6);
                let profile = Profile { speed: mean, swing: 0.1, rate: 0.3, phase: dice.range(0.0, 6.0) };
                let standing = dice.chance(0.2);
                // Nobody walks through the roadway of a junction: those who would reach it stand still.
                let reach = start_s + direction * mean * 30.0;
                let meets_zone =
                    road.zones.iter().any(|z| start_s.min(reach) < z[1] + 1.0 && start_s.max(reach) > z[0] - 1.0);
                let in_zone = road.zones.iter().any(|z| start_s < z[1] + 1.0 && start_s > z[0] - 1.0);
                if in_zone {
                    continue;
                }
                if standing || meets_zone {
                    still_on_road(cast, road_index, start_s, d, direction, walker, false);
                } else {
                    cast.add(walker, Motion::Follow { road: road_index, d, direction, start_s, profile }, false);
                }
            }
            for _ in 0..dice.count(if road_index == 0 { 1.6 * density } else { 0.0 }) {
                cyclist(cast, dice, side, [from, to]);
            }
        }
        crossers(cast, dice, road_index, density);
    }
}

/// A cyclist who rides on the kerb side of the outer lane, on the edge of the parking strip or of the sidewalk.
fn cyclist(cast: &mut Cast, dice: &mut Dice, side: f64, range: [f64; 2]) {
    let network = cast.network();
    let main = network.main();
    let direction = side * network.traffic_side;
    let d = side * (main.half() + 0.45);
    let mean = dice.range(2.8, 5.0);
    let profile = profile(dice, mean);
    let model = Model::draw(dice, ActorClass::Bicycle, true);
    let start_s = dice.range(range[0], range[1]);
    cast.add(model, Motion::Follow { road: 0, d, direction, start_s, profile }, false);
}

fn crossers(cast: &mut Cast, dice: &mut Dice, road_index: usize, density: f64) {
    let network = cast.network();
    let road = &network.roads[road_index];
    let last_secs = 20.0;
    for crossing in &road.crossings {
        for _ in 0..dice.count(2.5 * density) {
            let walker = Model::draw(dice, ActorClass::Pedestrian, false);
            let side = dice.sign();
            let edge = road.half() + dice.range(0.5, 1.5);
            let motion = Motion::Cross {
                road: road_index,
                s: dice.range(crossing[0] + 0.4, crossing[1] - 0.4),
                d: [side * edge, -side * edge],
                start_secs: dice.range(-6.0, last_secs),
                speed: dice.range(1.0, 1.8),
            };
            cast.add(walker, motion, false);
        }
    }
}
