//! Against the numbers of the specification's own formulas.

use data::nuplan::{NuPlan, NuPlanConfig};
use data::{SceneDataset, SceneFrame, View};
use geometry::Lens;
use geometry::glam::{DVec2, DVec3};
use serde_json::Value;

use super::open;
use crate::nuscenes::{floats, folder, image_path, json};

/// Goldens are rounded to 6 decimals, the camera rotations to 9.
const ROUNDED: f64 = 1e-6;
/// The same in pixels (4 decimals), with the focal length over the shortest depth on top.
const ROUNDED_PX: f64 = 1e-3;

fn fixture() -> Option<(NuPlan, Value)> {
    let root = folder("RIGSCAPE_DATA", "")?;
    let dataset = open(&NuPlanConfig::new(root.join("nuplan")));
    Some((dataset, json(&root.join("golden/nuplan.json"))))
}

fn distance(rows: &[[f64; 4]; 4], want: &Value) -> f64 {
    let want: [&Value; 4] = std::array::from_fn(|row| &want[row]);
    let differences = rows.iter().zip(want).flat_map(|(row, want)| {
        let want: [f64; 4] = floats(want);
        (0..4).map(move |at| (row[at] - want[at]).abs())
    });
    differences.fold(0.0, f64::max)
}

/// Frame and view of the picture with this file name.
fn find(dataset: &NuPlan, name: &str) -> (SceneFrame, usize) {
    let found = super::frames(dataset).into_iter().find_map(|frame| {
        let is_it = |view: &View| image_path(view.image.as_ref()).is_some_and(|path| path.ends_with(name));
        frame.views.iter().position(is_it).map(|at| (frame, at))
    });
    found.unwrap_or_else(|| panic!("no frame has {name}"))
}

#[test]
fn cameras_are_the_golden_ones_in_rig_order() {
    let Some((dataset, golden)) = fixture() else { return };
    let rig = dataset.frame(0).unwrap().rig();
    let channels: Vec<&str> = rig.cameras.iter().map(|camera| camera.channel.as_str()).collect();
    assert_eq!(channels, ["CAM_F0", "CAM_R0", "CAM_R1", "CAM_R2", "CAM_B0", "CAM_L2", "CAM_L1", "CAM_L0"]);
    assert!(rig.adjacency().unwrap().closed);
    assert_eq!(golden["cameras"].as_object().unwrap().len(), rig.len());
    for camera in &rig.cameras {
        let want = &golden["cameras"][&camera.channel];
        let worst = distance(&camera.ego_from_cam.to_rows(), &want["ego_from_cam"]);
        assert!(worst < 2e-9, "{}: {worst}", camera.channel);
        let k: [[f64; 3]; 3] = std::array::from_fn(|row| floats(&want["k_opencv"][row]));
        let i = &camera.intrinsics;
        assert_eq!([[i.fx, 0.0, i.cx - 0.5], [0.0, i.fy, i.cy - 0.5], [0.0, 0.0, 1.0]], k);
        let size = [want["width"].as_u64(), want["height"].as_u64()];
        assert_eq!([Some(i.width.into()), Some(i.height.into())], size);
        let [k1, k2, p1, p2, k3] = floats(&want["distortion_k1_k2_p1_p2_k3"]);
        assert_eq!(camera.lens, Lens::BrownConrady { k: [k1, k2, k3], p: [p1, p2] });
    }
    let front = &rig.cameras[0];
    let axis = front.ego_from_cam.transform_vector(DVec3::Z);
    assert!(front.ego_from_cam.translation.x > 0.0 && axis.x > 5.0_f64.to_radians().cos());
}

#[test]
fn poses_and_projected_centres_agree_with_every_golden_number() {
    let Some((dataset, golden)) = fixture() else { return };
    let (mut worst_pose, mut worst_center, mut worst_px, mut centers) = (0.0_f64, 0.0_f64, 0.0_f64, 0);
    for want in golden["frames"].as_array().unwrap() {
        let (frame, at) = find(&dataset, want["filename_jpg"].as_str().unwrap());
        let view = &frame.views[at];
        assert_eq!(view.channel, want["channel"].as_str().unwrap());
        assert_eq!(view.timestamp_ns, want["timestamp_us"].as_i64().unwrap() * 1000);
        assert_eq!(frame.id.frame, want["nearest_lidar_pc"].as_str().unwrap());
        assert_eq!(frame.timestamp_ns, want["lidar_timestamp_us"].as_i64().unwrap() * 1000);
        worst_pose = worst_pose.max(distance(&view.world_from_ego.to_rows(), &want["world_from_ego_interpolated"]));
        let cam_from_ref = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
        for center in want["centres"].as_array().unwrap() {
            let track = center["track_token"].as_str().unwrap();
            let found = frame.boxes.as_ref().unwrap().iter().find(|found| found.track == track).unwrap();
            let cam = cam_from_ref * found.box3d.center;
            let golden_cam = DVec3::from_array(floats(&center["center_cam"]));
            worst_center = worst_center.max((cam - golden_cam).abs().max_element());
            let golden_px = DVec2::from_array(floats(&center["uv_opencv"]));
            // Behind the reach of the lens the camera refuses, the bare formula does not.
            let plane = view.lens.distort(cam).unwrap();
            let pixel = view.intrinsics.pixel_from_plane(plane) - 0.5;
            worst_px = worst_px.max((pixel - golden_px).abs().max_element());
            if view.intrinsics.contains(pixel) {
                assert!((view.camera().unwrap().project(cam).unwrap() - 0.5 - pixel).length() < 1e-9);
            }
            centers += 1;
        }
    }
    eprintln!("{centers} centres: pose {worst_pose:.2e}, centre {worst_center:.2e} m, pixel {worst_px:.2e}");
    assert_eq!(golden["frames"].as_array().unwrap().len(), 8 * dataset.len());
    assert!(centers == 27 && worst_pose < ROUNDED && worst_center < 2.0 * ROUNDED && worst_px < ROUNDED_PX);
}

#[test]
fn the_nearest_pose_row_would_miss_by_centimetres() {
    let Some((dataset, golden)) = fixture() else { return };
    // With one pose for the whole set, the reference's, the outermost cameras are 17.5 ms or 14 cm off.
    let (frame, at) = find(&dataset, golden["frames"][0]["filename_jpg"].as_str().unwrap());
    let moved = frame.views[at].world_from_ego.translation.distance(frame.world_from_ego.translation);
    assert!((0.12..0.17).contains(&moved), "{moved}");
}

/// Base colours of the renderer; brightness varies with the face and haze, so directions of colour are compared.
fn base_color(class: &str) -> DVec3 {
    match class {
        "vehicle" => DVec3::new(205.0, 45.0, 45.0),
        "bicycle" => DVec3::new(60.0, 190.0, 60.0),
        "pedestrian" => DVec3::new(40.0, 90.0, 220.0),
        "traffic_cone" => DVec3::new(255.0, 110.0, 60.0),
        "barrier" => DVec3::new(235.0, 235.0, 235.0),
        _ => DVec3::new(30.0, 190.0, 190.0),
    }
}

#[test]
fn visible_boxes_have_the_colour_of_their_class() {
    let Some((dataset, _)) = fixture() else { return };
    let (mut matched, mut seen) = (0, 0);
    for frame in super::frames(&dataset) {
        for view in &frame.views {
            let camera = view.camera().unwrap();
            let cam_from_ref = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
            let picture = view.image.as_ref().unwrap().decode().unwrap();
            for found in frame.boxes.as_ref().unwrap() {
                let Some(pixel) = camera.project(cam_from_ref * found.box3d.center) else { continue };
                if !camera.intrinsics.contains(pixel) {
                    continue;
                }
                let rgb = picture.get_pixel(pixel.x as u32, pixel.y as u32).0.map(f64::from);
                let angle = DVec3::from_array(rgb).normalize().dot(base_color(&found.source_class).normalize());
                seen += 1;
                matched += usize::from(angle > 0.97);
            }
        }
    }
    // Boxes behind others do not match; the mirrored or shifted lens would leave almost none.
    eprintln!("{matched} of {seen} box centres have their colour");
    assert!(seen >= 20 && 10 * matched >= 7 * seen, "{matched} of {seen}");
}
