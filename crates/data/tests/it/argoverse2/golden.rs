//! Against numbers computed from the files by other means.

use data::argoverse2::Argoverse2Config;
use data::{SceneDataset, View};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};
use serde_json::Value;

use super::{fixture, open};

/// Goldens are rounded to nine decimals (poses), six (metres) and four (pixels).
const POSE: f64 = 1e-8;
const METRES: f64 = 1e-6;
const PIXELS: f64 = 1e-4;

fn golden() -> Option<Value> {
    let path = fixture("golden/argoverse2.json")?;
    Some(serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap())
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

fn pose_error(got: &Rigid, want: &Value) -> f64 {
    let rows = got.to_rows();
    let want = want.as_array().unwrap().iter().map(numbers);
    rows.iter()
        .zip(want)
        .flat_map(|(a, b)| a.iter().zip(b).map(|(a, b)| (a - b).abs()).collect::<Vec<_>>())
        .fold(0.0, f64::max)
}

#[test]
fn poses_centres_and_pixels_of_every_picture() {
    let Some(golden) = golden() else { return };
    let dataset = open(&Argoverse2Config::new(fixture("argoverse2").unwrap()));
    let (mut pictures, mut centres) = (0, 0);
    let (mut worst_pose, mut worst_m, mut worst_px, mut stale_px) = (0.0_f64, 0.0_f64, 0.0_f64, 0.0_f64);
    for want in golden["frames"].as_array().unwrap() {
        let stamp = want["lidar_timestamp_ns"].as_i64().unwrap();
        let frame = (0..dataset.len()).map(|index| dataset.frame(index).unwrap());
        let frame = frame.into_iter().find(|frame| frame.timestamp_ns == stamp).unwrap();
        let view = frame.views.iter().find(|view| view.channel == want["camera"].as_str().unwrap()).unwrap();
        assert_eq!(view.timestamp_ns, want["timestamp_ns"].as_i64().unwrap());
        let dt_ms = (view.timestamp_ns - stamp) as f64 * 1e-6;
        assert!((dt_ms - want["dt_ms"].as_f64().unwrap()).abs() < 1e-3);
        let cam_from_ego = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
        worst_pose = worst_pose.max(pose_error(&view.ego_from_cam, &want["ego_from_cam"]));
        worst_pose = worst_pose.max(pose_error(&cam_from_ego, &want["cam_from_ego_at_lidar"]));
        let listed = want["centres_in_view_within_60m"].as_array().unwrap();
        for centre in listed {
            let boxes = frame.boxes.as_ref().unwrap();
            let found = boxes.iter().find(|found| found.track == centre["track_uuid"].as_str().unwrap()).unwrap();
            assert_eq!(found.source_class, centre["category"].as_str().unwrap());
            let cam = cam_from_ego * found.box3d.center;
            worst_m = worst_m.max((cam - DVec3::from_slice(&numbers(&centre["center_cam"]))).length());
            let want_px = DVec2::from_slice(&numbers(&centre["uv_opencv"])) + DVec2::splat(0.5);
            let camera = view.camera().unwrap();
            worst_px = worst_px.max((camera.project(cam).unwrap() - want_px).length());
            let stale = view.ego_from_cam.inverse() * found.box3d.center;
            stale_px = stale_px.max(camera.project(stale).map_or(0.0, |pixel| (pixel - want_px).length()));
            centres += 1;
        }
        assert_eq!(count_in_view(view, &frame, &cam_from_ego), listed.len(), "{} at {stamp}", view.channel);
        pictures += 1;
    }
    assert_eq!((pictures, centres > 150), (21, true), "{centres}");
    assert!(worst_pose < POSE && worst_m < METRES && worst_px < PIXELS, "{worst_pose} {worst_m} m {worst_px} px");
    assert!(stale_px > 2.0, "the ego frame of the lidar stamp would do: {stale_px} px");
    eprintln!(
        "{centres} centres: poses {worst_pose:.1e}, {worst_m:.1e} m, {worst_px:.1e} px; without motion {stale_px:.1} px"
    );
}

/// Boxes whose centre is in the picture (the golden asks its own pixel convention) and at most 60 m away.
fn count_in_view(view: &View, frame: &data::SceneFrame, cam_from_ego: &Rigid) -> usize {
    let camera = view.camera().unwrap();
    let seen = |center: DVec3| {
        camera.project(*cam_from_ego * center).is_some_and(|pixel| view.intrinsics.contains(pixel - DVec2::splat(0.5)))
    };
    let boxes = frame.boxes.as_ref().unwrap().iter();
    boxes.filter(|found| (*cam_from_ego * found.box3d.center).z < 60.0 && seen(found.box3d.center)).count()
}

#[test]
fn ground_heights_and_the_height_of_the_car() {
    let Some(golden) = golden() else { return };
    let dataset = open(&Argoverse2Config::new(fixture("argoverse2").unwrap()));
    let ground = dataset.ground_height(0).unwrap();
    assert_eq!(ground.shape(), [785, 880]);
    let rows = golden["ground_height"].as_array().unwrap();
    assert_eq!(rows.len(), 6);
    for row in rows {
        let city = numbers(&row["ego_city"]);
        let height = ground.at(DVec2::new(city[0], city[1])).unwrap();
        assert_eq!(height, row["ground_height"].as_f64().unwrap());
        assert!((city[2] - height - 0.32).abs() < 0.1, "{} above the ground", city[2] - height);
    }
    for index in 0..dataset.len() {
        let car = dataset.frame(index).unwrap().world_from_ego.translation;
        let above = car.z - ground.at(car.truncate()).unwrap();
        assert!((above - 0.32).abs() < 0.1, "{above}");
    }
    assert_eq!(ground.at(DVec2::ZERO), None);
}
