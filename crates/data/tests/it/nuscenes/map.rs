//! The map expansion and the map pictures, against the official map API's numbers and on broken files.

use std::collections::BTreeSet;
use std::path::Path;

use data::nuscenes::map::{CityMap, MapLayer};
use data::nuscenes::{NuScenes, NuScenesConfig};
use data::{DataError, LocalMap, MapArea, MapKind, MapLine, SceneDataset};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};
use serde_json::{Value, json as value};

use super::made::{START_US, Tables};
use super::{floats, folder, json, open};

fn chain(root: &Path) -> NuScenes {
    open(&NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini"))
}

/// First frame of each scene with the golden numbers of its map.
fn scenes(root: &Path) -> Vec<(usize, Value)> {
    let golden = json(&root.join("golden/nuscenes_chain_map.json"));
    let scenes = chain(root).scenes();
    let of = |scene: &data::nuscenes::SceneInfo| (scene.frames.start, golden["scenes"][&scene.name].clone());
    scenes.iter().map(of).collect()
}

fn golden_pose(golden: &Value) -> Rigid {
    let [x, y] = floats(&golden["ego_xy"]);
    Rigid::from_yaw(golden["ego_yaw"].as_f64().unwrap(), DVec3::new(x, y, 0.0))
}

fn points(value: &Value) -> Vec<DVec2> {
    value.as_array().unwrap().iter().map(|point| DVec2::from_array(floats(point))).collect()
}

fn distance(line: &[[f64; 3]], point: DVec2) -> f64 {
    let pairs = line.windows(2).map(|pair| pair.iter().map(|p| DVec2::new(p[0], p[1])).collect::<Vec<_>>());
    let distances = pairs.map(|pair| {
        let way = pair[1] - pair[0];
        let share = ((point - pair[0]).dot(way) / way.length_squared().max(1e-12)).clamp(0.0, 1.0);
        point.distance(pair[0] + way * share)
    });
    distances.fold(f64::INFINITY, f64::min)
}

/// Largest distance of a golden line from the nearest of ours, ends against ends, and of our points from it.
fn line_error(lines: &[&MapLine], golden: &[DVec2]) -> f64 {
    let golden_line: Vec<[f64; 3]> = golden.iter().map(|point| [point.x, point.y, 0.0]).collect();
    let error = |line: &&&MapLine| {
        let end = |at: Option<&[f64; 3]>| at.map(|p| DVec2::new(p[0], p[1])).unwrap();
        let (first, last) = (end(line.points.first()), end(line.points.last()));
        let (a, b) = (golden[0], golden[golden.len() - 1]);
        let ends = (first.distance(a).max(last.distance(b))).min(first.distance(b).max(last.distance(a)));
        let there = golden.iter().map(|point| distance(&line.points, *point)).fold(ends, f64::max);
        line.points.iter().map(|p| distance(&golden_line, DVec2::new(p[0], p[1]))).fold(there, f64::max)
    };
    lines.iter().map(|line| error(&line)).fold(f64::INFINITY, f64::min)
}

fn dividers(map: &LocalMap) -> Vec<&MapLine> {
    map.lines.iter().filter(|line| line.kind == MapKind::Divider).collect()
}

#[test]
fn dividers_in_a_turned_patch_equal_the_devkit() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root);
    for (index, golden) in scenes(&root) {
        let exact = dataset.city_map(index).unwrap().around(&golden_pose(&golden), 50.0).unwrap();
        let framed = dataset.local_map(index, 50.0).unwrap();
        let lines = golden["lines_in_patch"].as_array().unwrap();
        assert_eq!((dividers(&exact).len(), dividers(&framed).len()), (lines.len(), lines.len()));
        let mut worst = [0.0f64; 2];
        for line in lines {
            let points = points(&line["line"]);
            worst[0] = worst[0].max(line_error(&dividers(&exact), &points));
            worst[1] = worst[1].max(line_error(&dividers(&framed), &points));
        }
        eprintln!("lines differ by {} m; with roll and pitch of the frame by {} m", worst[0], worst[1]);
        // The golden numbers have four decimals.
        assert!(worst[0] < 2e-4, "{}", worst[0]);
        assert_ne!(worst[1], worst[0], "the frame's own pose rolls and pitches");
    }
}

#[test]
fn layers_lanes_and_links_equal_the_devkit() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root);
    for (index, golden) in scenes(&root) {
        let map = dataset.city_map(index).unwrap();
        let ego = DVec2::from_array(floats(&golden["ego_xy"]));
        let layers: Vec<&str> = map.layers_at(ego).into_iter().map(MapLayer::name).collect();
        assert_eq!(Value::from(layers), golden["layers_on_ego"]);
        let (lane, distance) = map.closest_path(ego).unwrap();
        assert_eq!(lane.token, golden["closest_lane"].as_str().unwrap());
        assert!(distance < 1.0);
        assert_eq!(Value::from(lane.outgoing.clone()), golden["outgoing"]);
        let want = golden["lane_points_every_5m"].as_array().unwrap();
        let poses = lane.poses(5.0);
        assert_eq!(poses.len(), want.len());
        for (pose, want) in poses.iter().zip(want) {
            let want: [f64; 3] = floats(want);
            assert!(pose.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-4), "{pose:?} instead of {want:?}");
        }
        assert_eq!(dataset.map_prior(index).unwrap().covers(ego.x, ego.y), Some(true));
        assert_eq!(golden["png_value_at_ego"], 255);
    }
}

fn inside(areas: &[&MapArea], point: DVec2) -> bool {
    let odd = |ring: &[[f64; 2]]| {
        let sides = ring.iter().zip(ring.iter().cycle().skip(1));
        let crosses = |(a, b): &(&[f64; 2], &[f64; 2])| {
            (a[1] <= point.y) != (b[1] <= point.y) && point.x < a[0] + (point.y - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        };
        sides.filter(crosses).count() % 2 == 1
    };
    areas.iter().any(|area| odd(&area.outer) && !area.holes.iter().any(|hole| odd(hole)))
}

/// Cells of the patch whose centre lies inside, and of those and their neighbours.
fn raster(areas: &[&MapArea]) -> [i64; 3] {
    let cell = |at: i64| inside(areas, DVec2::new((at % 200) as f64, (at / 200) as f64) * 0.5 - 49.75);
    let cells: Vec<bool> = (0..40_000).map(cell).collect();
    let around = |at: i64| {
        let near = (0..9).map(move |step| (at % 200 + step % 3 - 1, at / 200 + step / 3 - 1));
        near.filter(|(x, y)| (0..200).contains(x) && (0..200).contains(y)).map(|(x, y)| cells[(y * 200 + x) as usize])
    };
    let count = |test: &dyn Fn(i64) -> bool| (0..40_000).filter(|at| test(*at)).count() as i64;
    [
        count(&|at| around(at).all(|cell| cell)),
        count(&|at| cells[at as usize]),
        count(&|at| around(at).any(|cell| cell)),
    ]
}

#[test]
fn areas_cover_the_cells_of_the_devkit() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root);
    for (index, golden) in scenes(&root) {
        let map = dataset.city_map(index).unwrap().around(&golden_pose(&golden), 50.0).unwrap();
        let kinds =
            [("drivable_area", MapKind::Boundary), ("ped_crossing", MapKind::Crossing), ("walkway", MapKind::Walkway)];
        for (name, kind) in kinds {
            let areas: Vec<&MapArea> = map.areas.iter().filter(|area| area.kind == kind).collect();
            let [least, count, most] = raster(&areas);
            let want = golden["mask_true_cells"][name].as_i64().unwrap();
            eprintln!(
                "{name}: {count} cells by their centres ({least} to {most}), the devkit, which draws borders too, {want}"
            );
            assert!(least <= want && want <= most, "{name}: {want} is not within {least}..={most}");
            assert!((want - count) as f64 <= 0.5 * (most - count) as f64 && want >= count, "{name}: {count}, {want}");
        }
    }
}

#[test]
fn the_picture_shows_what_the_polygons_enclose() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root);
    for (index, _) in scenes(&root) {
        let (map, prior) = (dataset.city_map(index).unwrap(), dataset.map_prior(index).unwrap());
        let [width, height] = map.canvas_m;
        assert_eq!(prior.size().map(|pixels| pixels as f64 / 10.0), [width, height]);
        let (mut equal, mut mirrored, mut all) = (0, 0, 0);
        for step in 0..40_000 {
            let at = DVec2::new(f64::from(step % 200) + 0.52, f64::from(step / 200) + 0.48) * DVec2::new(width, height)
                / 200.0;
            let layers = map.layers_at(at);
            let want = layers.iter().any(|layer| matches!(layer, MapLayer::DrivableArea | MapLayer::Walkway));
            all += 1;
            equal += i32::from(prior.covers(at.x, at.y) == Some(want));
            mirrored += i32::from(prior.covers(at.x, height - at.y) == Some(want));
        }
        eprintln!("{equal} of {all} points agree, {mirrored} with the picture upside down");
        assert!(
            f64::from(equal) > 0.99 * f64::from(all) && mirrored < equal - all / 20,
            "{equal}, {mirrored} of {all}"
        );
        let drivable = map.areas.iter().filter(|area| area.layer == MapLayer::DrivableArea);
        let hole = drivable.flat_map(|area| &area.polygons).find_map(|polygon| polygon.holes.first()).unwrap();
        let middle = hole.iter().sum::<DVec2>() / hole.len() as f64;
        assert!(!map.layers_at(middle).contains(&MapLayer::DrivableArea));
        assert!(!map.drivable.iter().any(|shape| shape.contains(middle)), "the union keeps the island");
        assert_eq!(prior.covers(middle.x, middle.y), Some(false));
    }
}

#[test]
fn paths_end_where_the_file_says_and_stay_in_their_lanes() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root);
    for (index, _) in scenes(&root) {
        let map = dataset.city_map(index).unwrap();
        assert_eq!((map.paths.len(), map.left_out), (12, 0));
        for path in &map.paths {
            for piece in &path.pieces {
                let end = piece.at(piece.length());
                assert!((end[0] - piece.end[0]).hypot(end[1] - piece.end[1]) < 0.05, "{}", path.token);
            }
            let lane = map.areas.iter().find(|area| area.token == path.token).unwrap();
            assert!(matches!(lane.layer, MapLayer::Lane | MapLayer::LaneConnector));
            let poses = path.poses(1.0);
            assert!(
                poses[1..poses.len() - 1].iter().all(|pose| lane.polygons[0].contains(DVec2::new(pose[0], pose[1])))
            );
        }
        let types: BTreeSet<_> = map.areas.iter().filter_map(|area| area.stop_line_type.as_deref()).collect();
        assert_eq!(types, ["PED_CROSSING", "STOP_SIGN", "TRAFFIC_LIGHT", "TURN_STOP", "YIELD"].into());
        let whole: Vec<_> = map.areas.iter().filter(|area| area.layer == MapLayer::DrivableArea).collect();
        assert!(whole.iter().any(|area| area.polygons.len() > 1));
        assert!(map.drivable.len() <= whole.iter().map(|area| area.polygons.len()).sum());
        let local = dataset.local_map(index, 60.0).unwrap();
        for kind in [MapKind::Crossing, MapKind::Boundary, MapKind::Centerline] {
            assert!(local.lines.iter().any(|line| line.kind == kind), "{kind:?}");
        }
        for kind in [MapKind::Crossing, MapKind::Boundary, MapKind::Walkway, MapKind::StopLine] {
            assert!(local.areas.iter().any(|area| area.kind == kind), "{kind:?}");
        }
    }
}

/// One square of drivable area, a lane divider of an unknown paint and a path.
fn small() -> Value {
    let node = |at: usize, x: f64, y: f64| value!({"token": format!("n{at}"), "x": x, "y": y});
    value!({
        "version": "1.3", "canvas_edge": [200.0, 100.0],
        "node": [node(0, 90.0, 40.0), node(1, 130.0, 40.0), node(2, 130.0, 60.0), node(3, 90.0, 60.0)],
        "line": [{"token": "l", "node_tokens": ["n0", "n2"]}],
        "polygon": [{"token": "p", "exterior_node_tokens": ["n0", "n1", "n2", "n3"], "holes": []},
            {"token": "empty", "exterior_node_tokens": ["n0", "n1"]}],
        "drivable_area": [{"token": "d", "polygon_tokens": ["p", "empty"]}],
        "lane_divider": [{"token": "v", "line_token": "l", "extra": 1,
            "lane_divider_segments": [{"node_token": "n0", "segment_type": "CHALK"}]}],
        "stop_line": [{"token": "s", "polygon_token": "p", "stop_line_type": "WHIM"}],
        "arcline_path_3": {"a": [{"start_pose": [90.0, 50.0, 0.0], "end_pose": [130.0, 50.0, 0.0], "shape": "LSR",
            "radius": 100.0, "segment_length": [0.0, 40.0, 0.0]}]},
    })
}

fn read(folder: &Path, map: &Value) -> Result<CityMap, DataError> {
    let path = folder.join("nowhere.json");
    std::fs::write(&path, serde_json::to_vec(map).unwrap()).unwrap();
    CityMap::read(&path.into())
}

#[test]
fn unknown_words_are_kept_and_empty_polygons_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let map = read(dir.path(), &small()).unwrap();
    assert_eq!((map.left_out, map.drivable.len(), map.dividers[0].segment_types[0].as_str()), (1, 1, "CHALK"));
    assert_eq!(map.areas.iter().find_map(|area| area.stop_line_type.as_deref()), Some("WHIM"));
    assert!(map.paths[0].incoming.is_empty());
}

#[test]
fn broken_maps_are_errors_that_name_the_file() {
    let dir = tempfile::tempdir().unwrap();
    let broken: [(&str, Value, &str); 12] = [
        ("/version", value!("1.2"), "Format"),
        ("/version", value!(1.3), "Json"),
        ("/node/0/x", value!("90"), "Json"),
        ("/node/0/x", value!(1e9), "Format"),
        ("/node/1/token", value!("n0"), "Duplicate"),
        ("/line/0/node_tokens/1", value!("nowhere"), "Dangling"),
        ("/polygon/0/exterior_node_tokens/2", value!("nowhere"), "Dangling"),
        ("/drivable_area/0/polygon_tokens/0", value!("nowhere"), "Dangling"),
        ("/lane_divider/0/line_token", value!("nowhere"), "Dangling"),
        ("/stop_line/0/polygon_token", value!("nowhere"), "Dangling"),
        ("/arcline_path_3/a/0/shape", value!("LSD"), "Format"),
        ("/arcline_path_3/a/0/segment_length", value!([0.0, 1e5, 0.0]), "Format"),
    ];
    for (place, change, want) in broken {
        let mut map = small();
        *map.pointer_mut(place).unwrap() = change;
        let error = read(dir.path(), &map).unwrap_err();
        let kind = match error {
            DataError::Format { .. } => "Format",
            DataError::Json { .. } => "Json",
            DataError::Dangling { .. } => "Dangling",
            DataError::DuplicateToken { .. } => "Duplicate",
            _ => "another",
        };
        assert_eq!(kind, want, "{place} gave {error:?}");
        assert!(error.to_string().ends_with("nowhere.json"), "{error}");
    }
}

#[test]
fn datasets_without_maps_say_so() {
    let dir = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    tables.scene("scene-0001", &[START_US]);
    let config = tables.write(dir.path());
    let dataset = open(&config);
    assert!(!dataset.capabilities().map);
    assert!(matches!(dataset.local_map(0, 10.0), Err(DataError::Unsupported { .. })));
    assert!(matches!(dataset.map_prior(0), Err(DataError::Missing { .. })));
    std::fs::create_dir_all(dir.path().join("maps/expansion")).unwrap();
    let path = dir.path().join("maps/expansion/elsewhere.json");
    std::fs::write(&path, "{}").unwrap();
    let dataset = open(&config);
    let error = dataset.local_map(0, 10.0).unwrap_err();
    assert!(matches!(error, DataError::Missing { .. }) && error.to_string().ends_with("nowhere.json"), "{error}");
    read(&dir.path().join("maps/expansion"), &small()).unwrap();
    let map = dataset.local_map(0, 10.0).unwrap();
    // The car stands at (100, 50) and looks along x: both long sides are cut, the right end is out of reach.
    let boundary: Vec<_> = map.lines.iter().filter(|line| line.kind == MapKind::Boundary).collect();
    assert_eq!(boundary.len(), 1);
    assert_eq!(boundary[0].points.len(), 4);
    for (row, name) in [("../../etc/passwd", "unsafe"), ("maps/absent.png", "absent")] {
        tables.row("map", "map")["filename"] = value!(row);
        let error = open(&tables.write(dir.path())).map_prior(0).unwrap_err();
        assert_eq!(matches!(error, DataError::UnsafePath { .. }), name == "unsafe", "{error:?}");
        assert_eq!(matches!(error, DataError::Missing { .. }), name == "absent", "{error:?}");
    }
    tables.row("log", "log")["location"] = value!("../secret");
    assert!(matches!(open(&tables.write(dir.path())).local_map(0, 10.0), Err(DataError::UnsafePath { .. })));
}
