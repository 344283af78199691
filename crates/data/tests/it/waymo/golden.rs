//! Against the publisher's own projections and against the generator of the made segment.

use std::collections::BTreeMap;

use data::waymo::WaymoRelease;
use data::{SceneDataset, View};
use geometry::glam::{DVec2, DVec3};
use serde_json::Value;

use super::{Waymo, config, fixture, floats, json, made, pose_error};

/// Goldens are rounded to nine decimals.
const POSE: f64 = 2e-9;

/// Smallest rectangle around the projected corners, cut at the picture's border, OpenCV pixels: u min, v min, u max, v max.
fn rectangle(view: &View, corners: [DVec3; 8], cam_from_ego: &geometry::Rigid) -> [f64; 4] {
    let size = DVec2::new(f64::from(view.intrinsics.width), f64::from(view.intrinsics.height));
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    for corner in corners {
        // The bare formula: a box at the border has corners outside the range the lens is trusted in.
        let pixel = view.intrinsics.pixel_from_plane(view.lens.distort(*cam_from_ego * corner).unwrap()) - 0.5;
        (low, high) = (low.min(pixel), high.max(pixel));
    }
    let (low, high) = (low.clamp(DVec2::ZERO, size), high.clamp(DVec2::ZERO, size));
    [low.x, low.y, high.x, high.y]
}

fn far(a: [f64; 4], b: [f64; 4]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn projections_of_the_published_frame_agree_with_its_own() {
    let Some(root) = fixture("waymo/v1") else { return };
    let golden = json(&fixture("golden/waymo_v1.json").unwrap());
    let dataset = Waymo::open(&config(&root, WaymoRelease::V1, "validation")).unwrap();
    let frame = dataset.frame(0).unwrap();
    assert_eq!(frame.id.scene, golden["context"].as_str().unwrap());
    assert_eq!(frame.id.frame, golden["timestamp_micros"].to_string());
    assert!(pose_error(&frame.world_from_ego, &golden["world_from_vehicle"]) < POSE);
    let boxes: BTreeMap<&str, _> = frame.boxes.iter().flatten().map(|b| (b.track.as_str(), b.box3d)).collect();
    let official = dataset.projected_lidar_labels(0).unwrap();
    let (mut compared, mut worst, mut worst_official) = (0, 0.0_f64, 0.0_f64);
    for (channel, want) in golden["cameras"].as_object().unwrap() {
        let view = frame.views.iter().find(|view| view.channel == *channel).unwrap();
        assert!(pose_error(&view.ego_from_cam, &want["ego_from_cam_opencv_axes"]) < POSE, "{channel}");
        assert_eq!((want["width"].as_u64(), want["height"].as_u64()), size(view), "{channel}");
        let cam_from_ego = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
        for label in want["boxes"].as_array().unwrap() {
            let id = label["laser_object_id"].as_str().unwrap();
            let ours = rectangle(view, boxes[id].corners(), &cam_from_ego);
            worst = worst.max(far(ours, floats(&label["computed"])));
            let published: [f64; 4] = floats(&label["official_box_umin_vmin_umax_vmax"]);
            worst_official = worst_official.max(far(ours, published));
            let own = official.iter().find(|own| own.channel == *channel && own.id.starts_with(id)).unwrap();
            let [u, v] = own.center_px.map(|center| center - 0.5);
            let [w, h] = own.size_px.map(|side| side / 2.0);
            assert!(far([u - w, v - h, u + w, v + h], published) < 2e-3, "{id} in {channel}");
            compared += 1;
        }
    }
    eprintln!("{compared} boxes: {worst:.4} px from the golden, {worst_official:.3} px from the official rectangles");
    assert_eq!(compared, 55);
    assert!(worst < 0.002 && worst_official < 0.2, "{worst} {worst_official}");
}

fn size(view: &View) -> (Option<u64>, Option<u64>) {
    (Some(view.intrinsics.width.into()), Some(view.intrinsics.height.into()))
}

#[test]
fn velocities_of_the_published_frame_point_where_objects_head() {
    let Some(root) = fixture("waymo/v1") else { return };
    let dataset = Waymo::open(&config(&root, WaymoRelease::V1, "validation")).unwrap();
    let frame = dataset.frame(0).unwrap();
    let mut moving = 0;
    for object in frame.boxes.iter().flatten() {
        let [x, y] = object.velocity.unwrap();
        if x.hypot(y) > 0.5 {
            let off = geometry::wrap_angle(y.atan2(x) - object.box3d.yaw);
            assert!(off.abs() < 0.1, "{} moves {off} rad off its heading", object.track);
            moving += 1;
        }
    }
    // The car's heading differs from the world's axes by 0.76 rad, so velocities left in world axes fail.
    assert_eq!(moving, 12);
}

#[test]
fn the_made_segment_is_where_its_generator_put_it_in_both_releases() {
    let Some(datasets) = made() else { return };
    let golden = json(&fixture("golden/waymo_made.json").unwrap());
    for dataset in &datasets {
        let mut worst = Worst::default();
        let want = golden["frames"].as_array().unwrap();
        assert_eq!((dataset.len(), want.len()), (3, 3));
        for (index, want) in want.iter().enumerate() {
            compare_frame(dataset, index, want, &mut worst);
        }
        eprintln!("{worst:?}");
        assert_eq!((worst.pictures, worst.centres), (15, 22));
        assert!(worst.pose < POSE && worst.center_m < 2e-6 && worst.pixel < 0.05, "{worst:?}");
        assert!(worst.colour <= 12, "{worst:?}");
        assert!((10.0..20.0).contains(&worst.pixel_with_frame_pose), "{worst:?}");
    }
}

#[derive(Debug, Default)]
struct Worst {
    pictures: usize,
    centres: usize,
    pose: f64,
    center_m: f64,
    pixel: f64,
    /// With one pose for all pictures, in FRONT_RIGHT.
    pixel_with_frame_pose: f64,
    colour: u8,
}

fn compare_frame(dataset: &Waymo, index: usize, want: &Value, worst: &mut Worst) {
    let frame = dataset.frame(index).unwrap();
    let micros = want["timestamp_micros"].as_i64().unwrap();
    assert_eq!((frame.id.frame.clone(), frame.timestamp_ns), (micros.to_string(), (micros + 50_000) * 1000));
    worst.pose = worst.pose.max(pose_error(&frame.world_from_ego, &want["world_from_vehicle"]));
    for picture in want["images"].as_array().unwrap() {
        let view = frame.views.iter().find(|view| view.channel == picture["camera"].as_str().unwrap()).unwrap();
        let secs = picture["pose_timestamp"].as_f64().unwrap();
        assert!((view.timestamp_ns as f64 * 1e-9 - secs).abs() < 3e-7 && view.timestamp_ns > 0);
        assert_eq!((picture["width"].as_u64(), picture["height"].as_u64()), size(view));
        worst.pose = worst.pose.max(pose_error(&view.world_from_ego, &picture["world_from_ego"]));
        worst.pictures += 1;
        let pixels = view.image.as_ref().unwrap().decode().unwrap();
        for centre in picture["centres"].as_array().unwrap() {
            let id = centre["id"].as_str().unwrap();
            let object = frame.boxes.iter().flatten().find(|object| object.track == id).unwrap();
            let point = view.ref_ego_from_cam(&frame.world_from_ego).inverse() * object.box3d.center;
            let want = DVec3::from_array(floats(&centre["center_cam"]));
            worst.center_m = worst.center_m.max((point - want).abs().max_element());
            let camera = view.camera().unwrap();
            let pixel = camera.project(point).unwrap();
            let want = DVec2::from_array(floats(&centre["uv"])) + 0.5;
            worst.pixel = worst.pixel.max((pixel - want).length());
            if view.channel == "FRONT_RIGHT" {
                let still = camera.project(view.ego_from_cam.inverse() * object.box3d.center).unwrap();
                worst.pixel_with_frame_pose = worst.pixel_with_frame_pose.max((still - want).length());
            }
            let got = pixels.get_pixel(want.x as u32, want.y as u32).0;
            let colour: [f64; 3] = floats(&centre["image_rgb"]);
            let off = got.iter().zip(colour).map(|(got, want)| got.abs_diff(want as u8)).max().unwrap();
            worst.colour = worst.colour.max(off);
            worst.centres += 1;
        }
    }
}
