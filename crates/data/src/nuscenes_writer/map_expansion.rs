//! The map expansion, version 1.3: one JSON object per location, coordinates of `ego_pose`, origin in the south-west.
//!
//! Field names and layer order are those of the release; every layer the official map API reads is present. What the procedural
//! world does not know is left empty (`traffic_light`) or derived: a road block is a bundle of neighbouring lanes of one direction.

use glam::DVec2;
use world::{MapAreaKind, MapLine, MapLineKind, Paint, VectorMap};

use super::arcline;
use super::map_rows::{
    CarparkArea, Connectivity, DividerSegment, DrivableArea, Hole, Lane, LaneDivider, Line, MapExpansion, Node,
    PedCrossing, PlainArea, Polygon, RoadBlock, RoadDivider, RoadSegment, StopLine,
};
use super::prior::Rings;
use super::road_blocks;
use super::tokens::TokenSpace;

/// A stop line belongs to a crossing whose middle is at most this far away, metres.
const STOP_LINE_REACH_M: f64 = 12.0;

/// Collects the maps of several worlds that lie beside each other.
#[derive(Debug)]
pub(super) struct MapBuilder<'a> {
    tokens: &'a TokenSpace,
    location: &'static str,
    map: MapExpansion,
}

/// An outline with the token of what it belongs to, for questions of where something lies.
type Outline = (Vec<DVec2>, String);

impl<'a> MapBuilder<'a> {
    pub(super) fn new(tokens: &'a TokenSpace, location: &'static str) -> Self {
        Self { tokens, location, map: MapExpansion { version: "1.3", ..MapExpansion::default() } }
    }

    /// The file's content for a canvas of this size.
    pub(super) fn finish(mut self, canvas_m: DVec2) -> MapExpansion {
        self.map.canvas_edge = canvas_m.to_array();
        self.map
    }

    /// Adds one world's map, moved by `shift`.
    pub(super) fn add(&mut self, map: &VectorMap, shift: DVec2) {
        let map = &shifted(map, shift);
        let segments = self.add_surfaces(map);
        let blocks = self.add_lanes(map, &segments);
        let crossings = self.add_crossings(map, &segments);
        self.add_stop_lines(map, &crossings, &blocks);
        self.add_dividers(map, &segments);
        self.add_plain_areas(map);
    }

    /// Drivable area, road segments and intersections; returns the outlines of the latter two.
    fn add_surfaces(&mut self, map: &VectorMap) -> Vec<Outline> {
        let drivable_area = self.next("drivable_area", self.map.drivable_area.len());
        let polygon_tokens = areas(map, MapAreaKind::DrivableArea).map(|rings| self.polygon(&rings)).collect();
        self.map.drivable_area.push(DrivableArea { token: drivable_area.clone(), polygon_tokens });
        let mut outlines = vec![];
        for (kind, is_intersection) in [(MapAreaKind::RoadSegment, false), (MapAreaKind::Intersection, true)] {
            for rings in areas(map, kind) {
                let token = self.next("road_segment", self.map.road_segment.len());
                let polygon_token = self.polygon(&rings);
                let drivable_area_token = drivable_area.clone();
                outlines.push((rings[0].clone(), token.clone()));
                self.map.road_segment.push(RoadSegment { token, polygon_token, is_intersection, drivable_area_token });
            }
        }
        outlines
    }

    /// Lanes, connectors, their paths and links, and road blocks; returns the outlines of the blocks.
    fn add_lanes(&mut self, map: &VectorMap, segments: &[Outline]) -> Vec<Outline> {
        let (first_lane, first_connector) = (self.map.lane.len(), self.map.lane_connector.len());
        let (mut lanes, mut connectors) = (first_lane, first_connector);
        let mut name = |connector: bool| {
            let (layer, count) = if connector { ("lane_connector", &mut connectors) } else { ("lane", &mut lanes) };
            *count += 1;
            self.next(layer, *count - 1)
        };
        let tokens: Vec<String> = map.lanes.iter().map(|lane| name(lane.connector)).collect();
        for (lane, token) in map.lanes.iter().zip(&tokens) {
            if lane.connector {
                let polygon_token = self.polygon(&[lane.polygon()]);
                self.map.lane_connector.push(PlainArea { token: token.clone(), polygon_token });
            } else {
                self.add_lane(lane, token);
            }
            let named = |indices: &[usize]| indices.iter().map(|i| tokens[*i].clone()).collect();
            let links = Connectivity { incoming: named(&lane.predecessors), outgoing: named(&lane.successors) };
            self.map.connectivity.insert(token.clone(), links);
            self.map.arcline_path_3.insert(token.clone(), arcline::pieces(&lane.centerline));
        }
        let mut outlines = vec![];
        for block in road_blocks::bundles(&map.lanes) {
            let token = self.next("road_block", self.map.road_block.len());
            outlines.push((block.outline.clone(), token.clone()));
            let row = RoadBlock {
                polygon_token: self.polygon(std::slice::from_ref(&block.outline)),
                from_edge_line_token: self.line(&block.from_edge),
                to_edge_line_token: self.line(&block.to_edge),
                road_segment_token: owner(segments, road_blocks::middle(&block.outline)),
                token,
            };
            self.map.road_block.push(row);
        }
        outlines
    }

    fn add_lane(&mut self, lane: &world::MapLane, token: &str) {
        let left = self.nodes(&lane.left);
        let right = self.nodes(&lane.right);
        let divider = |nodes: &[String], paint: Paint| {
            let segment =
                |node: &String| DividerSegment { node_token: node.clone(), segment_type: segment_type(paint) };
            nodes.iter().map(segment).collect()
        };
        let edge = |side: fn(&[DVec2]) -> DVec2| [side(&lane.left), side(&lane.right)];
        let row = Lane {
            token: token.to_owned(),
            polygon_token: self.polygon_of_nodes(right.iter().chain(left.iter().rev()).cloned().collect(), vec![]),
            lane_type: "CAR",
            from_edge_line_token: self.line(&edge(|side| side.first().copied().unwrap_or_default())),
            to_edge_line_token: self.line(&edge(|side| side.last().copied().unwrap_or_default())),
            left_lane_divider_segments: divider(&left, lane.left_paint),
            right_lane_divider_segments: divider(&right, lane.right_paint),
        };
        self.map.lane.push(row);
    }

    fn add_crossings(&mut self, map: &VectorMap, segments: &[Outline]) -> Vec<Outline> {
        let mut outlines = vec![];
        for rings in areas(map, MapAreaKind::Crossing) {
            let token = self.next("ped_crossing", self.map.ped_crossing.len());
            let polygon_token = self.polygon(&rings);
            let road_segment_token = owner(segments, road_blocks::middle(&rings[0]));
            outlines.push((rings[0].clone(), token.clone()));
            self.map.ped_crossing.push(PedCrossing { token, polygon_token, road_segment_token });
        }
        outlines
    }

    fn add_stop_lines(&mut self, map: &VectorMap, crossings: &[Outline], blocks: &[Outline]) {
        for rings in areas(map, MapAreaKind::StopLine) {
            let middle = road_blocks::middle(&rings[0]);
            let near = |(outline, _): &&Outline| distance_to_ring(outline, middle) < STOP_LINE_REACH_M;
            let ped_crossing_tokens: Vec<String> =
                crossings.iter().filter(near).map(|(_, token)| token.clone()).collect();
            let row = StopLine {
                token: self.next("stop_line", self.map.stop_line.len()),
                polygon_token: self.polygon(&rings),
                stop_line_type: if ped_crossing_tokens.is_empty() { "STOP_SIGN" } else { "PED_CROSSING" },
                ped_crossing_tokens,
                traffic_light_tokens: vec![],
                road_block_token: owner(blocks, middle),
            };
            self.map.stop_line.push(row);
        }
    }

    fn add_dividers(&mut self, map: &VectorMap, segments: &[Outline]) {
        for line in &map.lines {
            match line.kind {
                MapLineKind::RoadDivider => {
                    let row = RoadDivider {
                        token: self.next("road_divider", self.map.road_divider.len()),
                        line_token: self.line(&line.points),
                        road_segment_token: owner(segments, line.points[line.points.len() / 2]),
                    };
                    self.map.road_divider.push(row);
                }
                MapLineKind::LaneDivider => self.add_lane_divider(line),
                // Boundaries, centre lines, stop lines and crossings are layers of their own in this format.
                MapLineKind::Boundary | MapLineKind::Centerline | MapLineKind::StopLine | MapLineKind::Crossing => {}
            }
        }
    }

    fn add_lane_divider(&mut self, line: &MapLine) {
        let node_tokens = self.nodes(&line.points);
        let segment_type = segment_type(line.paint);
        let segment = |node: &String| DividerSegment { node_token: node.clone(), segment_type };
        let lane_divider_segments = node_tokens.iter().map(segment).collect();
        let token = self.next("lane_divider", self.map.lane_divider.len());
        let line_token = self.line_of_nodes(node_tokens);
        self.map.lane_divider.push(LaneDivider { token, line_token, lane_divider_segments });
    }

    fn add_plain_areas(&mut self, map: &VectorMap) {
        for rings in areas(map, MapAreaKind::Walkway) {
            let token = self.next("walkway", self.map.walkway.len());
            let polygon_token = self.polygon(&rings);
            self.map.walkway.push(PlainArea { token, polygon_token });
        }
        for rings in areas(map, MapAreaKind::Carpark) {
            let row = CarparkArea {
                token: self.next("carpark_area", self.map.carpark_area.len()),
                polygon_token: self.polygon(&rings),
                orientation: longest_side(&rings[0]).to_angle(),
                road_block_token: String::new(),
            };
            self.map.carpark_area.push(row);
        }
    }

    fn next(&self, layer: &str, count: usize) -> String {
        self.tokens.uuid(layer, &format!("{}/{count}", self.location))
    }

    fn nodes(&mut self, points: &[DVec2]) -> Vec<String> {
        let mut tokens = vec![];
        for point in points {
            let token = self.next("node", self.map.node.len());
            self.map.node.push(Node { token: token.clone(), x: point.x, y: point.y });
            tokens.push(token);
        }
        tokens
    }

    fn line(&mut self, points: &[DVec2]) -> String {
        let node_tokens = self.nodes(points);
        self.line_of_nodes(node_tokens)
    }

    fn line_of_nodes(&mut self, node_tokens: Vec<String>) -> String {
        let token = self.next("line", self.map.line.len());
        self.map.line.push(Line { token: token.clone(), node_tokens });
        token
    }

    fn polygon(&mut self, rings: &[Vec<DVec2>]) -> String {
        let mut tokens = rings.iter().map(|ring| self.nodes(ring)).collect::<Vec<_>>().into_iter();
        let outer = tokens.next().unwrap_or_default();
        self.polygon_of_nodes(outer, tokens.collect())
    }

    fn polygon_of_nodes(&mut self, exterior_node_tokens: Vec<String>, holes: Vec<Vec<String>>) -> String {
        let token = self.next("polygon", self.map.polygon.len());
        let holes = holes.into_iter().map(|node_tokens| Hole { node_tokens }).collect();
        self.map.polygon.push(Polygon { token: token.clone(), exterior_node_tokens, holes });
        token
    }
}

/// The polygons of one kind, outer ring first.
pub(super) fn areas(map: &VectorMap, kind: MapAreaKind) -> impl Iterator<Item = Rings> {
    let rings = |area: &world::MapArea| std::iter::once(area.outer.clone()).chain(area.holes.iter().cloned()).collect();
    map.areas.iter().filter(move |area| area.kind == kind).map(rings)
}

/// The map moved by `shift`.
pub(super) fn shifted(map: &VectorMap, shift: DVec2) -> VectorMap {
    let mut map = map.clone();
    let lines = map.lines.iter_mut().map(|line| &mut line.points);
    let areas = map.areas.iter_mut().flat_map(|area| std::iter::once(&mut area.outer).chain(&mut area.holes));
    let lanes = map.lanes.iter_mut().flat_map(|lane| [&mut lane.left, &mut lane.right, &mut lane.centerline]);
    for point in lines.chain(areas).chain(lanes).flatten() {
        *point += shift;
    }
    map
}

/// The release's words for paint. It has no single broken line: a broken white line is written as `DOUBLE_DASHED_WHITE`.
fn segment_type(paint: Paint) -> &'static str {
    match paint {
        Paint::None => "NIL",
        Paint::SolidWhite => "SINGLE_SOLID_WHITE",
        Paint::DashedWhite => "DOUBLE_DASHED_WHITE",
        Paint::SolidYellow | Paint::DoubleSolidYellow => "SINGLE_SOLID_YELLOW",
        Paint::DoubleSolidWhite => "DOUBLE_SOLID_WHITE",
    }
}

/// Token of the outline around a point; else of the nearest one; empty without outlines.
fn owner(outlines: &[Outline], point: DVec2) -> String {
    let inside = outlines.iter().find(|(ring, _)| contains(ring, point));
    let by_distance =
        |a: &&Outline, b: &&Outline| distance_to_ring(&a.0, point).total_cmp(&distance_to_ring(&b.0, point));
    inside.or_else(|| outlines.iter().min_by(by_distance)).map(|(_, token)| token.clone()).unwrap_or_default()
}

/// Even-odd rule.
pub(super) fn contains(ring: &[DVec2], point: DVec2) -> bool {
    let crossings = sides(ring).filter(|(a, b)| {
        (a.y <= point.y) != (b.y <= point.y) && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
    });
    crossings.count() % 2 == 1
}

fn sides(ring: &[DVec2]) -> impl Iterator<Item = (DVec2, DVec2)> {
    ring.iter().copied().zip(ring.iter().copied().cycle().skip(1))
}

fn distance_to_ring(ring: &[DVec2], point: DVec2) -> f64 {
    let distance = |(a, b): (DVec2, DVec2)| {
        let along = (b - a).length_squared();
        let share = if along > 0.0 { ((point - a).dot(b - a) / along).clamp(0.0, 1.0) } else { 0.0 };
        point.distance(a.lerp(b, share))
    };
    sides(ring).map(distance).fold(f64::INFINITY, f64::min)
}

fn longest_side(ring: &[DVec2]) -> DVec2 {
    sides(ring).map(|(a, b)| b - a).max_by(|a, b| a.length().total_cmp(&b.length())).unwrap_or(DVec2::X)
}
