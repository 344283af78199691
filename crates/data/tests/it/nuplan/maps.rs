//! City maps in the public schema, made here: a straight road eastwards with a crossing, north and south of the car.

use std::path::Path;

use data::{LocalMap, MapKind, SceneDataset};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};
use rusqlite::Connection;

use super::made::Made;
use super::open;

/// A zone of UTM around the car, in which its coordinates are given.
const EPSG: i32 = 32_611;

/// A cell in the metres of the poses.
fn cell(kind: u32, rings: &[&[[f64; 2]]]) -> Vec<u8> {
    let mut bytes = [b"GP\0\x01".as_slice(), &EPSG.to_le_bytes(), &[1], &kind.to_le_bytes()].concat();
    if kind == 3 {
        bytes.extend((rings.len() as u32).to_le_bytes());
    }
    for ring in rings {
        bytes.extend((ring.len() as u32).to_le_bytes());
        bytes.extend(ring.iter().flatten().flat_map(|value| value.to_le_bytes()));
    }
    bytes
}

/// Layer, geometry kind, number of the boundary's kind, points in metres from the car, east and north.
type Row<'a> = (&'a str, u32, i64, &'a [[f64; 2]]);

const ROWS: [Row<'static>; 9] = [
    ("boundaries", 2, 0, &[[-80.0, 0.0], [80.0, 0.0]]),
    ("boundaries", 2, 2, &[[-80.0, 4.0], [80.0, 4.0]]),
    ("boundaries", 2, 1, &[[-80.0, -4.0], [80.0, -4.0]]),
    ("baseline_paths", 2, 0, &[[-80.0, 2.0], [80.0, 2.0]]),
    ("road_segments", 3, 0, &[[-80.0, -4.0], [0.0, -4.0], [0.0, 4.0], [-80.0, 4.0], [-80.0, -4.0]]),
    ("intersections", 3, 0, &[[0.0, -4.0], [80.0, -4.0], [80.0, 4.0], [0.0, 4.0], [0.0, -4.0]]),
    ("crosswalks", 3, 0, &[[10.0, -4.0], [13.0, -4.0], [13.0, 4.0], [10.0, 4.0], [10.0, -4.0]]),
    ("walkways", 3, 0, &[[-80.0, 4.0], [80.0, 4.0], [80.0, 7.0], [-80.0, 7.0], [-80.0, 4.0]]),
    ("walkways", 3, 0, &[[500.0, 4.0], [580.0, 4.0], [580.0, 7.0], [500.0, 4.0]]),
];

/// Writes a map around a place; `system` is what its meta table says.
fn write(path: &Path, around: DVec3, system: &str) {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    let database = Connection::open(path).unwrap();
    let layers = ["boundaries", "baseline_paths", "road_segments", "intersections", "crosswalks", "walkways"];
    for layer in layers {
        let table = format!("CREATE TABLE {layer} (fid INTEGER PRIMARY KEY, geom BLOB, boundary_type_fid INTEGER);");
        database.execute_batch(&table).unwrap();
    }
    database.execute_batch("CREATE TABLE meta (fid INTEGER PRIMARY KEY, key TEXT, value TEXT);").unwrap();
    database.execute("INSERT INTO meta (key, value) VALUES ('projectedCoordSystem', ?1)", [system]).unwrap();
    for (layer, kind, number, points) in ROWS {
        let points: Vec<[f64; 2]> = points.iter().map(|[x, y]| [around.x + x, around.y + y]).collect();
        let insert = format!("INSERT INTO {layer} (geom, boundary_type_fid) VALUES (?1, ?2)");
        database.execute(&insert, (cell(kind, &[&points]), number)).unwrap();
    }
}

/// A dataset whose log names this city, and its map in two versions of which the newer is read.
fn made(system: &str) -> (Made, Rigid) {
    let made = Made::new();
    made.change("UPDATE log SET location = 'las_vegas', map_version = 'us-nv-las-vegas-strip'");
    let car = open(&made.config()).frame(0).unwrap().world_from_ego;
    let city = made.root().join("maps/us-nv-las-vegas-strip");
    write(&city.join("9.15.1915/map.gpkg"), car.translation, system);
    std::fs::create_dir_all(city.join("9.9.9")).unwrap();
    std::fs::write(city.join("9.9.9/map.gpkg"), b"an older one, which is not opened").unwrap();
    (made, car)
}

fn lines(map: &LocalMap, kind: MapKind) -> Vec<Vec<DVec2>> {
    let of_kind = map.lines.iter().filter(|line| line.kind == kind);
    of_kind.map(|line| line.points.iter().map(|[x, y, _]| DVec2::new(*x, *y)).collect()).collect()
}

#[test]
fn the_map_around_the_car_is_in_ego_axes_on_its_plane() {
    let (made, car) = made("epsg:32611");
    let dataset = open(&made.config());
    assert!(dataset.capabilities().map);
    let map = dataset.local_map(0, 30.0).unwrap();
    assert!(map.lines.iter().flat_map(|line| &line.points).all(|point| point[2] == 0.0));
    let [dividers, paths, borders, crossings] =
        [MapKind::Divider, MapKind::Centerline, MapKind::Boundary, MapKind::Crossing].map(|kind| lines(&map, kind));
    assert_eq!((dividers.len(), paths.len(), crossings.len()), (2, 1, 1), "virtual boundaries are no dividers");
    // North in ego axes; the road's lines run at their distances from the car along it.
    let north = DVec2::from_angle(std::f64::consts::FRAC_PI_2 - car.yaw());
    for (line, want) in [(&dividers[0], 0.0), (&dividers[1], 4.0), (&paths[0], 2.0)] {
        assert!(line.iter().all(|point| (point.dot(north) - want).abs() < 1e-6), "{line:?}");
    }
    // The seam between road and crossroads is no border.
    let (low, high): (Vec<_>, Vec<_>) = borders.iter().flatten().map(|p| p.dot(north)).partition(|p| *p < 0.0);
    assert!(low.iter().all(|p| (p + 4.0).abs() < 1e-3) && high.iter().all(|p| (p - 4.0).abs() < 1e-3), "{borders:?}");
    let areas: Vec<MapKind> = map.areas.iter().map(|area| area.kind).collect();
    assert_eq!(areas, [MapKind::Boundary, MapKind::Crossing, MapKind::Walkway], "the far walkway is left out");
}

#[test]
fn maps_that_are_not_there_or_of_no_use_are_named() {
    let (made, _) = made("a local one");
    let error = open(&made.config()).local_map(0, 30.0).unwrap_err().to_string();
    assert!(error.contains("projectedCoordSystem") && error.ends_with("map.gpkg"), "{error}");
    let path = made.root().join("maps/us-nv-las-vegas-strip/9.15.1915/map.gpkg");
    Connection::open(&path).unwrap().execute_batch("UPDATE meta SET value = 'EPSG:32619'").unwrap();
    let error = open(&made.config()).local_map(0, 30.0).unwrap_err().to_string();
    assert!(error.contains("32611") && error.contains("row 1"), "another zone than the layers': {error}");
    std::fs::remove_dir_all(made.root().join("maps")).unwrap();
    let dataset = open(&made.config());
    assert!(!dataset.capabilities().map && dataset.local_map(0, 30.0).is_err());
}
