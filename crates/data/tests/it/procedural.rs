//! Maps and occupancy of the procedural world as every dataset gives them.

use data::occupancy::{OCC3D_GRID, Occ3d, write_occ3d};
use data::{DataError, MapKind, OccupancyLabels, Procedural, ProceduralConfig, SceneDataset};
use geometry::BevGrid;
use geometry::glam::{DVec2, DVec3};

fn config() -> ProceduralConfig {
    ProceduralConfig { seed: 11, scenes: 2, frames_per_scene: 3, ..ProceduralConfig::default() }
}

fn open() -> Procedural {
    Procedural::open(&config()).unwrap()
}

#[test]
fn occupancy_holds_the_boxes_and_the_road() {
    let dataset = open();
    assert!(dataset.capabilities().occupancy && dataset.capabilities().map);
    for index in 0..dataset.len() {
        let grid = dataset.occupancy(index).unwrap();
        assert_eq!((grid.grid, grid.label_set), (OCC3D_GRID, OccupancyLabels::NuScenes));
        assert_eq!(grid, dataset.occupancy(index).unwrap(), "a frame is a function of its index");
        // Beside the own rear axle there is road.
        assert_eq!(grid.label_at(DVec3::new(0.0, 0.0, 0.1)), Some(11));
        let mut inside = 0;
        for found in dataset.frame(index).unwrap().boxes.unwrap() {
            let Some(_) = grid.cell_at(found.box3d.center) else { continue };
            let names = grid.label_set.class_names();
            let want = match found.source_class.as_str() {
                "car" | "truck" | "bus" => names.iter().position(|name| *name == found.source_class),
                _ => continue,
            };
            inside += 1;
            assert_eq!(grid.label_at(found.box3d.center).map(usize::from), want, "{found:?}");
        }
        assert!(inside > 0, "frame {index} has no vehicle in reach");
    }
    assert!(dataset.occupancy(dataset.len()).is_err());
}

#[test]
fn the_grid_is_a_setting_and_labels_can_be_written() {
    let small = BevGrid { x_range: [-8.0, 8.0], y_range: [-4.0, 4.0], z_range: [-1.0, 3.0], cells: [4, 8, 16] };
    let dataset = Procedural::open(&ProceduralConfig { occupancy: small, ..config() }).unwrap();
    let grid = dataset.occupancy(1).unwrap();
    assert_eq!((grid.labels.len(), grid.grid), (512, small));
    for cells in [[4, 0, 16], [4, usize::MAX, 16], [1 << 10, 1 << 10, 1 << 10]] {
        let bad = ProceduralConfig { occupancy: BevGrid { cells, ..small }, ..config() };
        assert!(matches!(Procedural::open(&bad), Err(DataError::Config(_))));
    }
    let dir = tempfile::tempdir().unwrap();
    let usual = open().occupancy(0).unwrap();
    write_occ3d(dir.path(), "scene-0000", "0000", &usual).unwrap();
    let back = Occ3d::open(dir.path(), true).unwrap().read("scene-0000", "0000").unwrap();
    assert_eq!(back.labels, usual.labels);
    assert!(back.camera_mask.unwrap().iter().all(|seen| *seen), "without masks everything counts as seen");
    assert!(write_occ3d(dir.path(), "scene-0000", "0001", &grid).is_err());
}

#[test]
fn the_map_agrees_with_the_occupancy() {
    let dataset = open();
    for index in 0..dataset.len() {
        let map = dataset.local_map(index, 30.0).unwrap();
        let has = |kind| map.lines.iter().any(|line| line.kind == kind);
        assert!(has(MapKind::Divider) && has(MapKind::Boundary) && has(MapKind::Centerline));
        let mut points = map.lines.iter().flat_map(|line| &line.points);
        assert!(points.all(|p| p[0].abs() <= 30.0 + 1e-9 && p[1].abs() <= 30.0 + 1e-9 && p[2].abs() < 1e-9));
        let grid = dataset.occupancy(index).unwrap();
        let centers = map.lines.iter().filter(|line| line.kind == MapKind::Centerline).flat_map(|line| &line.points);
        let labels = centers.filter_map(|point| grid.label_at(DVec3::from_array(*point) + DVec3::Z * 0.1));
        let labels: Vec<u8> = labels.collect();
        let road = labels.iter().filter(|label| **label == 11 || grid.label_set.foreground().contains(label)).count();
        assert!(labels.len() > 20 && road as f64 > 0.95 * labels.len() as f64, "{road} of {}", labels.len());
        let drivable = map.areas.iter().filter(|area| area.kind == MapKind::Boundary);
        let around = drivable.flat_map(|area| &area.outer).map(|point| DVec2::from_array(*point).length());
        assert!(around.fold(0.0, f64::max) > 30.0, "areas are whole");
    }
    assert!(matches!(dataset.local_map(0, -1.0), Err(DataError::Config(_))));
}

#[test]
fn a_frame_without_text_counts_its_objects() {
    let mut frame = open().frame(0).unwrap();
    assert_eq!(Some(frame.caption()), frame.scene_text);
    frame.scene_text = None;
    let cars = frame.boxes.iter().flatten().filter(|found| found.class == data::ObjectClass::Car).count();
    assert!(cars > 1 && frame.caption().contains(&format!("{cars} cars")), "{}", frame.caption());
    frame.boxes = None;
    assert_eq!(frame.caption(), "A driving scene");
}
