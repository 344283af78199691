//! Occupancy labels attached to nuScenes-layout datasets.

use std::path::Path;

use data::npz::{Dtype, npy_bytes};
use data::nuscenes::{FrameChoice, NuScenes, NuScenesConfig};
use data::occupancy::{BetweenKeyFrames, OccupancyConfig, OccupancyKind};
use data::{DataError, OccupancyLabels, SceneDataset};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};
use serde_json::json as value;

use super::made::{START_US, Tables};
use super::{folder, image_path, json, open};

fn chain(root: &Path, frames: FrameChoice, between: BetweenKeyFrames) -> NuScenes {
    let set = root.join("nuscenes_chain/Occpancy3D-nuScenes-V1.0/mini");
    let occupancy = OccupancyConfig { between, ..OccupancyConfig::new(OccupancyKind::Occ3d, set) };
    open(&NuScenesConfig {
        frames,
        occupancy: Some(occupancy),
        ..NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini")
    })
}

#[test]
fn a_ray_through_a_visible_centre_meets_its_class() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = chain(&root, FrameChoice::KeyFrames, BetweenKeyFrames::Missing);
    assert!(dataset.capabilities().occupancy);
    let centres = json(&root.join("golden/nuscenes_chain_centres.json"));
    let (mut met, mut all) = (0, 0);
    for index in 0..dataset.len() {
        let frame = dataset.frame(index).unwrap();
        let grid = dataset.occupancy(index).unwrap();
        assert!(grid.lidar_mask.is_some() && grid.camera_mask.is_some());
        for view in &frame.views {
            let path = image_path(view.image.as_ref()).unwrap();
            let in_view =
                centres.as_array().unwrap().iter().filter(|row| path.ends_with(row["filename"].as_str().unwrap()));
            for row in in_view {
                let name = match row["category"].as_str().unwrap() {
                    "vehicle.car" => "car",
                    "vehicle.truck" => "truck",
                    "vehicle.bus.rigid" | "vehicle.bus.bendy" => "bus",
                    "vehicle.trailer" => "trailer",
                    "vehicle.construction" => "construction_vehicle",
                    _ => continue,
                };
                let wanted = OccupancyLabels::NuScenes.class_names().iter().position(|class| *class == name).unwrap();
                let pixel = DVec2::new(row["u_px"].as_f64().unwrap(), row["v_px"].as_f64().unwrap()) + 0.5;
                let pose = view.ref_ego_from_cam(&frame.world_from_ego);
                let ray = view.camera().unwrap().unproject(pixel).unwrap();
                let direction = pose.transform_vector(ray).normalize();
                let labels = grid.along_ray(pose.translation, direction, 0.2, 256);
                let hit = labels.iter().find(|label| **label != 17 && **label != 255 && **label != 11);
                // Far objects lie outside the labels' range.
                let Some(hit) = hit else { continue };
                all += 1;
                met += i32::from(usize::from(*hit) == wanted);
            }
        }
    }
    eprintln!("{met} of {all} rays meet the class of the object they were drawn through");
    assert!(all > 30 && f64::from(met) > 0.9 * f64::from(all), "{met} of {all}");
}

#[test]
fn frames_between_samples_get_what_the_config_says() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let all = |between| chain(&root, FrameChoice::all_pictures(), between);
    let (missing, nearest, moved) =
        (all(BetweenKeyFrames::Missing), all(BetweenKeyFrames::Nearest), all(BetweenKeyFrames::Moved));
    let keys = chain(&root, FrameChoice::KeyFrames, BetweenKeyFrames::Missing);
    let mut between = 0;
    for index in 0..missing.len() {
        let frame = moved.frame(index).unwrap();
        let key =
            (0..keys.len()).map(|key| (key, keys.frame(key).unwrap())).filter(|key| key.1.id.scene == frame.id.scene);
        let key = key.min_by_key(|key| (key.1.timestamp_ns - frame.timestamp_ns).abs()).unwrap();
        let labels = keys.occupancy(key.0).unwrap();
        if frame.id == key.1.id {
            assert_eq!(missing.occupancy(index).unwrap(), labels);
            assert_eq!(moved.occupancy(index).unwrap(), labels);
            continue;
        }
        between += 1;
        let error = missing.occupancy(index).unwrap_err();
        assert!(matches!(error, DataError::Missing { .. }) && error.to_string().contains("no key frame"), "{error}");
        assert_eq!(nearest.occupancy(index).unwrap(), labels);
        let carried = moved.occupancy(index).unwrap();
        assert_eq!(carried.labels, labels.labels);
        // The same place of the world has the same label.
        let way = frame.world_from_ego.inverse() * key.1.world_from_ego;
        assert!(way.translation.length() > 0.1);
        for cell in [[0, 100, 100], [3, 20, 150], [15, 199, 0]] {
            let there = way * labels.center_in_ego(cell);
            assert!(carried.center_in_ego(cell).abs_diff_eq(there, 1e-9));
            assert_eq!(carried.label_at(there), labels.label(cell));
        }
    }
    assert_eq!(between, 55 - 11);
}

/// A dataset of one frame whose lidar looks as the real one does.
fn made(root: &Path) -> Tables {
    let mut tables = Tables::new();
    tables.scene("scene-0001", &[START_US]);
    let row = tables.row("calibrated_sensor", "c-scene-0001-LIDAR_TOP");
    row["rotation"] = value!([0.5f64.sqrt(), 0.0, 0.0, -(0.5f64.sqrt())]);
    row["translation"] = value!([0.9, 0.0, 1.8]);
    let lidar = format!("scene-0001 LIDAR_TOP {START_US}");
    tables.row("sample_data", &lidar)["filename"] = value!("samples/LIDAR_TOP/log__1.pcd.bin");
    let write = |name: String, row: [i32; 4]| {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let bytes: Vec<u8> = row.iter().flat_map(|value| value.to_le_bytes()).collect();
        std::fs::write(path, npy_bytes(Dtype::I32, &[1, 4], &bytes).unwrap()).unwrap();
    };
    // One car at lidar (0, 20, -1): ahead of the car.
    write("surround/samples/log__1.pcd.bin.npy".to_owned(), [100, 140, 8, 4]);
    write(format!("open/scene_scene scene-0001/occupancy/{lidar}.npy"), [20, 356, 256, 4]);
    tables
}

#[test]
fn labels_in_the_lidars_frame_are_found_and_lie_ahead() {
    let dir = tempfile::tempdir().unwrap();
    let tables = made(dir.path());
    let config = tables.write(dir.path());
    for (kind, root) in [(OccupancyKind::SurroundOcc, "surround"), (OccupancyKind::OpenOccupancy, "open")] {
        let occupancy = Some(OccupancyConfig::new(kind, dir.path().join(root)));
        let dataset = open(&NuScenesConfig { occupancy: occupancy.clone(), ..config.clone() });
        let grid = dataset.occupancy(0).unwrap();
        assert_ne!(grid.ego_from_grid, Rigid::IDENTITY);
        let car = grid.labels.iter().position(|label| *label == 4).unwrap();
        let [_, ny, nx] = grid.grid.cells;
        let center = grid.center_in_ego([car / (ny * nx), car / nx % ny, car % nx]);
        assert!(center.abs_diff_eq(DVec3::new(20.9, 0.0, 0.9), 0.6), "{kind:?}: {center}");
        assert_eq!(grid.labels.iter().filter(|label| **label != 17).count(), 1);
        let mut hostile = tables.clone();
        hostile.row("sample_data", &format!("scene-0001 LIDAR_TOP {START_US}"))["filename"] = value!("a/..");
        hostile.row("scene", "scene scene-0001")["token"] = value!("../..");
        hostile.0.get_mut("sample").unwrap()[0]["scene_token"] = value!("../..");
        let dataset = open(&NuScenesConfig { occupancy, ..hostile.write(dir.path()) });
        assert!(matches!(dataset.occupancy(0), Err(DataError::UnsafePath { .. } | DataError::Missing { .. })));
        tables.write(dir.path());
    }
    let without = open(&config);
    assert!(!without.capabilities().occupancy);
    assert!(matches!(without.occupancy(0), Err(DataError::Unsupported { .. })));
    let absent = OccupancyConfig::new(OccupancyKind::Occ3d, dir.path().join("absent"));
    assert!(matches!(
        NuScenes::open(&NuScenesConfig { occupancy: Some(absent), ..config }),
        Err(DataError::Missing { .. })
    ));
}
