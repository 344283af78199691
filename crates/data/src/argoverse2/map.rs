//! The vector map of a log, as its archive holds it: city frame, metres.

use std::collections::BTreeMap;

use geometry::glam::{DVec2, DVec3};
use serde::{Deserialize, Deserializer, Serialize};
use world::{MapAreaKind, Paint, VectorMap};

use crate::DataError;
use crate::store::{Store, StoredFile};

/// A map archive. Keys are the ids as text.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Argoverse2Map {
    /// Zebra crossings.
    pub pedestrian_crossings: BTreeMap<String, PedestrianCrossing>,
    /// Pieces of lanes.
    pub lane_segments: BTreeMap<String, LaneSegment>,
    /// Where vehicles can drive: the union of these areas.
    pub drivable_areas: BTreeMap<String, DrivableArea>,
}

/// A point of the city frame, metres. Heights that the file lacks are taken from the nearest point of the same line.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct MapPoint {
    /// East.
    pub x: f64,
    /// North.
    pub y: f64,
    /// Up.
    #[serde(deserialize_with = "height")]
    pub z: f64,
}

/// Two edges that run in the same direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PedestrianCrossing {
    /// One edge.
    pub edge1: Vec<MapPoint>,
    /// The other edge.
    pub edge2: Vec<MapPoint>,
    /// Unique in the archive.
    pub id: i64,
}

/// A piece of a lane between two boundaries in driving direction.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LaneSegment {
    /// Unique in the archive.
    pub id: i64,
    /// True inside an intersection.
    pub is_intersection: bool,
    /// `VEHICLE`, `BIKE` or `BUS`.
    pub lane_type: String,
    /// Left border.
    pub left_lane_boundary: Vec<MapPoint>,
    /// Paint on the left border, such as `DASHED_WHITE`.
    pub left_lane_mark_type: String,
    /// Right border.
    pub right_lane_boundary: Vec<MapPoint>,
    /// Paint on the right border.
    pub right_lane_mark_type: String,
    /// Ids of the segments that follow; they may lie outside the archive.
    #[serde(default)]
    pub successors: Vec<i64>,
    /// Ids of the segments before; they may lie outside the archive.
    #[serde(default)]
    pub predecessors: Vec<i64>,
    /// Id of the segment to the right; it may lie outside the archive.
    #[serde(default)]
    pub right_neighbor_id: Option<i64>,
    /// Id of the segment to the left; it may lie outside the archive.
    #[serde(default)]
    pub left_neighbor_id: Option<i64>,
}

/// An area that vehicles can use.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DrivableArea {
    /// Outline; the first point may be repeated at the end.
    pub area_boundary: Vec<MapPoint>,
    /// Unique in the archive.
    pub id: i64,
}

impl MapPoint {
    pub(super) fn to_vec(self) -> DVec3 {
        DVec3::new(self.x, self.y, self.z)
    }
}

/// NaN until [`fill_heights`] has seen the whole line.
fn height<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}

/// The one map archive of a log; `None` without any.
pub(super) fn find_archive(store: &Store, log: &str) -> Result<Option<String>, DataError> {
    the_one(store, log, |name| name.starts_with("log_map_archive_") && name.ends_with(".json"))
}

/// The one file of a log's map folder with such a name.
///
/// # Errors
/// [`DataError::Format`] when there are several: which of them is meant cannot be known.
pub(super) fn the_one(store: &Store, log: &str, is_it: fn(&str) -> bool) -> Result<Option<String>, DataError> {
    let folder = format!("{log}/map");
    let mut found = store.list(&folder)?.into_iter().filter(|name| !name.is_folder && is_it(&name.name));
    let first = found.next().map(|name| format!("{folder}/{}", name.name));
    match found.next() {
        None => Ok(first),
        Some(other) => Err(DataError::Format {
            format: "Argoverse 2 map",
            why: "there is another one in the same folder".to_owned(),
            path: store.path(&format!("{folder}/{}", other.name)),
        }),
    }
}

impl Argoverse2Map {
    /// Reads an archive. A bare `NaN`, as Python writes it, is a height that the file lacks.
    ///
    /// # Errors
    /// [`DataError::Json`] naming the file.
    pub fn read(file: &StoredFile) -> Result<Self, DataError> {
        let json = |why: String| DataError::Json { why, path: file.path().to_owned() };
        let bytes = without_bare_names(&file.bytes()?);
        let mut map: Self = serde_json::from_slice(&bytes).map_err(|error| json(error.to_string()))?;
        for line in map.lines_mut() {
            fill_heights(line);
        }
        Ok(map)
    }

    fn lines_mut(&mut self) -> impl Iterator<Item = &mut Vec<MapPoint>> {
        let crossings = self.pedestrian_crossings.values_mut().flat_map(|c| [&mut c.edge1, &mut c.edge2]);
        let lanes = self.lane_segments.values_mut();
        let lanes = lanes.flat_map(|lane| [&mut lane.left_lane_boundary, &mut lane.right_lane_boundary]);
        crossings.chain(lanes).chain(self.drivable_areas.values_mut().map(|area| &mut area.area_boundary))
    }

    /// The map of a procedural world. Every lane becomes one segment; holes of areas (islands of a car park) are lost, for the format
    /// has none.
    pub fn from_world(map: &VectorMap) -> Self {
        let mut found = Self::default();
        let id = |at: usize| at as i64 + 1;
        for (at, lane) in map.lanes.iter().enumerate() {
            // A segment of the same direction whose right border is this one's left border, and the reverse.
            let beside = |mine: &[DVec2], theirs: fn(&world::MapLane) -> &[DVec2]| {
                map.lanes.iter().position(|other| theirs(other) == mine).map(id)
            };
            let segment = LaneSegment {
                id: id(at),
                is_intersection: lane.connector,
                lane_type: "VEHICLE".to_owned(),
                left_lane_boundary: flat(&lane.left),
                left_lane_mark_type: mark(lane.left_paint).to_owned(),
                right_lane_boundary: flat(&lane.right),
                right_lane_mark_type: mark(lane.right_paint).to_owned(),
                successors: lane.successors.iter().copied().map(id).collect(),
                predecessors: lane.predecessors.iter().copied().map(id).collect(),
                right_neighbor_id: beside(&lane.right, |other| &other.left),
                left_neighbor_id: beside(&lane.left, |other| &other.right),
            };
            found.lane_segments.insert(segment.id.to_string(), segment);
        }
        let mut next = map.lanes.len();
        for area in &map.areas {
            match (area.kind, area.outer.as_slice()) {
                (MapAreaKind::DrivableArea, outer) => {
                    let area = DrivableArea { area_boundary: flat(outer), id: id(next) };
                    found.drivable_areas.insert(area.id.to_string(), area);
                }
                // People walk along the longer sides, across the road.
                (MapAreaKind::Crossing, [a, b, c, d]) => {
                    let turned = a.distance(*b) < b.distance(*c);
                    let (edge1, edge2) = if turned { ([*b, *c], [*a, *d]) } else { ([*a, *b], [*d, *c]) };
                    let crossing = PedestrianCrossing { edge1: flat(&edge1), edge2: flat(&edge2), id: id(next) };
                    found.pedestrian_crossings.insert(crossing.id.to_string(), crossing);
                }
                _ => continue,
            }
            next += 1;
        }
        found
    }
}

fn flat(points: &[DVec2]) -> Vec<MapPoint> {
    points.iter().map(|point| MapPoint { x: point.x, y: point.y, z: 0.0 }).collect()
}

fn mark(paint: Paint) -> &'static str {
    match paint {
        Paint::None => "NONE",
        Paint::SolidWhite => "SOLID_WHITE",
        Paint::DashedWhite => "DASHED_WHITE",
        Paint::SolidYellow => "SOLID_YELLOW",
        Paint::DoubleSolidYellow => "DOUBLE_SOLID_YELLOW",
        Paint::DoubleSolidWhite => "DOUBLE_SOLID_WHITE",
    }
}

/// The same JSON with `null` for every `NaN`, `Infinity` and `-Infinity` outside of strings.
fn without_bare_names(bytes: &[u8]) -> Vec<u8> {
    let names: [&[u8]; 3] = [b"NaN", b"-Infinity", b"Infinity"];
    let mut sound = Vec::with_capacity(bytes.len());
    let mut in_string = false;
    let mut rest = bytes;
    while let Some(first) = rest.first() {
        let name = names.iter().find(|name| !in_string && rest.starts_with(name));
        let step = match (first, name) {
            (_, Some(name)) => {
                sound.extend(b"null");
                rest = rest.get(name.len()..).unwrap_or_default();
                continue;
            }
            (b'\\', None) if in_string => 2,
            (b'"', None) => {
                in_string = !in_string;
                1
            }
            _ => 1,
        };
        let (done, left) = rest.split_at(step.min(rest.len()));
        sound.extend(done);
        rest = left;
    }
    sound
}

/// Gives points without a height that of the nearest point along the line which has one; 0 where none has.
fn fill_heights(line: &mut [MapPoint]) {
    let known: Vec<(usize, f64)> =
        line.iter().enumerate().filter(|(_, point)| point.z.is_finite()).map(|(at, point)| (at, point.z)).collect();
    if known.len() == line.len() {
        return;
    }
    for (at, point) in line.iter_mut().enumerate().filter(|(_, point)| !point.z.is_finite()) {
        point.z = known.iter().min_by_key(|(other, _)| other.abs_diff(at)).map_or(0.0, |(_, z)| *z);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bare_names_become_null_but_not_inside_strings() {
        let text = br#"{"NaN \" NaN": [NaN, -Infinity,Infinity, 1.5], "b": "Infinity"}"#;
        let sound = String::from_utf8(without_bare_names(text)).unwrap();
        assert_eq!(sound, r#"{"NaN \" NaN": [null, null,null, 1.5], "b": "Infinity"}"#);
        assert_eq!(without_bare_names(b"\"a\\"), b"\"a\\");
    }

    #[test]
    fn missing_heights_come_from_the_nearest_point() {
        let mut line: Vec<MapPoint> =
            [f64::NAN, 5.0, f64::NAN, f64::NAN, 9.0].iter().map(|z| MapPoint { x: 0.0, y: 0.0, z: *z }).collect();
        fill_heights(&mut line);
        assert_eq!(line.iter().map(|point| point.z).collect::<Vec<_>>(), [5.0, 5.0, 5.0, 9.0, 9.0]);
        let mut line = vec![MapPoint { x: 1.0, y: 2.0, z: f64::NAN }];
        fill_heights(&mut line);
        assert_eq!(line[0].z, 0.0);
    }
}
