//! The road network: one main road, side streets that cross or meet it, a car park.
//!
//! Offsets `d` are metres to the left of a road's axis, `s` metres along it. The main road's heading never turns more than 75° away
//! from its middle straight, so that no two roads meet except at their junction.

use glam::DVec2;

use crate::curve::Curve;
use crate::map::Paint;

/// Painted line along a road.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stripe {
    /// Offset of its middle.
    pub d: f64,
    /// Colour and pattern.
    pub paint: Paint,
}

/// A stop line across the approaching lanes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StopBar {
    /// Extent along the road.
    pub s: [f64; 2],
    /// Extent across the road.
    pub d: [f64; 2],
}

/// A road with its cross-section, the same over its whole length.
#[derive(Debug, Clone, PartialEq)]
pub struct Road {
    /// Axis.
    pub curve: Curve,
    /// Lanes per direction.
    pub lanes: u32,
    /// Lane width.
    pub lane_width: f64,
    /// Width of the parking strip on either side; 0 for none.
    pub parking_width: f64,
    /// Width of the sidewalk on either side.
    pub sidewalk_width: f64,
    /// Painted lines.
    pub stripes: Vec<Stripe>,
    /// Junction zones: no lanes, no kerbs.
    pub zones: Vec<[f64; 2]>,
    /// Zones plus crossings and stop lines: no stripes there.
    pub bare: Vec<[f64; 2]>,
    /// Zebra crossings over the full width.
    pub crossings: Vec<[f64; 2]>,
    /// Stop lines.
    pub stops: Vec<StopBar>,
}

impl Road {
    /// Half of the width between the kerbs.
    pub fn half(&self) -> f64 {
        f64::from(self.lanes) * self.lane_width + self.parking_width + 0.25
    }

    /// Offset of the middle of lane `index` (0 innermost) in direction `direction` (+1 along the axis, -1 against it).
    /// `side` is +1 for left-hand traffic, -1 for right-hand.
    pub fn lane_offset(&self, index: u32, direction: f64, side: f64) -> f64 {
        side * direction * (f64::from(index) + 0.5) * self.lane_width
    }

    /// Offset of the middle of the parking strip at the left (+1) or right (-1).
    pub fn parking_offset(&self, side: f64) -> f64 {
        side * (f64::from(self.lanes) * self.lane_width + self.parking_width * 0.5)
    }

    /// Parts of `from..to` outside the given ranges.
    pub fn without(ranges: &[[f64; 2]], from: f64, to: f64) -> Vec<[f64; 2]> {
        let mut sorted = ranges.to_vec();
        sorted.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut out = Vec::new();
        let mut low = from;
        for range in sorted {
            if range[0] - low > 0.5 {
                out.push([low, range[0].min(to)]);
            }
            low = low.max(range[1]);
        }
        if to - low > 0.5 {
            out.push([low, to]);
        }
        out
    }

    /// Stretches between junctions.
    pub fn stretches(&self) -> Vec<[f64; 2]> {
        Self::without(&self.zones, 0.0, self.curve.length())
    }
}

/// Where a side street crosses or meets the main road.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Junction {
    /// Arc length on the main road.
    pub main_s: f64,
    /// Index of the side street in `Network::roads`.
    pub side_road: usize,
    /// Arc length of the main road's axis on the side street.
    pub side_s: f64,
    /// +1 when the side street's axis points to the main road's left, else -1.
    pub turn: f64,
    /// An arm to the main road's left.
    pub left: bool,
    /// An arm to the main road's right.
    pub right: bool,
    /// Radius of the kerb at the corners.
    pub fillet: f64,
}

impl Junction {
    /// Whether there is an arm on the left (+1) or right (-1) of the main road.
    pub fn has_arm(&self, side: f64) -> bool {
        if side > 0.0 { self.left } else { self.right }
    }
}

/// A car park beside a straight of the main road, in the main road's (s, |d|); with an island.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Carpark {
    /// +1 left, -1 right of the main road.
    pub side: f64,
    /// Extent along the road.
    pub s: [f64; 2],
    /// Extent away from the road.
    pub d: [f64; 2],
    /// Extent of the driveway along the road; it runs from the kerb to `d[0]`.
    pub driveway: [f64; 2],
    /// The island along the road.
    pub island_s: [f64; 2],
    /// The island away from the road.
    pub island_d: [f64; 2],
}

impl Carpark {
    /// Depth of a stall.
    pub const STALL_DEPTH: f64 = 5.2;
    /// Width of a stall.
    pub const STALL_WIDTH: f64 = 2.7;

    /// Corners of a rectangle in (s, |d|) as world points, in order of growing s on the near side first.
    pub fn ring(&self, main: &Road, s: [f64; 2], d: [f64; 2]) -> Vec<DVec2> {
        [(s[0], d[0]), (s[1], d[0]), (s[1], d[1]), (s[0], d[1])]
            .into_iter()
            .map(|(s, d)| main.curve.at(s).offset(self.side * d))
            .collect()
    }
}

/// All roads; index 0 is the main road.
#[derive(Debug, Clone, PartialEq)]
pub struct Network {
    /// Main road, then side streets.
    pub roads: Vec<Road>,
    /// Junctions in order along the main road.
    pub junctions: Vec<Junction>,
    /// Car park, if any.
    pub carpark: Option<Carpark>,
    /// +1 for left-hand traffic, -1 for right-hand.
    pub traffic_side: f64,
    /// Arc length of the ego's start on the main road.
    pub ego_start_s: f64,
    /// Lane of the ego (0 innermost).
    pub ego_lane: u32,
    /// How far scenery reaches from the roads.
    pub extent_m: f64,
}

impl Network {
    /// The main road.
    pub fn main(&self) -> &Road {
        &self.roads[0]
    }

    /// Lower and upper corner of everything that may hold scenery.
    pub fn bounds(&self) -> (DVec2, DVec2) {
        let margin = DVec2::splat(self.extent_m + 25.0);
        let points = self.roads.iter().flat_map(|r| r.curve.polyline(0.0, r.curve.length(), 0.0));
        let (low, high) =
            points.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
        (low - margin, high + margin)
    }

    /// Signed distance-like measure of the drivable area of all roads (not the car park): negative inside, metres outside.
    pub fn outside_roads(&self, point: DVec2) -> f64 {
        let mut best = f64::INFINITY;
        let main = self.main();
        let main_sd = main.curve.project(point);
        if let Some(sd) = main_sd {
            best = sd.y.abs() - main.half();
        }
        for junction in &self.junctions {
            let road = &self.roads[junction.side_road];
            let Some(sd) = road.curve.project(point) else { continue };
            let across = sd.y.abs() - road.half();
            best = match main_sd {
                Some(main_sd) => fillet_union(main_sd.y.abs() - main.half(), across, junction.fillet).min(best),
                None => best.min(across),
            };
        }
        best
    }

    /// Whether a point can be driven on: roads, car park, driveway.
    pub fn drivable(&self, point: DVec2) -> bool {
        self.outside_roads(point) <= 0.0 || self.in_carpark(point)
    }

    /// Whether a point lies on the car park or its driveway (not on the island).
    pub fn in_carpark(&self, point: DVec2) -> bool {
        let Some(park) = &self.carpark else { return false };
        let Some(sd) = self.main().curve.project(point) else { return false };
        let (s, d) = (sd.x, sd.y * park.side);
        let within = |v: f64, range: [f64; 2]| v >= range[0] && v <= range[1];
        let island = within(s, park.island_s) && within(d, park.island_d);
        let driveway = within(s, park.driveway) && d >= 0.0 && d <= park.d[0];
        (within(s, park.s) && within(d, park.d) && !island) || driveway
    }
}

/// Union of two strips (given as distance outside each) whose inner corner is rounded with radius `fillet`.
pub fn fillet_union(a: f64, b: f64, fillet: f64) -> f64 {
    if a > 0.0 && b > 0.0 && a < fillet && b < fillet {
        let (x, y) = (fillet - a, fillet - b);
        fillet - (x * x + y * y).sqrt()
    } else {
        a.min(b)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_cut_out() {
        let parts = Road::without(&[[60.0, 80.0], [10.0, 20.0]], 0.0, 100.0);
        assert_eq!(parts, vec![[0.0, 10.0], [20.0, 60.0], [80.0, 100.0]]);
    }

    #[test]
    fn the_fillet_rounds_only_the_corner() {
        assert!(fillet_union(0.5, 0.5, 5.0) < 0.0);
        assert!(fillet_union(3.0, 3.0, 5.0) > 0.0);
        assert_eq!(fillet_union(6.0, 1.0, 5.0), 1.0);
        assert_eq!(fillet_union(-1.0, 7.0, 5.0), -1.0);
    }
}
