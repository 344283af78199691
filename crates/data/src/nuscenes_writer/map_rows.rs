//! The objects of a map expansion file, version 1.3, in the release's layer and field order.

use std::collections::BTreeMap;

use serde::Serialize;

use super::arcline::ArclinePiece;

#[derive(Debug, Serialize)]
pub(super) struct Node {
    pub(super) token: String,
    pub(super) x: f64,
    pub(super) y: f64,
}

#[derive(Debug, Serialize)]
pub(super) struct Line {
    pub(super) token: String,
    pub(super) node_tokens: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(super) struct Hole {
    pub(super) node_tokens: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(super) struct Polygon {
    pub(super) token: String,
    pub(super) exterior_node_tokens: Vec<String>,
    pub(super) holes: Vec<Hole>,
}

#[derive(Debug, Serialize)]
pub(super) struct DrivableArea {
    pub(super) token: String,
    pub(super) polygon_tokens: Vec<String>,
}

#[derive(Debug, Serialize)]
pub(super) struct RoadSegment {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) is_intersection: bool,
    pub(super) drivable_area_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct RoadBlock {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) from_edge_line_token: String,
    pub(super) to_edge_line_token: String,
    pub(super) road_segment_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct DividerSegment {
    pub(super) node_token: String,
    pub(super) segment_type: &'static str,
}

#[derive(Debug, Serialize)]
pub(super) struct Lane {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) lane_type: &'static str,
    pub(super) from_edge_line_token: String,
    pub(super) to_edge_line_token: String,
    pub(super) left_lane_divider_segments: Vec<DividerSegment>,
    pub(super) right_lane_divider_segments: Vec<DividerSegment>,
}

#[derive(Debug, Serialize)]
pub(super) struct PedCrossing {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) road_segment_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct PlainArea {
    pub(super) token: String,
    pub(super) polygon_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct StopLine {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) stop_line_type: &'static str,
    pub(super) ped_crossing_tokens: Vec<String>,
    pub(super) traffic_light_tokens: Vec<String>,
    pub(super) road_block_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct CarparkArea {
    pub(super) token: String,
    pub(super) polygon_token: String,
    pub(super) orientation: f64,
    pub(super) road_block_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct RoadDivider {
    pub(super) token: String,
    pub(super) line_token: String,
    pub(super) road_segment_token: String,
}

#[derive(Debug, Serialize)]
pub(super) struct LaneDivider {
    pub(super) token: String,
    pub(super) line_token: String,
    pub(super) lane_divider_segments: Vec<DividerSegment>,
}

#[derive(Debug, Serialize, Default)]
pub(super) struct Connectivity {
    pub(super) incoming: Vec<String>,
    pub(super) outgoing: Vec<String>,
}

/// The whole file.
#[derive(Debug, Serialize, Default)]
pub(super) struct MapExpansion {
    pub(super) version: &'static str,
    pub(super) polygon: Vec<Polygon>,
    pub(super) line: Vec<Line>,
    pub(super) node: Vec<Node>,
    pub(super) drivable_area: Vec<DrivableArea>,
    pub(super) road_segment: Vec<RoadSegment>,
    pub(super) road_block: Vec<RoadBlock>,
    pub(super) lane: Vec<Lane>,
    pub(super) ped_crossing: Vec<PedCrossing>,
    pub(super) walkway: Vec<PlainArea>,
    pub(super) stop_line: Vec<StopLine>,
    pub(super) carpark_area: Vec<CarparkArea>,
    pub(super) road_divider: Vec<RoadDivider>,
    pub(super) lane_divider: Vec<LaneDivider>,
    pub(super) traffic_light: Vec<PlainArea>,
    pub(super) lane_connector: Vec<PlainArea>,
    pub(super) arcline_path_3: BTreeMap<String, Vec<ArclinePiece>>,
    pub(super) connectivity: BTreeMap<String, Connectivity>,
    pub(super) canvas_edge: [f64; 2],
}
