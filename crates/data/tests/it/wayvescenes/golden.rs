//! Every number of the golden files: scale, region, poses, rig, stamps.

use std::collections::BTreeMap;

use data::wayvescenes::WayveScenes;
use data::{SceneDataset, SceneFrame};
use geometry::Rigid;
use geometry::glam::{DMat3, DQuat, DVec3};
use serde_json::Value;

use super::{CHANNELS, data_folder, fixture, frames_of, open, world_from_cam};

/// The truth of one scene, metres.
struct Truth {
    region: String,
    metres_per_unit: f64,
    ego_from_cam: BTreeMap<String, Rigid>,
    /// Raw stamp and pose.
    frames: Vec<(i64, Rigid)>,
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().flat_map(|row| row.as_array().unwrap()).map(|v| v.as_f64().unwrap()).collect()
}

fn vector(value: &Value) -> DVec3 {
    let list: Vec<f64> = value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    DVec3::from_slice(&list)
}

/// Rotation of row-major numbers with a stride.
fn rotation(rows: &[f64], stride: usize) -> DQuat {
    let row = |i: usize| [rows[i * stride], rows[i * stride + 1], rows[i * stride + 2]];
    DQuat::from_mat3(&DMat3::from_cols_array_2d(&[row(0), row(1), row(2)]).transpose())
}

fn truth(scene: &str) -> Option<Truth> {
    let path = data_folder(&format!("golden/wayve101_{scene}.json"))?;
    let golden: Value = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let rig = golden["ego_from_cam"].as_object().unwrap().iter().map(|(channel, pose)| {
        let pose = Rigid::new(rotation(&numbers(&pose["rotation"]), 3), vector(&pose["translation"]));
        (channel.clone(), pose)
    });
    let frames = golden["frames"].as_array().unwrap().iter().map(|frame| {
        let m = numbers(&frame["metric_world_from_ego"]);
        let pose = Rigid::new(rotation(&m, 4), DVec3::new(m[3], m[7], m[11]));
        (frame["timestamp"].as_i64().unwrap(), pose)
    });
    Some(Truth {
        region: golden["region"].as_str().unwrap().to_owned(),
        metres_per_unit: 1.0 / golden["colmap_from_metric"]["scale"].as_f64().unwrap(),
        ego_from_cam: rig.collect(),
        frames: frames.collect(),
    })
}

fn worst(worst: &mut f64, value: f64) {
    assert!(value.is_finite());
    *worst = worst.max(value);
}

fn check_scene(dataset: &WayveScenes, scene: &str, unit_ns: i64) -> Option<()> {
    let truth = truth(scene)?;
    let info = dataset.scenes().into_iter().find(|info| info.name == scene).unwrap();
    let found = frames_of(dataset, &info);
    assert_eq!(info.region.as_deref(), Some(truth.region.as_str()));
    assert!((info.metres_per_unit / truth.metres_per_unit - 1.0).abs() < 1e-9, "{} {}", scene, info.metres_per_unit);
    assert!(info.ground_points.is_some());
    assert_eq!(found.len(), truth.frames.len());
    let metric_from_ours = true_world_from_ours(&truth, &found[0]);
    let (mut position, mut angle) = (0.0, 0.0);
    for (frame, (stamp, world_from_ego)) in found.iter().zip(&truth.frames) {
        assert_eq!((frame.timestamp_ns, &frame.id.frame), (stamp * unit_ns, &stamp.to_string()));
        assert_eq!(frame.views.iter().map(|view| view.channel.as_str()).collect::<Vec<_>>(), CHANNELS);
        for view in &frame.views {
            assert_eq!(view.timestamp_ns, frame.timestamp_ns);
            let want = *world_from_ego * truth.ego_from_cam[&view.channel];
            let got = metric_from_ours * world_from_cam(view);
            worst(&mut position, got.translation.distance(want.translation));
            worst(&mut angle, got.angle_to(&want));
        }
    }
    eprintln!("{scene}: poses off by {position:.1e} m, {angle:.1e} rad");
    assert!(position < 1e-9 && angle < 1e-9, "{scene}: poses are off by {position} m and {angle} rad");
    // The ground of the truth is z = 0: our world must stand upright in it.
    assert!(metric_from_ours.transform_vector(DVec3::Z).angle_between(DVec3::Z) < 1e-9);
    check_rig(&truth, &found, info.camera_height_m);
    Some(())
}

/// Both worlds are arbitrary: where ours lies is taken from one camera of one frame.
fn true_world_from_ours(truth: &Truth, first: &SceneFrame) -> Rigid {
    let want = truth.frames[0].1 * truth.ego_from_cam[CHANNELS[0]];
    want * world_from_cam(&first.views[0]).inverse()
}

/// The car frame of the specification, worked out from the truth.
fn check_rig(truth: &Truth, found: &[SceneFrame], camera_height_m: f64) {
    let ego_from_front = truth.ego_from_cam[CHANNELS[0]];
    let fronts: Vec<Rigid> = truth.frames.iter().map(|(_, pose)| *pose * ego_from_front).collect();
    let z = fronts.iter().map(|pose| pose.inverse().transform_vector(DVec3::Z)).sum::<DVec3>().normalize();
    let x = (DVec3::Z - z * z.z).normalize();
    let level = DQuat::from_mat3(&DMat3::from_cols(x, z.cross(x), z).transpose());
    let mut heights: Vec<f64> = fronts.iter().map(|pose| pose.translation.z).collect();
    heights.sort_by(f64::total_cmp);
    let height = 0.5 * (heights[heights.len() / 2] + heights[(heights.len() - 1) / 2]);
    let ours_from_front = Rigid::new(level, DVec3::Z * height);
    let ours_from_true = ours_from_front * ego_from_front.inverse();
    let (mut position, mut angle) = (0.0, 0.0);
    for view in found.iter().flat_map(|frame| &frame.views) {
        let want = ours_from_true * truth.ego_from_cam[&view.channel];
        worst(&mut position, view.ego_from_cam.translation.distance(want.translation));
        worst(&mut angle, view.ego_from_cam.angle_to(&want));
        // The mean pitch of a few frames is all that parts it from the frame at the rear axle.
        let below_front = DVec3::new(1.75, -0.2, 0.0);
        let near = truth.ego_from_cam[&view.channel];
        assert!(view.ego_from_cam.translation.distance(near.translation - below_front) < 0.02, "{}", view.channel);
        assert!(view.ego_from_cam.angle_to(&near).to_degrees() < 0.4, "{}", view.channel);
    }
    eprintln!("rig off by {position:.1e} m, {angle:.1e} rad; forward camera {camera_height_m:.4} m above the ground");
    assert!(position < 1e-9 && angle < 1e-9, "the rig is off by {position} m and {angle} rad");
    assert!((camera_height_m - height).abs() < 1e-9 && (camera_height_m - 1.42).abs() < 0.012, "{camera_height_m}");
    let front = &found[0].views[0].ego_from_cam;
    assert!(front.translation.truncate().length() < 1e-12 && front.translation.z == camera_height_m);
    let axis = front.transform_vector(DVec3::Z);
    assert!(axis.y.abs() < 1e-12 && axis.angle_between(DVec3::X).to_degrees() < 5.0, "{axis}");
}

#[test]
fn both_scenes_equal_their_truth() {
    let Some(config) = fixture(|_| {}) else { return };
    let dataset = open(&config);
    assert_eq!((dataset.len(), dataset.max_views()), (7, 5));
    check_scene(&dataset, "scene_901", 1000).unwrap();
    check_scene(&dataset, "scene_902", 1).unwrap();
}
