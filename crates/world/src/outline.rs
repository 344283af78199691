//! The edge of the drivable surface as polylines, from which the map's boundary, the kerbs and the sidewalks are made.

use glam::DVec2;

use crate::math::sin_cos;
use crate::network::{Junction, Network};

/// What the outline does at the driveway of a car park.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AtCarpark {
    /// Goes around the car park.
    Follow,
    /// Stops before the driveway and starts again behind it.
    Break,
}

/// Points on a corner fillet.
const FILLET_STEPS: usize = 6;

/// The left (+1) or right (-1) edge of all roads in the main road's direction, cut at the far ends of side streets.
pub fn side_lines(network: &Network, side: f64, at_carpark: AtCarpark) -> Vec<Vec<DVec2>> {
    let main = network.main();
    let half = main.half();
    let edge = |from: f64, to: f64| main.curve.polyline(from, to, side * half);
    let mut stops: Vec<(f64, Option<&Junction>)> =
        network.junctions.iter().filter(|j| j.has_arm(side)).map(|j| (j.main_s, Some(j))).collect();
    let carpark = network.carpark.filter(|park| park.side == side);
    stops.extend(carpark.iter().map(|park| (park.s[0], None)));
    stops.sort_by(|a, b| a.0.total_cmp(&b.0));

    let mut done = Vec::new();
    let mut line: Vec<DVec2> = Vec::new();
    let mut from = 0.0;
    for (_, junction) in stops {
        if let Some(junction) = junction {
            let (inward, outward, zone) = arm_edges(network, junction, side);
            line.extend(edge(from, zone[0]));
            line.extend(inward);
            done.push(std::mem::replace(&mut line, outward));
            from = zone[1];
        } else if let Some(park) = &carpark {
            line.extend(edge(from, park.driveway[0]));
            if at_carpark == AtCarpark::Follow {
                let [near, far] = park.d;
                let corners = [
                    (park.driveway[0], near),
                    (park.s[0], near),
                    (park.s[0], far),
                    (park.s[1], far),
                    (park.s[1], near),
                    (park.driveway[1], near),
                ];
                line.extend(corners.into_iter().map(|(s, d)| main.curve.at(s).offset(side * d)));
            } else {
                done.push(std::mem::take(&mut line));
            }
            from = park.driveway[1];
        }
    }
    line.extend(edge(from, main.curve.length()));
    done.push(line);
    done.iter().map(|line| without_repeats(line)).collect()
}

/// Edges of one arm of a junction: from the main road out to the arm's end, back in again, and the zone on the main road.
fn arm_edges(network: &Network, junction: &Junction, side: f64) -> (Vec<DVec2>, Vec<DVec2>, [f64; 2]) {
    let main = network.main();
    let road = &network.roads[junction.side_road];
    let (half, width, fillet) = (main.half(), road.half(), junction.fillet);
    let station = main.curve.at(junction.main_s);
    // The main road is straight here, so (s, d) are Cartesian.
    let at = |s: f64, d: f64| station.offset(side * d) + station.tangent * s;
    let arm = road.curve.length() - junction.side_s;
    let corner = |sign: f64| {
        let (center_s, center_d) = (sign * (width + fillet), half + fillet);
        (0..=FILLET_STEPS).map(move |i| {
            let (sin, cos) = sin_cos(std::f64::consts::FRAC_PI_2 * i as f64 / FILLET_STEPS as f64);
            at(center_s - sign * fillet * sin, center_d - fillet * cos)
        })
    };
    let steps = ((arm - half - fillet) / 10.0).ceil() as usize;
    let straight = |sign: f64| {
        (1..=steps).map(move |i| {
            let t = i as f64 / steps as f64;
            at(sign * width, half + fillet + (arm - half - fillet) * t)
        })
    };
    let inward = corner(-1.0).chain(straight(-1.0)).collect();
    let mut outward: Vec<DVec2> = corner(1.0).chain(straight(1.0)).collect();
    outward.reverse();
    let zone = width + fillet;
    (inward, outward, [junction.main_s - zone, junction.main_s + zone])
}

/// Ring of the intersection's own area.
pub fn junction_ring(network: &Network, junction: &Junction) -> Vec<DVec2> {
    let main = network.main();
    let side_points = |side: f64| {
        if junction.has_arm(side) {
            let (inward, outward, _) = arm_edges(network, junction, side);
            let tail = outward.len() - FILLET_STEPS - 1;
            let mut points = inward[..=FILLET_STEPS].to_vec();
            points.extend_from_slice(&outward[tail..]);
            points
        } else {
            let zone = network.roads[junction.side_road].half() + junction.fillet;
            main.curve.polyline(junction.main_s - zone, junction.main_s + zone, side * main.half())
        }
    };
    let mut ring = side_points(-1.0);
    ring.extend(side_points(1.0).into_iter().rev());
    counter_clockwise(without_repeats(&ring))
}

/// Points of a polyline moved to its left.
pub fn offset_line(line: &[DVec2], left_m: f64) -> Vec<DVec2> {
    (0..line.len())
        .map(|i| {
            let before = (line[i] - line[i.saturating_sub(1)]).normalize_or_zero();
            let after = (line[(i + 1).min(line.len() - 1)] - line[i]).normalize_or_zero();
            let middle = (before + after).normalize_or_zero();
            // The mitre keeps the distance to both neighbours; it is bounded for the rounded corners used here.
            let stretch = if before == DVec2::ZERO || after == DVec2::ZERO { 1.0 } else { middle.dot(after).max(0.5) };
            line[i] + middle.perp() * (left_m / stretch)
        })
        .collect()
}

/// Drops points that coincide with their predecessor.
pub fn without_repeats(line: &[DVec2]) -> Vec<DVec2> {
    let mut out: Vec<DVec2> = Vec::with_capacity(line.len());
    for point in line {
        if out.last().is_none_or(|last| (*last - *point).length_squared() > 1e-8) {
            out.push(*point);
        }
    }
    out
}

/// Twice the signed area of a ring.
pub fn doubled_area(ring: &[DVec2]) -> f64 {
    (0..ring.len()).map(|i| ring[i].perp_dot(ring[(i + 1) % ring.len()])).sum()
}

/// The ring turned counter-clockwise.
pub fn counter_clockwise(mut ring: Vec<DVec2>) -> Vec<DVec2> {
    if doubled_area(&ring) < 0.0 {
        ring.reverse();
    }
    ring
}
