//! Writes the vector map of a network.

use glam::DVec2;

use crate::curve::Curve;
use crate::map::{MapArea, MapAreaKind, MapLane, MapLine, MapLineKind, Paint, VectorMap};
use crate::network::{Network, Road};
use crate::outline::{AtCarpark, counter_clockwise, junction_ring, offset_line, side_lines, without_repeats};

/// Points on a connector's lines.
const CONNECTOR_STEPS: usize = 12;

impl VectorMap {
    /// The map of a network.
    pub(crate) fn of(network: &Network) -> Self {
        let mut map = Self::default();
        map.add_drivable(network);
        for road in &network.roads {
            map.add_road(road);
        }
        map.add_lanes(network);
        map
    }

    fn add_drivable(&mut self, network: &Network) {
        let right = side_lines(network, -1.0, AtCarpark::Follow);
        let left = side_lines(network, 1.0, AtCarpark::Follow);
        let mut ring: Vec<DVec2> = right.iter().flatten().copied().collect();
        ring.extend(left.iter().rev().flat_map(|line| line.iter().rev()).copied());
        let mut holes = Vec::new();
        if let Some(park) = &network.carpark {
            let mut island = counter_clockwise(park.ring(network.main(), park.island_s, park.island_d));
            island.reverse();
            let outer = counter_clockwise(park.ring(network.main(), park.s, park.d));
            self.areas.push(MapArea { kind: MapAreaKind::Carpark, outer, holes: vec![island.clone()] });
            self.add_boundary(&[island.as_slice(), &island[..1]].concat());
            holes.push(island);
        }
        let outer = counter_clockwise(without_repeats(&ring));
        self.areas.push(MapArea { kind: MapAreaKind::DrivableArea, outer, holes });
        for line in right.iter().chain(&left) {
            self.add_boundary(line);
        }
        for junction in &network.junctions {
            self.add_area(MapAreaKind::Intersection, junction_ring(network, junction));
        }
        for side in [-1.0, 1.0] {
            let width = network.main().sidewalk_width;
            for line in side_lines(network, side, AtCarpark::Break) {
                let outer_edge = offset_line(&line, side * width);
                let ring = line.iter().chain(outer_edge.iter().rev()).copied().collect();
                self.add_area(MapAreaKind::Walkway, ring);
            }
        }
    }

    fn add_boundary(&mut self, points: &[DVec2]) {
        self.lines.push(MapLine { kind: MapLineKind::Boundary, points: points.to_vec(), paint: Paint::None });
    }

    fn add_area(&mut self, kind: MapAreaKind, ring: Vec<DVec2>) {
        self.areas.push(MapArea { kind, outer: counter_clockwise(ring), holes: Vec::new() });
    }

    fn add_road(&mut self, road: &Road) {
        let (curve, half) = (&road.curve, road.half());
        for [from, to] in road.stretches() {
            self.add_area(MapAreaKind::RoadSegment, strip(curve, [from, to], [-half, half]));
        }
        for crossing in &road.crossings {
            let ring = counter_clockwise(strip(curve, *crossing, [-half, half]));
            let outline = ring.iter().chain(&ring[..1]).copied().collect();
            self.lines.push(MapLine { kind: MapLineKind::Crossing, points: outline, paint: Paint::None });
            self.add_area(MapAreaKind::Crossing, ring);
        }
        for stop in &road.stops {
            let middle = 0.5 * (stop.s[0] + stop.s[1]);
            let station = curve.at(middle);
            let points = stop.d.map(|d| station.offset(d)).to_vec();
            self.lines.push(MapLine { kind: MapLineKind::StopLine, points, paint: Paint::SolidWhite });
            self.add_area(MapAreaKind::StopLine, strip(curve, stop.s, stop.d));
        }
        let edge = f64::from(road.lanes) * road.lane_width;
        for stripe in road.stripes.iter().filter(|s| s.d.abs() < edge - 0.1) {
            let kind = if stripe.d == 0.0 { MapLineKind::RoadDivider } else { MapLineKind::LaneDivider };
            for [from, to] in Road::without(&road.bare, 0.0, curve.length()) {
                let points = curve.polyline(from, to, stripe.d);
                self.lines.push(MapLine { kind, points, paint: stripe.paint });
            }
        }
    }

    fn add_lanes(&mut self, network: &Network) {
        let mut ends: Vec<LaneEnds> = Vec::new();
        for (road_index, road) in network.roads.iter().enumerate() {
            for range in road.stretches() {
                for direction in [1.0, -1.0] {
                    for index in 0..road.lanes {
                        let d = road.lane_offset(index, direction, network.traffic_side);
                        self.lanes.push(lane(road, range, direction, d));
                        ends.push(LaneEnds { road: road_index, index });
                    }
                }
            }
        }
        for junction in &network.junctions {
            let center = network.main().curve.at(junction.main_s).point;
            let side = &network.roads[junction.side_road];
            let reach = (network.main().half() + side.half() + 2.0 * junction.fillet) + 1.0;
            self.connect(network, &ends, center, reach);
        }
        let lines = self.lanes.iter().map(|lane| lane.centerline.clone()).collect::<Vec<_>>();
        self.lines.extend(lines.into_iter().map(|points| MapLine {
            kind: MapLineKind::Centerline,
            points,
            paint: Paint::None,
        }));
    }

    /// Connectors between all lanes that end and start at one junction.
    fn connect(&mut self, network: &Network, ends: &[LaneEnds], center: DVec2, reach: f64) {
        let near = |point: DVec2| (point - center).length() < reach;
        for from in 0..ends.len() {
            for to in 0..ends.len() {
                let (start, first) = end_of(&self.lanes[from].centerline);
                let (end, last) = start_of(&self.lanes[to].centerline);
                if !near(start) || !near(end) || first.dot(last) < -0.5 {
                    continue;
                }
                let turn = first.perp_dot(last);
                let allowed = if turn.abs() < 0.5 {
                    ends[from].road == ends[to].road && ends[from].index == ends[to].index
                } else {
                    // A turn toward the kerb uses the outermost lanes, a turn across the other direction the innermost.
                    let outermost = |e: &LaneEnds| e.index + 1 == network.roads[e.road].lanes;
                    let both = [&ends[from], &ends[to]];
                    let to_kerb = turn * network.traffic_side > 0.0;
                    if to_kerb { both.into_iter().all(outermost) } else { both.into_iter().all(|e| e.index == 0) }
                };
                if allowed {
                    self.add_connector(from, to);
                }
            }
        }
    }

    fn add_connector(&mut self, from: usize, to: usize) {
        let curve_between = |from_line: &[DVec2], to_line: &[DVec2]| {
            let ((a, first), (b, last)) = (end_of(from_line), start_of(to_line));
            let pull = (b - a).length() * if first.dot(last) > 0.9 { 1.0 / 3.0 } else { 0.39 };
            bezier([a, a + first * pull, b - last * pull, b])
        };
        let (before, after) = (&self.lanes[from], &self.lanes[to]);
        let connector = MapLane {
            left: curve_between(&before.left, &after.left),
            right: curve_between(&before.right, &after.right),
            centerline: curve_between(&before.centerline, &after.centerline),
            left_paint: Paint::None,
            right_paint: Paint::None,
            connector: true,
            successors: vec![to],
            predecessors: vec![from],
        };
        let index = self.lanes.len();
        self.lanes[from].successors.push(index);
        self.lanes[to].predecessors.push(index);
        self.lanes.push(connector);
    }
}

struct LaneEnds {
    road: usize,
    index: u32,
}

fn lane(road: &Road, [from, to]: [f64; 2], direction: f64, d: f64) -> MapLane {
    let line = |offset: f64| {
        let mut points = road.curve.polyline(from, to, offset);
        if direction < 0.0 {
            points.reverse();
        }
        points
    };
    let (left, right) = (d + direction * road.lane_width * 0.5, d - direction * road.lane_width * 0.5);
    let paint = |at: f64| road.stripes.iter().find(|s| (s.d - at).abs() < 0.05).map_or(Paint::None, |s| s.paint);
    MapLane {
        left: line(left),
        right: line(right),
        centerline: line(d),
        left_paint: paint(left),
        right_paint: paint(right),
        connector: false,
        successors: Vec::new(),
        predecessors: Vec::new(),
    }
}

fn strip(curve: &Curve, s: [f64; 2], d: [f64; 2]) -> Vec<DVec2> {
    let mut ring = curve.polyline(s[0], s[1], d[0]);
    ring.extend(curve.polyline(s[0], s[1], d[1]).into_iter().rev());
    ring
}

fn end_of(line: &[DVec2]) -> (DVec2, DVec2) {
    let [.., before, last] = line else { return (DVec2::ZERO, DVec2::X) };
    (*last, (*last - *before).normalize_or_zero())
}

fn start_of(line: &[DVec2]) -> (DVec2, DVec2) {
    let [first, next, ..] = line else { return (DVec2::ZERO, DVec2::X) };
    (*first, (*next - *first).normalize_or_zero())
}

fn bezier([a, b, c, d]: [DVec2; 4]) -> Vec<DVec2> {
    (0..=CONNECTOR_STEPS)
        .map(|i| {
            let t = i as f64 / CONNECTOR_STEPS as f64;
            let u = 1.0 - t;
            a * (u * u * u) + b * (3.0 * u * u * t) + c * (3.0 * u * t * t) + d * (t * t * t)
        })
        .collect()
}
