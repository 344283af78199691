//! The vector map of a segment and its part around the car.

use std::path::Path;

use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};

use super::clip::{clip_line, reaches_square};
use super::proto::{MapFeature, Point};
use crate::{DataError, LocalMap, MapArea, MapKind, MapLine};

/// All features of a segment in its world frame, metres.
#[derive(Debug)]
pub(super) struct WorldMap {
    lines: Vec<(MapKind, Vec<DVec3>)>,
    areas: Vec<Vec<DVec3>>,
}

impl WorldMap {
    /// # Errors
    /// [`DataError::Format`] for coordinates that are no numbers.
    pub fn new(features: &[MapFeature], path: &Path) -> Result<Self, DataError> {
        let mut map = Self { lines: Vec::new(), areas: Vec::new() };
        for feature in features {
            let lines = [
                (MapKind::Centerline, feature.lane.as_ref().map(|lane| &lane.polyline)),
                (MapKind::Divider, feature.road_line.as_ref().map(|line| &line.polyline)),
                (MapKind::Boundary, feature.road_edge.as_ref().map(|edge| &edge.polyline)),
            ];
            for (kind, polyline) in lines {
                if let Some(polyline) = polyline {
                    map.lines.push((kind, points(polyline, path)?));
                }
            }
            if let Some(crosswalk) = &feature.crosswalk {
                map.areas.push(points(&crosswalk.polygon, path)?);
            }
        }
        Ok(map)
    }

    /// The part within ±`half_m` of the car. Lines of one point draw nothing and are left out.
    pub fn around(&self, map_from_ego: &Rigid, half_m: f64) -> LocalMap {
        let ego_from_map = map_from_ego.inverse();
        let to_ego = |points: &[DVec3]| points.iter().map(|point| ego_from_map * *point).collect::<Vec<_>>();
        let mut local = LocalMap::default();
        for (kind, points) in &self.lines {
            let parts = clip_line(&to_ego(points), half_m).into_iter();
            local
                .lines
                .extend(parts.map(|part| MapLine { kind: *kind, points: part.iter().map(DVec3::to_array).collect() }));
        }
        for area in &self.areas {
            let outline: Vec<DVec2> = to_ego(area).iter().map(|point| point.truncate()).collect();
            if reaches_square(&outline, half_m) {
                let outer = outline.iter().map(DVec2::to_array).collect();
                local.areas.push(MapArea { kind: MapKind::Crossing, outer, holes: Vec::new() });
            }
        }
        local
    }
}

fn points(polyline: &[Point], path: &Path) -> Result<Vec<DVec3>, DataError> {
    let points: Vec<DVec3> = polyline.iter().map(|p| DVec3::new(p.x(), p.y(), p.z())).collect();
    if points.iter().all(|point| point.is_finite()) {
        return Ok(points);
    }
    let why = "a map point is not finite".to_owned();
    Err(DataError::Format { format: "Waymo frame", why, path: path.to_owned() })
}
