//! The vector map of a city district: the map expansion, version 1.3. Coordinates are those of the car's poses, on z = 0.

mod arcline;
mod build;
mod prior;
mod rows;

use geometry::Rigid;
use geometry::glam::DVec2;

pub use arcline::Arcline;
pub use prior::MapPrior;

pub use crate::polygon::MapPolygon;

use crate::local_map::LocalMapBuilder;
use crate::store::StoredFile;
use crate::{DataError, LocalMap, MapKind};

/// Coordinates beyond it are no metres of a city map; they would cost the outlines their precision.
const FARTHEST_M: f64 = 1e6;
/// Spacing of points on centre lines, metres: that of the official map API's examples.
const CENTERLINE_STEP_M: f64 = 1.0;

/// The layers that consist of areas, in the order of the official map API.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[allow(missing_docs, reason = "the names are the file's")]
pub enum MapLayer {
    DrivableArea,
    RoadSegment,
    RoadBlock,
    Lane,
    PedCrossing,
    Walkway,
    StopLine,
    CarparkArea,
    LaneConnector,
}

impl MapLayer {
    /// Its name in the file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::DrivableArea => "drivable_area",
            Self::RoadSegment => "road_segment",
            Self::RoadBlock => "road_block",
            Self::Lane => "lane",
            Self::PedCrossing => "ped_crossing",
            Self::Walkway => "walkway",
            Self::StopLine => "stop_line",
            Self::CarparkArea => "carpark_area",
            Self::LaneConnector => "lane_connector",
        }
    }
}

/// An element of a layer.
#[derive(Debug, Clone, PartialEq)]
pub struct LayerArea {
    /// Its layer.
    pub layer: MapLayer,
    /// Its token.
    pub token: String,
    /// One polygon; drivable areas have several.
    pub polygons: Vec<MapPolygon>,
    /// Why vehicles stop, for stop lines, as written.
    pub stop_line_type: Option<String>,
}

/// A line between roads or lanes.
#[derive(Debug, Clone, PartialEq)]
pub struct Divider {
    /// Its token.
    pub token: String,
    /// True between roads of opposite direction, false between lanes.
    pub between_roads: bool,
    /// At least two, metres.
    pub points: Vec<DVec2>,
    /// How it is painted, for each point, as written; unknown types are kept. Empty between roads.
    pub segment_types: Vec<String>,
}

/// The path of a lane or of a connector through a crossing.
#[derive(Debug, Clone, PartialEq)]
pub struct LanePath {
    /// Token of its lane or connector.
    pub token: String,
    /// In driving direction.
    pub pieces: Vec<Arcline>,
    /// Tokens of the lanes and connectors before it.
    pub incoming: Vec<String>,
    /// Tokens of those that follow.
    pub outgoing: Vec<String>,
}

impl LanePath {
    /// x, y and heading along it, at most `step_m` metres apart.
    pub fn poses(&self, step_m: f64) -> Vec<[f64; 3]> {
        arcline::poses(&self.pieces, step_m)
    }
}

/// The map of one location.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct CityMap {
    /// Width and height of the mapped area, metres.
    pub canvas_m: [f64; 2],
    /// Elements of all layers of areas.
    pub areas: Vec<LayerArea>,
    /// Dividers between roads, then between lanes.
    pub dividers: Vec<Divider>,
    /// Paths, sorted by token.
    pub paths: Vec<LanePath>,
    /// The drivable area as one shape.
    pub drivable: Vec<MapPolygon>,
    /// Polygons and lines that were left out because they enclose nothing or have no length.
    pub left_out: usize,
}

impl CityMap {
    /// Reads an expansion file.
    ///
    /// # Errors
    /// [`DataError::Json`], [`DataError::Dangling`] and [`DataError::DuplicateToken`] for what does not hold together,
    /// [`DataError::Format`] for versions before 1.3 and impossible numbers.
    pub fn read(file: &StoredFile) -> Result<Self, DataError> {
        let map = build::read(file)?;
        if map.left_out > 0 {
            tracing::warn!("{} empty polygons and lines left out: {file}", map.left_out);
        }
        Ok(map)
    }

    /// Layers that have an element at a point, each once, in the order of [`MapLayer`].
    pub fn layers_at(&self, point: DVec2) -> Vec<MapLayer> {
        let at = |area: &&LayerArea| area.polygons.iter().any(|polygon| polygon.contains(point));
        let mut layers: Vec<MapLayer> = self.areas.iter().filter(at).map(|area| area.layer).collect();
        layers.sort();
        layers.dedup();
        layers
    }

    /// The path whose centre line passes a point most closely, with the distance in metres to its nearest point; paths are sampled every
    /// half metre.
    pub fn closest_path(&self, point: DVec2) -> Option<(&LanePath, f64)> {
        let distance = |path: &LanePath| {
            let distances = path.poses(0.5).into_iter().map(|[x, y, _]| point.distance(DVec2::new(x, y)));
            distances.fold(f64::INFINITY, f64::min)
        };
        let found = self.paths.iter().map(|path| (path, distance(path))).min_by(|a, b| a.1.total_cmp(&b.1));
        found.filter(|found| found.1.is_finite())
    }

    /// The map around the car. Lines: dividers, outlines of crossings, the outline of the drivable area, centre lines. Areas: crossings,
    /// the drivable area, stop lines, walkways, car parks.
    ///
    /// # Errors
    /// [`DataError::Config`] for a size that is not positive.
    pub fn around(&self, world_from_ego: &Rigid, half_m: f64) -> Result<LocalMap, DataError> {
        let mut map = LocalMapBuilder::new(world_from_ego, half_m)?;
        for divider in &self.dividers {
            map.add_line(MapKind::Divider, divider.points.iter().map(|point| point.extend(0.0)));
        }
        for shape in &self.drivable {
            map.add_area(MapKind::Boundary, &shape.outer, &shape.holes);
            std::iter::once(&shape.outer).chain(&shape.holes).for_each(|ring| map.add_ring(MapKind::Boundary, ring));
        }
        for path in &self.paths {
            let points = path.poses(CENTERLINE_STEP_M).into_iter().map(|[x, y, _]| DVec2::new(x, y).extend(0.0));
            map.add_line(MapKind::Centerline, points);
        }
        for area in &self.areas {
            let kind = match area.layer {
                MapLayer::PedCrossing => MapKind::Crossing,
                MapLayer::StopLine => MapKind::StopLine,
                MapLayer::Walkway => MapKind::Walkway,
                MapLayer::CarparkArea => MapKind::Carpark,
                _ => continue,
            };
            for polygon in &area.polygons {
                map.add_area(kind, &polygon.outer, &polygon.holes);
                if kind == MapKind::Crossing {
                    map.add_ring(kind, &polygon.outer);
                }
            }
        }
        Ok(map.finish())
    }
}
