//! Against the numbers of the official devkit.

use std::collections::HashMap;
use std::path::Path;

use data::SceneDataset;
use data::nuscenes::{BoxMode, FrameChoice, NuScenes, NuScenesConfig, WorldBox};
use geometry::Rigid;
use geometry::glam::{DMat3, DVec2, DVec3};
use serde_json::Value;

use super::made::Tables;
use super::{floats, folder, frames, golden_folder, image_path, json, open};

/// Goldens are rounded to 6 to 9 decimals; boxes between samples differ by up to 2e-5 rad times 60 m because the devkit's slerp
/// becomes a plain mix for small angles.
const EXACT: f64 = 2e-6;
const TURNED: f64 = 3e-5;

fn close(got: &[f64], want: &Value, tolerance: f64, what: &str) {
    let want: Vec<f64> = want.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect();
    assert_eq!(got.len(), want.len(), "{what}");
    for (a, b) in got.iter().zip(&want) {
        assert!((a - b).abs() <= tolerance, "{what}: {got:?} instead of {want:?}");
    }
}

fn close_pose(got: &Rigid, want: &Value, what: &str) {
    for (row, want) in got.to_rows().iter().zip(want.as_array().unwrap()) {
        close(row, want, EXACT, what);
    }
}

#[test]
fn the_key_frame_and_the_chain_agree_with_the_devkit() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    for (name, choice) in [
        ("nuscenes_keyframe", FrameChoice::KeyFrames),
        ("nuscenes_keyframe", FrameChoice::all_pictures()),
        ("nuscenes_chain", FrameChoice::all_pictures()),
    ] {
        let config = NuScenesConfig { frames: choice, ..NuScenesConfig::new(root.join(name), "v1.0-mini") };
        let dataset = open(&config);
        let golden = json(&root.join("golden").join(format!("{name}.json")));
        let pictures = golden["frames"].as_array().unwrap();
        assert!(!pictures.is_empty());
        pictures.iter().for_each(|picture| compare_picture(&dataset, picture));
        if let Some(velocities) = golden["velocity_mps"].as_object() {
            compare_velocities(&dataset, velocities);
        }
    }
}

/// Frame and view of the picture with this file name.
fn find(dataset: &NuScenes, name: &str) -> (usize, usize) {
    let found = frames(dataset).iter().enumerate().find_map(|(index, frame)| {
        let is_it = |view: &data::View| image_path(view.image.as_ref()).is_some_and(|path| path.ends_with(name));
        frame.views.iter().position(is_it).map(|view| (index, view))
    });
    found.unwrap_or_else(|| panic!("no frame has {name}"))
}

fn compare_picture(dataset: &NuScenes, golden: &Value) {
    let name = golden["filename"].as_str().unwrap();
    let (index, at) = find(dataset, name);
    let frame = dataset.frame(index).unwrap();
    let view = &frame.views[at];
    assert_eq!(view.timestamp_ns, golden["timestamp_us"].as_i64().unwrap() * 1000, "{name}");
    assert_eq!(view.channel, golden["channel"].as_str().unwrap());
    close_pose(&view.world_from_ego, &golden["world_from_ego"], name);
    close_pose(&view.ego_from_cam, &golden["ego_from_cam"], name);
    let k = &view.intrinsics;
    for (row, want) in
        [[k.fx, 0.0, k.cx - 0.5], [0.0, k.fy, k.cy - 0.5]].iter().zip(golden["k_opencv"].as_array().unwrap())
    {
        close(row, want, EXACT, name);
    }
    let boxes = dataset.picture_boxes(index, at, BoxMode::Devkit).unwrap().unwrap();
    let by_token: HashMap<&str, &WorldBox> = boxes.iter().map(|b| (b.annotation.as_str(), b)).collect();
    let golden_boxes = golden["boxes"].as_array().unwrap();
    assert_eq!(boxes.len(), golden_boxes.len(), "{name}");
    let tolerance = if golden["is_key_frame"].as_bool().unwrap() { EXACT } else { TURNED };
    for want in golden_boxes {
        let found = by_token.get(want["annotation_token"].as_str().unwrap());
        compare_box(view, found.expect("a box is missing"), want, tolerance, name);
    }
    let (any, all) = visible(view, &boxes);
    assert_eq!(any, golden["devkit_boxes_in_image_any"].as_u64().unwrap() as usize, "{name}");
    assert_eq!(all, golden["devkit_boxes_in_image_all"].as_u64().unwrap() as usize, "{name}");
    // Key frames carry the same boxes in the frame's own ego, reached through the motion between the stamps.
    if golden["is_key_frame"].as_bool().unwrap() {
        let view_from_ref = view.world_from_ego.inverse() * frame.world_from_ego;
        for (ours, world) in frame.boxes.as_ref().unwrap().iter().zip(&boxes) {
            let there = view_from_ref * ours.box3d.center;
            let want = view.world_from_ego.inverse() * world.world_from_box.translation;
            assert!(there.abs_diff_eq(want, 1e-9), "{name}: {there} instead of {want}");
            assert_eq!(ours.track, world.track);
        }
    }
}

fn compare_box(view: &data::View, found: &WorldBox, want: &Value, tolerance: f64, name: &str) {
    let what = format!("{name}, box {}", found.annotation);
    assert_eq!(found.source_class, want["category"].as_str().unwrap());
    close(&found.size.to_array(), &want["size_lwh"], EXACT, &what);
    let ego_from_box = view.world_from_ego.inverse() * found.world_from_box;
    close(&found.world_from_box.translation.to_array(), &want["center_world"], EXACT, &what);
    close(&ego_from_box.translation.to_array(), &want["center_ego"], EXACT, &what);
    assert!(
        (found.in_ego(&view.world_from_ego).box3d.yaw - want["yaw_ego"].as_f64().unwrap()).abs() < tolerance,
        "{what}"
    );
    let cam_from_box = view.ego_from_cam.inverse() * ego_from_box;
    close(&cam_from_box.translation.to_array(), &want["center_cam"], EXACT, &what);
    let Some(corners) = want["corners_uv_opencv"].as_array() else { return };
    let camera = view.camera().unwrap();
    for (corner, want) in found.corners().iter().zip(corners) {
        let cam = view.ego_from_cam.inverse() * (view.world_from_ego.inverse() * *corner);
        let pixel = camera.project(cam).unwrap() - DVec2::splat(0.5);
        // 0.01 px near the picture; corners far outside it scale with their distance from the centre.
        let limit = 0.01 + tolerance * pixel.length();
        close(&pixel.to_array(), want, limit, &what);
    }
}

/// Boxes with any and with all corners in the picture by the devkit's rules (depth above 1 m counts, above 0.1 m is in front).
fn visible(view: &data::View, boxes: &[WorldBox]) -> (usize, usize) {
    let k = view.intrinsics;
    let (mut any, mut all) = (0, 0);
    for found in boxes {
        let corners =
            found.corners().map(|corner| view.ego_from_cam.inverse() * (view.world_from_ego.inverse() * corner));
        if corners.iter().any(|corner| corner.z <= 0.1) {
            continue;
        }
        let seen = corners.map(|c| {
            let pixel = DVec2::new(k.fx * c.x / c.z + k.cx - 0.5, k.fy * c.y / c.z + k.cy - 0.5);
            k.contains(pixel) && c.z > 1.0
        });
        any += usize::from(seen.iter().any(|seen| *seen));
        all += usize::from(seen.iter().all(|seen| *seen));
    }
    (any, all)
}

fn compare_velocities(dataset: &NuScenes, golden: &serde_json::Map<String, Value>) {
    let mut compared = 0;
    for index in 0..dataset.len() {
        for found in dataset.world_boxes(index).unwrap().unwrap_or_default().iter().filter(|b| !b.interpolated) {
            let want = &golden[&found.annotation];
            match found.velocity {
                // The devkit subtracts stamps as f64 seconds near 1.9e9, which are 2.4e-7 s apart.
                Some(velocity) => close(&velocity.to_array(), want, 1e-5, &found.annotation),
                None => assert!(want.is_null() || want[0].is_null(), "{} has velocity {want}", found.annotation),
            }
            compared += 1;
        }
    }
    assert_eq!(compared, golden.len());
}

#[test]
fn object_centres_are_where_the_renderer_put_them() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let config = NuScenesConfig {
        frames: FrameChoice::all_pictures(),
        ..NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini")
    };
    let dataset = open(&config);
    let centres = json(&root.join("golden/nuscenes_chain_centres.json"));
    for golden in centres.as_array().unwrap() {
        let (index, at) = find(&dataset, golden["filename"].as_str().unwrap());
        let view = &dataset.frame(index).unwrap().views[at];
        let boxes = dataset.picture_boxes(index, at, BoxMode::Devkit).unwrap().unwrap();
        let found = boxes.iter().find(|b| b.annotation == golden["annotation_token"].as_str().unwrap()).unwrap();
        let cam = (view.world_from_ego * view.ego_from_cam).inverse() * found.world_from_box.translation;
        let pixel = view.camera().unwrap().project(cam).unwrap();
        let want = DVec2::new(golden["u_px"].as_f64().unwrap(), golden["v_px"].as_f64().unwrap());
        // The golden has integer pixel centres; the tables hold centres rounded to 1 mm in each axis.
        let want = want + DVec2::splat(0.5);
        assert!(
            (pixel - want).length() < view.intrinsics.fx * 1e-3 / cam.z,
            "{pixel} instead of {want} in {}",
            golden["filename"]
        );
        let edit = geometry::ImageEdit::identity(3, 3);
        let shift = geometry::ImageEdit { img_from_raw: DMat3::from_translation(-(want.floor() - DVec2::ONE)), ..edit };
        let patch = view.image.as_ref().unwrap().load(&shift).unwrap();
        let mean = |channel: usize| patch.pixels().map(|pixel| f64::from(pixel.0[channel])).sum::<f64>() / 9.0;
        let want: [f64; 3] = floats(&golden["image_rgb_3x3_mean"]);
        for channel in 0..3 {
            // The golden's decoder may round chroma differently.
            assert!((mean(channel) - want[channel]).abs() < 3.0, "{:?} instead of {want:?}", [0, 1, 2].map(mean));
        }
    }
}

#[test]
fn boxes_between_samples_agree_with_the_devkit() {
    let Some(path) = golden_folder("rigid/boxes_12hz.json") else { return };
    let golden = json(&path);
    let folder = tempfile::tempdir().unwrap();
    let dataset = open(&write_golden_tables(&golden, folder.path()));
    let all = frames(&dataset);
    let pictures = golden["frames"].as_array().unwrap();
    for picture in pictures {
        let time_ns = picture["timestamp_us"].as_i64().unwrap() * 1000;
        let index = all.iter().position(|frame| frame.views[0].timestamp_ns == time_ns).unwrap();
        let boxes = dataset.picture_boxes(index, 0, BoxMode::Devkit).unwrap().unwrap();
        let want = picture["boxes"].as_array().unwrap();
        assert_eq!(boxes.len(), want.len());
        for (found, want) in boxes.iter().zip(want) {
            assert_eq!(found.track, want["instance"].as_str().unwrap());
            close(&found.world_from_box.translation.to_array(), &want["center"], 1e-9, "centre");
            let [width, length, height] = floats(&want["size_wlh"]);
            assert_eq!(found.size, DVec3::new(length, width, height));
            let matrix = found.world_from_box.rotation_matrix().transpose().to_cols_array_2d();
            for (row, want) in matrix.iter().zip(want["R"].as_array().unwrap()) {
                close(row, want, 3e-5, "rotation");
            }
        }
    }
}

/// One camera whose pictures are those of the golden file.
fn write_golden_tables(golden: &Value, root: &Path) -> NuScenesConfig {
    let mut tables = Tables::new();
    let samples = golden["samples"].as_array().unwrap();
    let times: Vec<i64> = samples.iter().map(|row| row["timestamp_us"].as_i64().unwrap()).collect();
    tables.scene("s", &times);
    tables.0.get_mut("sample_data").unwrap().retain(|row| row["token"].as_str().unwrap().contains("LIDAR"));
    let number = |token: &Value| samples.iter().position(|row| row["token"] == *token).unwrap();
    for picture in golden["frames"].as_array().unwrap() {
        let time_us = picture["timestamp_us"].as_i64().unwrap();
        let is_key = picture["is_key_frame"].as_bool().unwrap();
        tables.picture("s", "CAM_FRONT", number(&picture["sample"]), time_us, is_key);
    }
    for row in golden["annotations"].as_array().unwrap() {
        let instance = row["instance_token"].as_str().unwrap();
        let sample = number(&row["sample_token"]);
        tables.annotate("s", sample, instance, "vehicle.car", floats(&row["translation"]), 0.0);
        let made = tables.0.get_mut("sample_annotation").unwrap().last_mut().unwrap();
        made["size"] = row["size"].clone();
        made["rotation"] = row["rotation"].clone();
    }
    NuScenesConfig { frames: FrameChoice::all_pictures(), ..tables.write(root) }
}
