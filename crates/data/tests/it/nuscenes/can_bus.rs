//! The CAN bus expansion of the fixture.

use std::path::Path;

use data::nuscenes::{CanMessage, FrameChoice, NuScenes, NuScenesConfig};
use data::{DataError, SceneDataset};

use super::made::{START_US, Tables};
use super::{folder, json, open};

fn chain(root: &Path) -> NuScenesConfig {
    NuScenesConfig {
        frames: FrameChoice::all_pictures(),
        ..NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini")
    }
}

#[test]
fn states_between_messages_follow_the_poses_of_the_tables() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = open(&chain(&root));
    assert!(dataset.capabilities().can_bus);
    let (mut worst_m, mut worst_rad, mut whole) = (0.0f64, 0.0f64, 0);
    for index in 0..dataset.len() {
        let frame = dataset.frame(index).unwrap();
        let state = dataset.can_state(index).unwrap();
        assert_eq!(state.timestamp_ns, frame.timestamp_ns);
        let Some(pose) = state.world_from_ego else { continue };
        whole += 1;
        worst_m = worst_m.max(pose.translation.distance(frame.world_from_ego.translation));
        worst_rad = worst_rad.max(pose.angle_to(&frame.world_from_ego));
        let want = if frame.id.scene == "scene-0916" { 9.0 } else { 6.5 };
        // In the curve the fixture's messages hold 8.6 m/s.
        assert!((state.velocity.unwrap()[0] - want).abs() < 0.5, "{state:?}");
        assert!((state.acceleration.unwrap()[2] - 9.81).abs() < 0.2);
        assert!(state.steering_rad.is_some() && state.rotation_rate.is_some());
        if let Some(speed) = state.speed {
            assert!((speed - want).abs() < 0.05, "{state:?}");
        }
    }
    eprintln!("{whole} of {} frames, {worst_m} m, {worst_rad} rad", dataset.len());
    assert!(whole >= dataset.len() - 2);
    assert!(worst_m < 0.02 && worst_rad < 2e-3, "{worst_m} m, {worst_rad} rad");
}

#[test]
fn values_at_and_between_messages() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let dataset = open(&chain(&root));
    let bus = dataset.can_bus(0).unwrap();
    let rows = json(&root.join("nuscenes_chain/can_bus/scene-0916_pose.json"));
    let pose = bus.signal(CanMessage::Pose).unwrap();
    assert_eq!(pose.times_ns().len(), rows.as_array().unwrap().len());
    let x = |at: usize| rows[at]["pos"][0].as_f64().unwrap();
    let [first, second] = [pose.times_ns()[0], pose.times_ns()[1]];
    assert_eq!(first, rows[0]["utime"].as_i64().unwrap() * 1000);
    assert_eq!(pose.at(first, "pos").unwrap()[0], x(0));
    let quarter = pose.at(first + (second - first) / 4, "pos").unwrap()[0];
    assert!((quarter - (0.75 * x(0) + 0.25 * x(1))).abs() < 1e-6);
    assert_eq!(pose.row(1).unwrap()["pos"][0], x(1));
    let turned = pose.at(first + (second - first) / 2, "orientation").unwrap();
    assert!((turned.iter().map(|value| value * value).sum::<f64>() - 1.0).abs() < 1e-12);
    assert_eq!((pose.at(first - 1, "pos"), pose.at(first, "nothing")), (None, None));
    assert_eq!(pose.at(pose.times_ns().last().unwrap() + 1, "pos"), None);
    for message in [CanMessage::MsImu, CanMessage::SteerAngleFeedback, CanMessage::ZoeVehInfo] {
        let signal = bus.signal(message).unwrap();
        assert!(signal.times_ns().windows(2).all(|pair| pair[0] < pair[1]));
    }
    assert!(bus.route().unwrap().len() > 10);
    assert!(bus.meta().unwrap().contains_key("pose"));
    let missing = bus.signal(CanMessage::ZoeSensors).unwrap_err();
    assert!(matches!(missing, DataError::Missing { .. }), "{missing:?}");
    assert!(missing.to_string().ends_with("scene-0916_zoesensors.json"), "{missing}");
}

#[test]
fn scenes_and_datasets_without_messages_are_told_apart() {
    let dir = tempfile::tempdir().unwrap();
    let mut tables = Tables::new();
    for name in ["scene-0160", "scene-0161", "scene-0312"] {
        tables.scene(name, &[START_US, START_US + 500_000]);
    }
    let config = tables.write(dir.path());
    let without = NuScenes::open(&config).unwrap();
    assert!(!without.capabilities().can_bus);
    assert!(matches!(without.can_state(0), Err(DataError::Unsupported { .. })));
    let folder = dir.path().join("can_bus");
    std::fs::create_dir(&folder).unwrap();
    let pose = folder.join("scene-0160_pose.json");
    let row = |time: i64, x: f64| {
        format!(r#"{{"utime": {time}, "pos": [{x}, 0, 0], "orientation": [1, 0, 0, 0], "vel": [1, 0, 0]}}"#)
    };
    // Out of order and twice, as logged.
    let (late, early) = (row(START_US + 20_000, 3.0), row(START_US - 20_000, 1.0));
    std::fs::write(&pose, format!("[{late}, {early}, {late}]")).unwrap();
    let dataset = NuScenes::open(&config).unwrap();
    let state = dataset.can_state(0).unwrap();
    assert_eq!(state.world_from_ego.unwrap().translation.x, 2.0);
    assert_eq!((state.steering_rad, state.speed, state.acceleration), (None, None, None));
    assert_eq!(dataset.can_state(1).unwrap().world_from_ego, None, "nothing is extrapolated");
    for scene in [1, 2] {
        assert!(matches!(dataset.can_bus(2 * scene), Err(DataError::Unsupported { .. })), "{scene}");
    }
    for text in ["[", "{}", r#"[{"pos": [1]}]"#, r#"[{"utime": 1, "pos": "x"}]"#, r#"[{"utime": 9223372036854775807}]"#]
    {
        std::fs::write(&pose, text).unwrap();
        let error = dataset.can_state(0).unwrap_err();
        assert!(matches!(error, DataError::Json { .. }) && error.to_string().ends_with("_pose.json"), "{error}");
    }
}
