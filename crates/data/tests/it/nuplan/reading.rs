//! The reader on the fixture log: sets, splits, options, traps of the format.

use std::path::PathBuf;

use data::nuplan::{NuPlan, NuPlanConfig, check};
use data::taxonomy::ClassRule;
use data::{DataError, DatasetConfig, ObjectClass, SceneDataset, SceneFrame};
use geometry::ImageEdit;
use geometry::glam::DVec3;

use super::{frames, open};
use crate::nuscenes::folder;

const LOG: &str = "2021.05.12.22.00.38_veh-35_01008_01518";

fn fixture(change: impl FnOnce(&mut NuPlanConfig)) -> Option<NuPlanConfig> {
    let root = folder("RIGSCAPE_DATA", "nuplan")?;
    let mut config = NuPlanConfig::new(root);
    change(&mut config);
    Some(config)
}

fn ids(frames: &[SceneFrame]) -> Vec<&str> {
    frames.iter().map(|frame| frame.id.frame.as_str()).collect()
}

#[test]
fn only_sets_with_pictures_are_offered() {
    let Some(config) = fixture(|_| {}) else { return };
    let dataset = open(&config);
    assert_eq!((dataset.len(), dataset.max_views(), dataset.scene_ranges().len()), (2, 8, 1));
    assert_eq!(dataset.scene_ranges()[0], 0..2);
    let all = frames(&dataset);
    assert_eq!(ids(&all), ["eff7319fb98f5225", "769ff139b1ed8f06"]);
    let log = &dataset.logs()[0];
    assert_eq!((log.name.as_str(), log.location.as_deref()), (LOG, Some("us-nv-las-vegas-strip")));
    assert_eq!(log.absent_pictures, 160);
    for frame in &all {
        assert_eq!((frame.id.dataset.as_str(), frame.id.scene.as_str()), ("nuplan", LOG));
        assert!(frame.views.iter().all(|view| view.image.is_some() && view.mask.is_none()));
        let edit = ImageEdit::identity(1920, 1080).resize(240, 135);
        assert_eq!(frame.views[0].image.as_ref().unwrap().load(&edit).unwrap().dimensions(), (240, 135));
    }
    assert!(all[0].timestamp_ns < all[1].timestamp_ns);
    assert!(dataset.frame(2).unwrap_err().to_string().contains("does not exist"));
}

#[test]
fn boxes_are_longer_than_wide_and_move_as_they_say() {
    let Some(config) = fixture(|_| {}) else { return };
    let dataset = open(&config);
    assert!(dataset.capabilities().boxes && dataset.capabilities().text && !dataset.capabilities().map);
    let all = frames(&dataset);
    let (first, second) = (all[0].boxes.as_ref().unwrap(), all[1].boxes.as_ref().unwrap());
    assert_eq!(first.len(), 10);
    let tracks: Vec<&str> = first.iter().map(|found| found.track.as_str()).collect();
    assert!(tracks.is_sorted());
    let secs = (all[1].timestamp_ns - all[0].timestamp_ns) as f64 * 1e-9;
    let mut moving = 0;
    for found in first {
        if found.source_class == "vehicle" {
            assert!(found.class == ObjectClass::Car && found.box3d.size.x > found.box3d.size.y, "{found:?}");
        }
        let later = second.iter().find(|other| other.track == found.track).unwrap();
        let world = |frame: &SceneFrame, center: DVec3| frame.world_from_ego * center;
        let moved = world(&all[1], later.box3d.center) - world(&all[0], found.box3d.center);
        let velocity = all[0].world_from_ego.inverse().transform_vector(moved / secs);
        let said = found.velocity.unwrap();
        assert!(
            (velocity.x - said[0]).hypot(velocity.y - said[1]) < 0.2 + 0.12 * said[0].hypot(said[1]),
            "{velocity} instead of {said:?}"
        );
        if said[0].hypot(said[1]) > 1.0 {
            moving += 1;
            // Heading and motion agree: yaw is about +z from +x.
            let yaw = found.box3d.yaw;
            let forward = (yaw.cos() * said[0] + yaw.sin() * said[1]) / said[0].hypot(said[1]);
            assert!(forward.abs() > 0.98, "{forward}");
        }
        assert!(!found.interpolated && found.points.is_none() && found.attributes.is_empty());
    }
    assert!(moving >= 2);
}

#[test]
fn splits_logs_and_cameras_select() {
    let names = |change: &dyn Fn(&mut NuPlanConfig)| -> Option<Result<Vec<String>, DataError>> {
        let config = fixture(|config| change(config))?;
        Some(NuPlan::open(&config).map(|dataset| dataset.logs().into_iter().map(|log| log.name).collect()))
    };
    let split = |split: &'static str| names(&move |config| config.split = split.to_owned());
    let Some(train) = split("train") else { return };
    assert_eq!(train.unwrap(), [LOG]);
    assert_eq!(split("mini").unwrap().unwrap(), [LOG]);
    assert!(matches!(split("val").unwrap(), Err(DataError::Empty { .. })));
    assert!(matches!(split("valid").unwrap(), Err(DataError::Config(_))));
    let unknown = names(&|config| config.logs = vec!["x".to_owned()]).unwrap().unwrap_err();
    assert!(matches!(unknown, DataError::Config(_)) && unknown.to_string().contains("\"x\""));
    let chosen = names(&|config| config.logs = vec![LOG.to_owned()]).unwrap();
    assert_eq!(chosen.unwrap(), [LOG]);
    let camera = names(&|config| config.cameras = vec!["CAM_X".to_owned()]).unwrap();
    assert!(matches!(camera, Err(DataError::Config(_))));
    let config = fixture(|config| config.cameras = vec!["CAM_L0".to_owned(), "CAM_F0".to_owned()]).unwrap();
    let frame = open(&config).frame(0).unwrap();
    let channels: Vec<&str> = frame.views.iter().map(|view| view.channel.as_str()).collect();
    assert_eq!((channels, frame.id.frame.as_str()), (vec!["CAM_F0", "CAM_L0"], "eff7319fb98f5225"));
}

#[test]
fn classes_shift_and_exclusion_are_options() {
    let Some(plain) = fixture(|_| {}) else { return };
    let plain = frames(&open(&plain));
    let changed = fixture(|config| {
        config.classes.insert("vehicle".to_owned(), ClassRule::As(ObjectClass::Truck));
        config.classes.insert("pedestrian".to_owned(), ClassRule::Drop);
        config.shutter_shift_ms = 1000.0 / 60.0;
        config.exclude = vec!["769ff139b1ed8f06".to_owned()];
    });
    let changed = frames(&open(&changed.unwrap()));
    assert_eq!(ids(&changed), ["eff7319fb98f5225"]);
    let boxes = changed[0].boxes.as_ref().unwrap();
    assert!(boxes.iter().all(|found| found.source_class != "pedestrian"));
    assert!(boxes.iter().any(|found| found.class == ObjectClass::Truck));
    assert!(boxes.len() < plain[0].boxes.as_ref().unwrap().len());
    for (shifted, view) in changed[0].views.iter().zip(&plain[0].views) {
        assert_eq!(shifted.timestamp_ns - view.timestamp_ns, 16_666_667);
        let moved = shifted.world_from_ego.translation.distance(view.world_from_ego.translation);
        assert!((0.12..0.15).contains(&moved), "{moved}");
    }
}

#[test]
fn the_lens_keeps_far_off_points_out_of_the_picture() {
    let Some(config) = fixture(|_| {}) else { return };
    let frame = open(&config).frame(0).unwrap();
    for view in &frame.views {
        let camera = view.camera().unwrap();
        // 64 degrees beside the axis the polynomial has folded back into the picture.
        let beside = DVec3::new(2.05, 0.0, 1.0);
        let folded = view.intrinsics.pixel_from_plane(view.lens.distort(beside).unwrap());
        assert!(folded.is_finite());
        assert_eq!(camera.project(beside), None);
        assert_eq!(camera.project(DVec3::new(0.1, 0.1, -5.0)), None);
        let fov = camera.intrinsics.horizontal_fov().to_degrees();
        assert!((fov - 63.7).abs() < 0.2, "{fov}");
        let (left, right) = view.rig_camera().horizontal_span().unwrap();
        assert!(((left - right).to_degrees() - 72.2).abs() < 0.3);
    }
}

#[test]
fn maps_and_occupancy_are_unsupported_and_the_registry_knows_the_kind() {
    let Some(config) = fixture(|_| {}) else { return };
    let root = config.root.clone();
    let dataset = open(&config);
    assert!(matches!(dataset.local_map(0, 50.0), Err(DataError::Unsupported { .. })));
    assert!(matches!(dataset.occupancy(0), Err(DataError::Unsupported { .. })));
    let text = serde_json::json!({"kind": "nuplan", "root": root, "split": "mini", "name": "n"}).to_string();
    let config: DatasetConfig = serde_json::from_str(&text).unwrap();
    let opened = data::open(&config).unwrap();
    assert_eq!((opened.len(), opened.name()), (2, "n"));
    assert!(serde_json::from_str::<DatasetConfig>(r#"{"kind": "nuplan", "root": "d", "splitt": "x"}"#).is_err());
    assert!(matches!(NuPlan::open(&NuPlanConfig::new(PathBuf::from("absent"))), Err(DataError::Missing { .. })));
}

#[test]
fn a_check_finds_nothing_wrong_with_the_fixture() {
    let Some(config) = fixture(|_| {}) else { return };
    let found = check(&config, 3).unwrap();
    assert!(found.report.is_sound() && found.logs_without_pictures.is_empty());
    assert_eq!((found.report.scenes, found.report.frames, found.report.pictures), (1, 2, 16));
    assert_eq!((found.report.decoded, found.report.absent_views), (3, 0));
}
