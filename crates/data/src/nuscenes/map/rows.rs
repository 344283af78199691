//! The map expansion as it stands in the file, version 1.3. Fields that are not needed are ignored, layers may be absent.

use std::collections::BTreeMap;

use serde::Deserialize;

use super::arcline::ArclineRow;

#[derive(Deserialize)]
pub(super) struct NodeRow {
    pub token: String,
    pub x: f64,
    pub y: f64,
}

#[derive(Deserialize)]
pub(super) struct LineRow {
    pub token: String,
    pub node_tokens: Vec<String>,
}

#[derive(Deserialize)]
pub(super) struct HoleRow {
    pub node_tokens: Vec<String>,
}

#[derive(Deserialize)]
pub(super) struct PolygonRow {
    pub token: String,
    pub exterior_node_tokens: Vec<String>,
    #[serde(default)]
    pub holes: Vec<HoleRow>,
}

#[derive(Deserialize)]
pub(super) struct DrivableRow {
    pub token: String,
    pub polygon_tokens: Vec<String>,
}

/// Any layer with one polygon.
#[derive(Deserialize)]
pub(super) struct AreaRow {
    pub token: String,
    pub polygon_token: String,
    #[serde(default)]
    pub stop_line_type: Option<String>,
}

#[derive(Deserialize)]
pub(super) struct SegmentRow {
    #[serde(default)]
    pub segment_type: String,
}

/// Road and lane dividers.
#[derive(Deserialize)]
pub(super) struct DividerRow {
    pub token: String,
    pub line_token: String,
    #[serde(default)]
    pub lane_divider_segments: Vec<SegmentRow>,
}

#[derive(Deserialize, Default)]
pub(super) struct LinksRow {
    #[serde(default)]
    pub incoming: Vec<String>,
    #[serde(default)]
    pub outgoing: Vec<String>,
}

/// The whole file.
#[derive(Deserialize)]
pub(super) struct MapFile {
    pub version: String,
    pub canvas_edge: [f64; 2],
    pub node: Vec<NodeRow>,
    pub line: Vec<LineRow>,
    pub polygon: Vec<PolygonRow>,
    #[serde(default)]
    pub drivable_area: Vec<DrivableRow>,
    #[serde(default)]
    pub road_segment: Vec<AreaRow>,
    #[serde(default)]
    pub road_block: Vec<AreaRow>,
    #[serde(default)]
    pub lane: Vec<AreaRow>,
    #[serde(default)]
    pub lane_connector: Vec<AreaRow>,
    #[serde(default)]
    pub ped_crossing: Vec<AreaRow>,
    #[serde(default)]
    pub walkway: Vec<AreaRow>,
    #[serde(default)]
    pub stop_line: Vec<AreaRow>,
    #[serde(default)]
    pub carpark_area: Vec<AreaRow>,
    #[serde(default)]
    pub road_divider: Vec<DividerRow>,
    #[serde(default)]
    pub lane_divider: Vec<DividerRow>,
    #[serde(default)]
    pub arcline_path_3: BTreeMap<String, Vec<ArclineRow>>,
    #[serde(default)]
    pub connectivity: BTreeMap<String, LinksRow>,
}
