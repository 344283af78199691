//! What the reader makes of tables whose content the test knows.

use data::nuscenes::{BoxMode, ClassRule, FrameChoice, NuScenes, NuScenesConfig, PictureTime};
use data::{DataError, ObjectClass, SceneDataset, SceneFrame};
use geometry::glam::DVec3;
use serde_json::json;

use super::made::{CAMERAS, START_US, Tables, car_x};
use super::{frames, image_path, open};

const NS: i64 = 1000;

/// Opens tables with a changed config.
fn open_with(tables: &Tables, change: impl FnOnce(&mut NuScenesConfig)) -> Result<NuScenes, DataError> {
    let folder = tempfile::tempdir().unwrap();
    let mut config = tables.write(folder.path());
    change(&mut config);
    NuScenes::open(&config)
}

fn all_pictures(config: &mut NuScenesConfig) {
    config.frames = FrameChoice::all_pictures();
}

fn devkit_boxes(config: &mut NuScenesConfig) {
    config.frames = FrameChoice::AllPictures { pairing_window_ms: 25.0, boxes: BoxMode::Devkit };
}

/// Samples at 0, 450 and 950 ms, sweeps of every camera on the lidar grid of real data, without the turns in `lost`.
fn uneven(lost: &[(&str, i64)]) -> Tables {
    let mut tables = Tables::new();
    tables.scene("scene-0001", &[START_US, START_US + 450_000, START_US + 950_000]);
    for (sample, turns) in [(1, vec![100, 200, 250, 350]), (2, vec![550, 650, 700, 800, 900])] {
        for turn in turns {
            for (channel, _, offset) in CAMERAS {
                if !lost.contains(&(channel, turn)) {
                    tables.picture("scene-0001", channel, sample, START_US + turn * 1000 + offset, false);
                }
            }
        }
    }
    tables
}

/// Milliseconds from the start to the lidar turn a picture was taken in, and the channel.
fn turn_ms(channel: &str, timestamp_ns: i64) -> f64 {
    let offset = CAMERAS.iter().find(|camera| camera.0 == channel).unwrap().2;
    (timestamp_ns / NS - offset - START_US) as f64 / 1000.0
}

fn turns(frame: &SceneFrame) -> Vec<Option<i64>> {
    let turn =
        |view: &data::View| view.image.as_ref().map(|_| turn_ms(&view.channel, view.timestamp_ns).round() as i64);
    frame.views.iter().map(turn).collect()
}

#[test]
fn pictures_of_one_lidar_turn_make_a_frame() {
    let lost = [("CAM_BACK_LEFT", 200), ("CAM_FRONT_RIGHT", 650), ("CAM_FRONT_RIGHT", 700)];
    let dataset = open_with(&uneven(&lost), all_pictures).unwrap();
    let found = frames(&dataset);
    let want = [0, 100, 200, 250, 350, 450, 550, 650, 700, 800, 900, 950];
    assert_eq!(found.len(), want.len());
    for (frame, want) in found.iter().zip(want) {
        assert_eq!(frame.timestamp_ns, (START_US + want * 1000) * NS);
        let channels: Vec<&str> = frame.views.iter().map(|view| view.channel.as_str()).collect();
        assert_eq!(channels, ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_LEFT"], "clockwise from the front");
        for (view, turn) in frame.views.iter().zip(turns(frame)) {
            let is_lost = lost.contains(&(view.channel.as_str(), want));
            assert_eq!(turn, (!is_lost).then_some(want), "{} at {want} ms", view.channel);
            // Every picture, also a missing one, has the car's pose at its own instant.
            let x = car_x(view.timestamp_ns / NS);
            assert!((view.world_from_ego.translation.x - x).abs() < 1e-6, "{} at {want} ms", view.channel);
        }
        assert!((frame.world_from_ego.translation.x - car_x(frame.timestamp_ns / NS)).abs() < 1e-6);
    }
    let whole = open_with(&uneven(&lost), |config| {
        all_pictures(config);
        config.require_all_views = true;
    });
    assert_eq!(whole.unwrap().len(), want.len() - 3);
    assert_eq!(open_with(&uneven(&lost), |_| {}).unwrap().len(), 3);
}

#[test]
fn key_frames_take_the_lidar_pose_and_each_picture_its_own() {
    let tables = uneven(&[]);
    let dataset = open_with(&tables, |_| {}).unwrap();
    for (frame, ms) in frames(&dataset).iter().zip([0, 450, 950]) {
        let sample_us = START_US + ms * 1000;
        assert_eq!(frame.timestamp_ns, sample_us * NS);
        assert_eq!(frame.world_from_ego.translation, DVec3::new(car_x(sample_us), 50.0, 0.0));
        for view in &frame.views {
            let moved = view.ref_ego_from_cam(&frame.world_from_ego).translation.x - view.ego_from_cam.translation.x;
            let want = car_x(view.timestamp_ns / NS) - car_x(sample_us);
            assert!((moved - want).abs() < 1e-9 && want < 0.0);
        }
        let front = &frame.views[0];
        assert!((front.ego_from_cam.transform_vector(DVec3::Z) - DVec3::X).length() < 1e-9);
        assert_eq!((front.intrinsics.cx, front.intrinsics.cy), (320.0, 200.0), "pixel centres at +0.5");
        let path = image_path(front.image.as_ref()).unwrap();
        let stamp = front.timestamp_ns / NS;
        assert!(path.ends_with(format!("samples/CAM_FRONT/n900__CAM_FRONT__{stamp}.jpg")), "{}", path.display());
    }
}

#[test]
fn without_a_lidar_the_reference_is_never_extrapolated() {
    let mut tables = uneven(&[]);
    tables.0.get_mut("sample_data").unwrap().retain(|row| !row["token"].as_str().unwrap().contains("LIDAR"));
    for (choice, interpolates) in [(FrameChoice::KeyFrames, false), (FrameChoice::all_pictures(), true)] {
        let dataset = open_with(&tables, |config| config.frames = choice).unwrap();
        let found = frames(&dataset);
        for frame in &found {
            let x = car_x(frame.timestamp_ns / NS);
            assert!((frame.world_from_ego.translation.x - x).abs() < 1e-6, "stamp and pose agree");
        }
        let second = found.iter().find(|frame| frame.id.frame == "scene-0001-sample-1").unwrap();
        let sample_ns = (START_US + 450_000) * NS;
        // Among key pictures only, the next pose is half a second away; the last picture of the turn lies 0.5 ms before.
        let want = if interpolates { sample_ns } else { sample_ns - 500 * NS };
        assert_eq!(second.timestamp_ns, want);
        let last = found.last().unwrap();
        assert_eq!(last.timestamp_ns, (START_US + 949_500) * NS, "nothing lies behind the last picture");
    }
}

/// Three samples; one object in all of them, one only in the second and third, one only in the first, one without the second.
fn tracks() -> Tables {
    let mut tables = uneven(&[]);
    for (sample, x) in [(0, 110.0), (1, 111.0), (2, 113.0)] {
        tables.annotate(
            "scene-0001",
            sample,
            "always",
            "vehicle.car",
            [x, 52.0, 0.8],
            3.1 + 0.1 * f64::from(sample as u8),
        );
        if sample != 0 {
            tables.annotate("scene-0001", sample, "late", "vehicle.car", [x, 60.0, 0.8], 0.0);
        }
        if sample != 1 {
            tables.annotate("scene-0001", sample, "hole", "human.pedestrian.adult", [x, 40.0, 0.8], 0.0);
        }
    }
    tables.annotate("scene-0001", 0, "early", "animal", [100.0, 45.0, 0.3], 0.0);
    tables
}

fn names(frame: &SceneFrame) -> Vec<&str> {
    let mut names: Vec<&str> = frame.boxes.as_ref().unwrap().iter().map(|found| found.track.as_str()).collect();
    names.sort_unstable();
    names
}

#[test]
fn boxes_between_samples_follow_the_mode() {
    let both = frames(&open_with(&tracks(), all_pictures).unwrap());
    let devkit = frames(&open_with(&tracks(), devkit_boxes).unwrap());
    // Frames 0, 5 and 11 are the samples.
    for found in [&both, &devkit] {
        assert_eq!(names(&found[0]), ["always", "early", "hole"]);
        assert_eq!(names(&found[5]), ["always", "late"]);
        assert_eq!(names(&found[11]), ["always", "hole", "late"]);
        assert!(found[0].boxes.as_ref().unwrap().iter().all(|b| !b.interpolated));
    }
    assert_eq!(names(&both[2]), ["always"]);
    assert_eq!(names(&devkit[2]), ["always", "late"]);
    assert_eq!(names(&both[7]), ["always", "late"]);
    assert_eq!(names(&devkit[7]), ["always", "hole", "late"]);
    let always = &both[2].boxes.as_ref().unwrap()[0];
    let amount: f64 = 200.0 / 450.0;
    let want = 110.0 + amount - car_x(START_US + 200_000);
    assert!((always.box3d.center.x - want).abs() < 1e-6 && (always.box3d.center.y - 2.0).abs() < 1e-9);
    assert!((geometry::wrap_angle(always.box3d.yaw - (3.1 + 0.1 * amount))).abs() < 1e-9, "the short way across pi");
    assert!(always.interpolated);
    assert!((always.velocity.unwrap()[0] - 1.0 / 0.45).abs() < 1e-9);
    assert_eq!(
        (always.box3d.size.x, always.box3d.size.y, always.points, always.visibility),
        (4.5, 1.9, Some(7), Some(3))
    );
    assert_eq!(
        (always.attributes.as_slice(), always.class),
        (["vehicle.moving".to_owned()].as_slice(), ObjectClass::Car)
    );
}

#[test]
fn pictures_before_the_first_sample_have_boxes_only_in_devkit_mode() {
    let mut tables = tracks();
    for (channel, _, offset) in CAMERAS {
        tables.picture("scene-0001", channel, 0, START_US - 100_000 + offset, false);
    }
    let both = open_with(&tables, all_pictures).unwrap();
    assert_eq!(both.len(), 13);
    assert!(both.frame(0).unwrap().boxes.is_none());
    let devkit = open_with(&tables, devkit_boxes).unwrap();
    assert_eq!(names(&devkit.frame(0).unwrap()), ["always", "early", "hole"]);
}

#[test]
fn velocities_come_from_track_neighbours() {
    let mut tables = Tables::new();
    let times: Vec<i64> = (0..8).map(|at| START_US + at * 500_000).collect();
    tables.scene("scene-0001", &times);
    let mut track = |name: &str, samples: &[usize]| {
        for sample in samples {
            tables.annotate("scene-0001", *sample, name, "vehicle.car", [200.0 + *sample as f64, 50.0, 0.8], 0.0);
        }
    };
    track("whole", &[0, 1, 2]);
    track("alone", &[0]);
    track("bridged", &[0, 1, 4, 5]);
    track("far", &[0, 4, 7]);
    let dataset = open_with(&tables, |_| {}).unwrap();
    let velocity = |sample: usize, name: &str| {
        let boxes = dataset.frame(sample).unwrap().boxes.unwrap();
        boxes.iter().find(|found| found.track == name).unwrap().velocity.map(|v| (v[0] * 1e6).round() / 1e6)
    };
    assert_eq!([0, 1, 2].map(|sample| velocity(sample, "whole")), [Some(2.0); 3]);
    assert_eq!(velocity(0, "alone"), None);
    assert_eq!(
        [0, 1, 4, 5].map(|sample| velocity(sample, "bridged")),
        [Some(2.0); 4],
        "2 s and 2.5 s two-sided are allowed"
    );
    assert_eq!([0, 4, 7].map(|sample| velocity(sample, "far")), [None, None, Some(2.0)], "2 s, 3.5 s and 1.5 s");
}

#[test]
fn classes_are_known_dropped_or_refused() {
    let mut tables = tracks();
    tables.row("category", "category animal")["name"] = json!("vehicle.hovercraft");
    let error = open_with(&tables, |_| {}).unwrap_err();
    assert!(matches!(&error, DataError::UnknownClass { name, .. } if name == "vehicle.hovercraft"), "{error:?}");
    let rule = |rule: ClassRule| {
        let change = |config: &mut NuScenesConfig| _ = config.classes.insert("vehicle.hovercraft".to_owned(), rule);
        open_with(&tables, change).unwrap().frame(0).unwrap()
    };
    assert_eq!(names(&rule(ClassRule::Drop)), ["always", "hole"]);
    let kept = rule(ClassRule::As(ObjectClass::Truck));
    let early = kept.boxes.as_ref().unwrap().iter().find(|found| found.track == "early").unwrap();
    assert_eq!((early.class, early.source_class.as_str()), (ObjectClass::Truck, "vehicle.hovercraft"));
    // A category without boxes needs no rule.
    tables.0.get_mut("sample_annotation").unwrap().retain(|row| row["instance_token"] != "early");
    open_with(&tables, |_| {}).unwrap();
}

#[test]
fn unannotated_and_empty_differ() {
    let mut tables = tracks();
    let annotations = tables.0.get_mut("sample_annotation").unwrap();
    annotations.retain(|row| row["sample_token"] != "scene-0001-sample-1");
    annotations[0]["visibility_token"] = json!("");
    annotations[0]["attribute_tokens"] = json!([]);
    let dataset = open_with(&tables, |_| {}).unwrap();
    assert!(dataset.capabilities().boxes);
    assert_eq!(dataset.frame(1).unwrap().boxes, Some(Vec::new()));
    let first = &dataset.frame(0).unwrap().boxes.unwrap()[0];
    assert_eq!((first.visibility, first.attributes.len()), (None, 0));
    tables.0.get_mut("sample_annotation").unwrap().clear();
    let dataset = open_with(&tables, |_| {}).unwrap();
    assert!(!dataset.capabilities().boxes);
    assert!(frames(&dataset).iter().all(|frame| frame.boxes.is_none()));
}

#[test]
fn tokens_of_every_form_load() {
    let text = serde_json::to_string(&uneven(&[]).0).unwrap();
    let forms = [
        "0123456789abcdef0123456789abcdef",
        "0123456789ABCDEF0123456789ABCDEF",
        "0123456789abcdef0123456789abcdef1",
        "0123456789abcdef0123456789abcdef0123456789abcdef0123456789abcdef",
        "9f1c0e4e-53aa-4a3b-a2a4-7f7c1f3f5a11",
        "q\\\"u\\u00fcote",
    ];
    for form in forms {
        let renamed = text.replace("scene-0001-sample-1", form);
        let rows: std::collections::BTreeMap<String, Vec<serde_json::Value>> = serde_json::from_str(&renamed).unwrap();
        let mut tables = Tables::new();
        tables.0.iter_mut().for_each(|(name, old)| *old = rows[*name].clone());
        let dataset = open_with(&tables, |_| {}).unwrap();
        let want: String = serde_json::from_str(&format!("\"{form}\"")).unwrap();
        assert_eq!(dataset.frame(1).unwrap().id.frame, want);
    }
    // The same digits in another case name another row.
    let mixed = text.replacen("scene-0001-sample-1", forms[0], 1).replace("scene-0001-sample-1", forms[1]);
    let rows: std::collections::BTreeMap<String, Vec<serde_json::Value>> = serde_json::from_str(&mixed).unwrap();
    let mut tables = Tables::new();
    tables.0.iter_mut().for_each(|(name, old)| *old = rows[*name].clone());
    assert!(matches!(open_with(&tables, |_| {}), Err(DataError::Dangling { .. })));
}

#[test]
fn quaternions_are_w_first_and_their_sign_means_nothing() {
    let mut tables = uneven(&[]);
    let half = 0.5f64.sqrt();
    for (row, sign) in tables.0.get_mut("ego_pose").unwrap().iter_mut().zip([1.0, -1.0].into_iter().cycle()) {
        row["rotation"] = json!([sign * half, 0.0, 0.0, sign * half]);
    }
    for frame in frames(&open_with(&tables, all_pictures).unwrap()) {
        for pose in frame.views.iter().map(|view| view.world_from_ego).chain([frame.world_from_ego]) {
            assert!(pose.transform_vector(DVec3::X).abs_diff_eq(DVec3::Y, 1e-9));
        }
    }
}

#[test]
fn selections_pick_scenes_cameras_and_frames() {
    let mut tables = Tables::new();
    for name in ["scene-0916", "scene-0103", "scene-0061"] {
        tables.scene(name, &[START_US, START_US + 500_000]);
    }
    // A second rig: what is true of one scene must not leak into another.
    tables.row("calibrated_sensor", "c-scene-0103-CAM_FRONT")["translation"] = json!([2.5, 0.0, 1.0]);
    let scenes = |change: fn(&mut NuScenesConfig)| -> Vec<String> {
        open_with(&tables, change).unwrap().scenes().into_iter().map(|scene| scene.name).collect()
    };
    assert_eq!(scenes(|_| {}), ["scene-0916", "scene-0103", "scene-0061"], "in the table's order");
    assert_eq!(scenes(|config| config.split = "mini_val".into()), ["scene-0103", "scene-0916"], "in the split's order");
    assert_eq!(
        scenes(|config| config.scenes = vec!["scene-0061".into(), "scene-0916".into()]),
        ["scene-0061", "scene-0916"]
    );
    let dataset = open_with(&tables, |_| {}).unwrap();
    let mounting = |index: usize| dataset.frame(index).unwrap().rig().cameras[0].ego_from_cam.translation.x;
    assert_eq!([0, 2, 4].map(mounting), [1.5, 2.5, 1.5]);
    assert_eq!((dataset.max_views(), dataset.len()), (3, 6));
    assert_eq!(dataset.scenes()[1].frames, 2..4);
    let one = open_with(&tables, |config| config.cameras = vec!["CAM_FRONT_RIGHT".into()]).unwrap();
    assert_eq!(one.frame(0).unwrap().views.len(), 1);
    let fewer = open_with(&tables, |config| config.exclude = vec!["scene-0103-sample-1".into()]).unwrap();
    assert_eq!(fewer.len(), 5);
    let refused = |change: fn(&mut NuScenesConfig)| open_with(&tables, change).unwrap_err();
    assert!(matches!(refused(|config| config.split = "test".into()), DataError::Empty { .. }));
    assert!(matches!(refused(|config| config.split = "vall".into()), DataError::Config(_)));
    assert!(matches!(refused(|config| config.scenes = vec!["scene-0002".into()]), DataError::Empty { .. }));
    assert!(matches!(refused(|config| config.cameras = vec!["LIDAR_TOP".into()]), DataError::Config(_)));
    assert!(matches!(refused(|config| config.version = "v1.0-test".into()), DataError::Missing { .. }));
}

#[test]
fn float_stamps_are_read_and_the_exposure_wins_unless_asked_otherwise() {
    let mut tables = uneven(&[]);
    for row in tables.0.get_mut("sample_data").unwrap() {
        row["timestamp"] = json!(row["timestamp"].as_i64().unwrap() as f64 + 1500.5);
    }
    let first = |time: PictureTime| {
        let dataset = open_with(&tables, |config| config.timestamps = time).unwrap();
        dataset.frame(0).unwrap().views[0].clone()
    };
    let exposure = START_US * NS - 35_500_000;
    let (real, written) = (first(PictureTime::RealTime), first(PictureTime::AsWritten));
    assert_eq!(real.timestamp_ns, exposure);
    assert_eq!(written.timestamp_ns, exposure + 1_500_500);
    assert_eq!(real.world_from_ego, written.world_from_ego);
    assert_eq!(
        image_path(real.image.as_ref()).unwrap().file_name(),
        image_path(written.image.as_ref()).unwrap().file_name()
    );
}

#[test]
fn unusual_and_usual_file_names_survive() {
    let mut tables = uneven(&[]);
    let token = format!("scene-0001 CAM_FRONT {}", START_US - 35_500);
    tables.row("sample_data", &token)["filename"] = json!("other/front 1+2.jpeg");
    let folder = tempfile::tempdir().unwrap();
    let dataset = open(&tables.write(folder.path()));
    let frame = dataset.frame(0).unwrap();
    assert!(image_path(frame.views[0].image.as_ref()).unwrap().ends_with("other/front 1+2.jpeg"));
    let stamp = START_US - 27_600;
    let usual = format!("samples/CAM_FRONT_RIGHT/n900__CAM_FRONT_RIGHT__{stamp}.jpg");
    assert_eq!(image_path(frame.views[1].image.as_ref()).unwrap(), folder.path().join(usual));
}
