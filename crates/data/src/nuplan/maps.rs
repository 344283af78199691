//! City maps: GeoPackages, which are SQLite databases, below `<maps>/<city>/<version>/map.gpkg`.
//!
//! Coordinates are longitude and latitude; the table `meta` names the metric system of the car's poses. Maps have no heights.

use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};

use super::database::Database;
use super::utm::Utm;
use super::wkb;
use crate::local_map::LocalMapBuilder;
use crate::polygon::{MapPolygon, union};
use crate::store::{Store, StoredFile, checked_name};
use crate::{DataError, LocalMap, MapKind};

/// The layers whose union is what vehicles may drive on.
const DRIVABLE: [&str; 6] = [
    "road_segments",
    "lanes_polygons",
    "gen_lane_connectors_scaled_width_polygons",
    "intersections",
    "generic_drivable_areas",
    "carpark_areas",
];
/// Further layers of areas.
const AREAS: [(&str, MapKind); 4] = [
    ("crosswalks", MapKind::Crossing),
    ("stop_polygons", MapKind::StopLine),
    ("walkways", MapKind::Walkway),
    ("carpark_areas", MapKind::Carpark),
];
/// Values of `boundary_type_fid` that stand for paint: dashed and solid. The others are virtual.
const PAINTED: [i64; 2] = [0, 2];
/// Longitude and latitude on WGS 84.
const DEGREES: i32 = 4326;

/// Something of the map and the rectangle around it, in the metres of the poses.
#[derive(Debug)]
struct Bounded<T> {
    low: DVec2,
    high: DVec2,
    what: T,
}

/// The map of a city.
#[derive(Debug)]
pub(super) struct CityMap {
    lines: Vec<Bounded<(MapKind, Vec<DVec2>)>>,
    areas: Vec<Bounded<(MapKind, MapPolygon)>>,
    drivable: Vec<Bounded<MapPolygon>>,
}

/// The newest map of the first of these cities that has one.
pub(super) fn find(store: &Store, folder: &str, cities: &[String]) -> Result<Option<StoredFile>, DataError> {
    for city in cities {
        let city = format!("{folder}/{}", checked_name(city, &store.path(folder))?);
        let mut versions = store.list(&city)?;
        versions.sort_by_key(|child| child.name.split('.').map(|part| part.parse().unwrap_or(0)).collect::<Vec<u64>>());
        let newest = versions.iter().rev().find_map(|child| store.find(&format!("{city}/{}/map.gpkg", child.name)));
        if let Some(file) = newest {
            return Ok(Some(file));
        }
    }
    Ok(None)
}

impl CityMap {
    /// # Errors
    /// [`DataError::Format`] and [`DataError::Column`] for a file that is no such map.
    pub fn read(file: &StoredFile) -> Result<Self, DataError> {
        let layers = Layers::open(Database::open(file)?)?;
        let mut map = Self { lines: Vec::new(), areas: Vec::new(), drivable: Vec::new() };
        for (cell, paint) in layers.read("boundaries", Some("boundary_type_fid"))? {
            if paint.is_some_and(|paint| PAINTED.contains(&paint)) {
                map.add_lines(MapKind::Divider, cell);
            }
        }
        for (cell, _) in layers.read("baseline_paths", None)? {
            map.add_lines(MapKind::Centerline, cell);
        }
        for (layer, kind) in AREAS {
            let polygons = layers.read(layer, None)?.into_iter().flat_map(|(cell, _)| cell.polygons);
            map.areas.extend(polygons.map(|polygon| bound((kind, polygon), |area| &area.1.outer)));
        }
        for layer in DRIVABLE {
            let polygons = layers.read(layer, None)?.into_iter().flat_map(|(cell, _)| cell.polygons);
            map.drivable.extend(polygons.map(|polygon| bound(polygon, |polygon| &polygon.outer)));
        }
        if map.lines.is_empty() && map.drivable.is_empty() {
            return Err(layers.database.bad("it has neither lanes nor roads".to_owned()));
        }
        Ok(map)
    }

    fn add_lines(&mut self, kind: MapKind, cell: wkb::Cell) {
        self.lines.extend(cell.lines.into_iter().map(|line| bound((kind, line), |line| &line.1)));
    }

    /// What lies within ±`half_m` of the car. The map is flat and is laid onto the plane of the car's x and y axes: z is zero.
    ///
    /// # Errors
    /// [`DataError::Config`] for a size that is not positive.
    pub fn around(&self, world_from_ego: &Rigid, half_m: f64) -> Result<LocalMap, DataError> {
        // Relative to the car, so that millimetres survive in the union.
        let here = world_from_ego.translation.truncate();
        let flat_from_ego = Rigid::from_yaw(world_from_ego.yaw(), DVec3::ZERO);
        let mut map = LocalMapBuilder::new(&flat_from_ego, half_m)?;
        let reach = DVec2::splat(half_m * std::f64::consts::SQRT_2);
        let relative = |points: &[DVec2]| points.iter().map(|point| *point - here).collect::<Vec<_>>();
        let polygon = |polygon: &MapPolygon| MapPolygon {
            outer: relative(&polygon.outer),
            holes: polygon.holes.iter().map(|hole| relative(hole)).collect(),
        };
        for (kind, line) in near(&self.lines, here, reach) {
            map.add_line(*kind, relative(line).into_iter().map(|point| point.extend(0.0)));
        }
        let drivable: Vec<MapPolygon> = near(&self.drivable, here, reach).map(polygon).collect();
        for shape in union(drivable.iter()) {
            map.add_area(MapKind::Boundary, &shape.outer, &shape.holes);
            std::iter::once(&shape.outer).chain(&shape.holes).for_each(|ring| map.add_ring(MapKind::Boundary, ring));
        }
        for (kind, area) in near(&self.areas, here, reach) {
            let area = polygon(area);
            map.add_area(*kind, &area.outer, &area.holes);
            if *kind == MapKind::Crossing {
                map.add_ring(*kind, &area.outer);
            }
        }
        Ok(map.finish())
    }
}

fn bound<T>(what: T, outline: impl Fn(&T) -> &[DVec2]) -> Bounded<T> {
    let points = outline(&what);
    let low = points.iter().fold(DVec2::INFINITY, |low, point| low.min(*point));
    let high = points.iter().fold(DVec2::NEG_INFINITY, |high, point| high.max(*point));
    Bounded { low, high, what }
}

fn near<T>(all: &[Bounded<T>], here: DVec2, reach: DVec2) -> impl Iterator<Item = &T> {
    let touches = move |one: &&Bounded<T>| one.low.cmple(here + reach).all() && one.high.cmpge(here - reach).all();
    all.iter().filter(touches).map(|one| &one.what)
}

/// The layers of an opened map, in metres.
struct Layers {
    database: Database,
    epsg: i64,
    utm: Utm,
}

impl Layers {
    fn open(database: Database) -> Result<Self, DataError> {
        let rows =
            database.read("meta", &["key", "value"], |row| Ok((row.text(0)?.to_owned(), row.text(1)?.to_owned())))?;
        let system = rows.into_iter().find(|row| row.0 == "projectedCoordSystem").map(|row| row.1).unwrap_or_default();
        let epsg = system.to_ascii_lowercase().strip_prefix("epsg:").and_then(|number| number.parse().ok());
        match epsg.and_then(|epsg| Some((epsg, Utm::of_epsg(epsg)?))) {
            Some((epsg, utm)) => Ok(Self { database, epsg, utm }),
            None => {
                Err(database.bad(format!("its projectedCoordSystem {system:?} is no UTM zone, such as epsg:32611")))
            }
        }
    }

    /// Geometries of a layer in metres, each with a whole number from another column; none where there is no such layer.
    fn read(
        &self,
        layer: &'static str,
        number: Option<&'static str>,
    ) -> Result<Vec<(wkb::Cell, Option<i64>)>, DataError> {
        if !self.database.has_table(layer)? {
            return Ok(Vec::new());
        }
        let geometry = if self.database.has_column(layer, "geom")? { "geom" } else { "geometry" };
        let columns = ["fid", geometry, number.unwrap_or("fid")];
        let rows = self.database.read(layer, &columns, |row| {
            let Some(bytes) = row.maybe_blob(1)? else { return Ok(None) };
            let cell = wkb::parse(bytes).and_then(|cell| self.in_metres(cell)).map_err(|why| row.wrong(1, &why))?;
            Ok(Some((cell, row.maybe_number(2)?.map(|number| number as i64))))
        })?;
        Ok(rows.into_iter().flatten().collect())
    }

    fn in_metres(&self, mut cell: wkb::Cell) -> Result<wkb::Cell, String> {
        if i64::from(cell.srs) == self.epsg {
            return Ok(cell);
        }
        if cell.srs != DEGREES {
            return Err(format!("is in the reference system {}, neither {DEGREES} nor {}", cell.srs, self.epsg));
        }
        let rings =
            cell.polygons.iter_mut().flat_map(|polygon| std::iter::once(&mut polygon.outer).chain(&mut polygon.holes));
        for point in cell.lines.iter_mut().chain(rings).flatten() {
            if point.y.abs() > 85.0 || point.x.abs() > 180.0 {
                return Err(format!("holds {point}, no longitude and latitude"));
            }
            *point = self.utm.project(*point);
        }
        Ok(cell)
    }
}
