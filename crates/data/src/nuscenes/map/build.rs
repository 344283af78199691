//! Follows the tokens of an expansion file.

use std::collections::HashMap;
use std::path::Path;

use geometry::glam::DVec2;

use super::rows::{AreaRow, DividerRow, MapFile, PolygonRow};
use super::{Arcline, CityMap, Divider, FARTHEST_M, LanePath, LayerArea, MapLayer, MapPolygon};
use crate::DataError;
use crate::polygon::{doubled_area, union};
use crate::store::StoredFile;

/// Polygons that enclose less are degenerate, square metres.
const SMALLEST_M2: f64 = 1e-6;
/// Older expansions lack the arcline paths and have other lanes.
const OLDEST: f64 = 1.3;

pub(super) fn read(file: &StoredFile) -> Result<CityMap, DataError> {
    let path = file.path();
    let rows: MapFile = serde_json::from_slice(&file.bytes()?)
        .map_err(|error| DataError::Json { why: error.to_string(), path: path.to_owned() })?;
    if !rows.version.parse::<f64>().is_ok_and(|version| version >= OLDEST) {
        return Err(bad(format!("version {:?} instead of 1.3", rows.version), path));
    }
    let index = Index::new(&rows, path)?;
    let mut map = CityMap { canvas_m: rows.canvas_edge, ..CityMap::default() };
    for row in &rows.drivable_area {
        let polygons = row.polygon_tokens.iter().map(|token| index.polygon(token, "drivable_area", &row.token));
        let polygons = polygons.collect::<Result<Vec<_>, _>>()?;
        map.push(MapLayer::DrivableArea, row.token.clone(), polygons, None);
    }
    for (layer, areas) in [
        (MapLayer::RoadSegment, &rows.road_segment),
        (MapLayer::RoadBlock, &rows.road_block),
        (MapLayer::Lane, &rows.lane),
        (MapLayer::PedCrossing, &rows.ped_crossing),
        (MapLayer::Walkway, &rows.walkway),
        (MapLayer::StopLine, &rows.stop_line),
        (MapLayer::CarparkArea, &rows.carpark_area),
        (MapLayer::LaneConnector, &rows.lane_connector),
    ] {
        for AreaRow { token, polygon_token, stop_line_type } in areas {
            let polygon = index.polygon(polygon_token, layer.name(), token)?;
            map.push(layer, token.clone(), vec![polygon], stop_line_type.clone());
        }
    }
    for (between_roads, dividers) in [(true, &rows.road_divider), (false, &rows.lane_divider)] {
        dividers.iter().try_for_each(|row| map.push_divider(row, between_roads, &index))?;
    }
    map.paths = paths(&rows, path)?;
    let drivable = map.areas.iter().filter(|area| area.layer == MapLayer::DrivableArea);
    map.drivable = union(drivable.flat_map(|area| &area.polygons));
    Ok(map)
}

fn bad(why: String, path: &Path) -> DataError {
    DataError::Format { format: "map expansion", why, path: path.to_owned() }
}

fn paths(rows: &MapFile, path: &Path) -> Result<Vec<LanePath>, DataError> {
    let paths = rows.arcline_path_3.iter().map(|(token, pieces)| {
        let pieces: Result<Vec<Arcline>, String> = pieces.iter().map(Arcline::of_row).collect();
        let pieces = pieces.map_err(|why| bad(format!("arcline path of {token}: {why}"), path))?;
        let links = rows.connectivity.get(token);
        let (incoming, outgoing) = links.map(|row| (row.incoming.clone(), row.outgoing.clone())).unwrap_or_default();
        Ok(LanePath { token: token.clone(), pieces, incoming, outgoing })
    });
    paths.collect()
}

impl CityMap {
    /// Leaves out polygons without an area; the file's own tools skip them too.
    fn push(&mut self, layer: MapLayer, token: String, polygons: Vec<MapPolygon>, stop_line_type: Option<String>) {
        let count = polygons.len();
        let encloses = |ring: &[DVec2]| doubled_area(ring).abs() > 2.0 * SMALLEST_M2;
        let mut polygons: Vec<_> = polygons.into_iter().filter(|polygon| encloses(&polygon.outer)).collect();
        polygons.iter_mut().for_each(|polygon| polygon.holes.retain(|hole| encloses(hole)));
        self.left_out += count - polygons.len();
        if !polygons.is_empty() {
            self.areas.push(LayerArea { layer, token, polygons, stop_line_type });
        }
    }

    fn push_divider(&mut self, row: &DividerRow, between_roads: bool, index: &Index<'_>) -> Result<(), DataError> {
        let table = if between_roads { "road_divider" } else { "lane_divider" };
        let dangling = || index.dangling(table, &row.token, "line_token");
        let nodes = index.lines.get(row.line_token.as_str()).ok_or_else(dangling)?;
        let points = index.points(nodes, "line", &row.line_token, "node_tokens")?;
        if points.windows(2).all(|pair| pair[0] == pair[1]) {
            self.left_out += 1;
            return Ok(());
        }
        let segment_types = row.lane_divider_segments.iter().map(|segment| segment.segment_type.clone()).collect();
        self.dividers.push(Divider { token: row.token.clone(), between_roads, points, segment_types });
        Ok(())
    }
}

/// Finds rows by token.
struct Index<'a> {
    nodes: HashMap<&'a str, DVec2>,
    lines: HashMap<&'a str, &'a [String]>,
    polygons: HashMap<&'a str, &'a PolygonRow>,
    path: &'a Path,
}

impl<'a> Index<'a> {
    fn new(rows: &'a MapFile, path: &'a Path) -> Result<Self, DataError> {
        let (mut nodes, mut lines, mut polygons) = (HashMap::new(), HashMap::new(), HashMap::new());
        let twice = |table, token: &str| DataError::DuplicateToken { table, token: token.into(), path: path.into() };
        for row in &rows.node {
            let point = DVec2::new(row.x, row.y);
            if point.abs().max_element() > FARTHEST_M {
                return Err(bad(format!("node {} lies at ({}, {})", row.token, row.x, row.y), path));
            }
            if nodes.insert(row.token.as_str(), point).is_some() {
                return Err(twice("node", &row.token));
            }
        }
        for row in &rows.line {
            if lines.insert(row.token.as_str(), row.node_tokens.as_slice()).is_some() {
                return Err(twice("line", &row.token));
            }
        }
        for row in &rows.polygon {
            if polygons.insert(row.token.as_str(), row).is_some() {
                return Err(twice("polygon", &row.token));
            }
        }
        Ok(Self { nodes, lines, polygons, path })
    }

    fn dangling(&self, table: &'static str, token: &str, field: &'static str) -> DataError {
        DataError::Dangling { table, token: token.to_owned(), field, path: self.path.to_owned() }
    }

    fn points(
        &self,
        tokens: &[String],
        table: &'static str,
        row: &str,
        field: &'static str,
    ) -> Result<Vec<DVec2>, DataError> {
        let point = |token: &String| self.nodes.get(token.as_str()).copied();
        tokens.iter().map(|token| point(token).ok_or_else(|| self.dangling(table, row, field))).collect()
    }

    fn polygon(&self, token: &str, table: &'static str, owner: &str) -> Result<MapPolygon, DataError> {
        let field = if table == MapLayer::DrivableArea.name() { "polygon_tokens" } else { "polygon_token" };
        let row = self.polygons.get(token).ok_or_else(|| self.dangling(table, owner, field))?;
        let outer = self.points(&row.exterior_node_tokens, "polygon", token, "exterior_node_tokens")?;
        let holes = row.holes.iter().map(|hole| self.points(&hole.node_tokens, "polygon", token, "holes"));
        Ok(MapPolygon { outer, holes: holes.collect::<Result<_, _>>()? })
    }
}
