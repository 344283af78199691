//! The writer: identical bytes, no debris, and the reader gives back what was written.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::LazyLock;

use data::nuplan::{NuPlan, NuPlanConfig};
use data::{
    DataError, ImageSource, NuPlanManifest, NuPlanWriterConfig, ObjectBox, ObjectClass, SceneFrame, View, write_nuplan,
};
use geometry::glam::DVec3;
use geometry::{CameraRig, ImageEdit, Intrinsics, Lens, RigPreset, Rigid};

use super::made::{Made, SIZE, world_frames, writer};
use super::{frames, open};
use crate::nuscenes::folder;

fn quiet() -> impl FnMut(usize, usize) {
    |_, _| {}
}

/// Written bytes by path inside the folder.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut open = vec![root.to_owned()];
    while let Some(folder) = open.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
                all.insert(name, std::fs::read(path).unwrap());
            }
        }
    }
    all
}

fn by_track(frame: &SceneFrame) -> BTreeMap<&str, &ObjectBox> {
    frame.boxes.as_ref().unwrap().iter().map(|found| (found.track.as_str(), found)).collect()
}

fn same_pose(got: &Rigid, want: &Rigid) {
    assert!(got.translation.distance(want.translation) < 2e-9, "{got:?} instead of {want:?}");
    assert!(got.angle_to(want) < 1e-12, "{got:?} instead of {want:?}");
}

/// The pose of one frame's ego in another's: free of the place of the world's origin.
fn relative(frame: &SceneFrame, pose: &Rigid) -> Rigid {
    frame.world_from_ego.inverse() * *pose
}

fn same_box(got: &ObjectBox, want: &ObjectBox) {
    assert!(got.box3d.center.distance(want.box3d.center) < 4e-9, "{got:?} instead of {want:?}");
    assert_eq!(got.box3d.size, want.box3d.size);
    assert!(geometry::wrap_angle(got.box3d.yaw - want.box3d.yaw).abs() < 1e-9, "{got:?} instead of {want:?}");
    match (got.velocity, want.velocity) {
        (Some(got), Some(want)) => assert!((got[0] - want[0]).hypot(got[1] - want[1]) < 1e-9),
        (got, want) => assert_eq!(got, want),
    }
}

#[test]
fn the_fixture_survives_bit_for_bit_where_the_layout_is_its_own() {
    let Some(root) = folder("RIGSCAPE_DATA", "nuplan") else { return };
    let want = frames(&open(&NuPlanConfig::new(root)));
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let config = NuPlanWriterConfig { utm_origin_m: [0.0; 2], ..NuPlanWriterConfig::new(out.clone()) };
    let manifest = write_nuplan(&want, &config, &mut quiet()).unwrap();
    assert_eq!(manifest.picture_count, 16);
    let got = frames(&open(&NuPlanConfig::new(out)));
    assert_eq!(got.len(), want.len());
    for (got, want) in got.iter().zip(&want) {
        assert_eq!((&got.id, got.timestamp_ns, &got.scene_text), (&want.id, want.timestamp_ns, &want.scene_text));
        same_pose(&got.world_from_ego, &want.world_from_ego);
        assert_eq!(got.boxes.as_ref().unwrap().len(), want.boxes.as_ref().unwrap().len());
        for (got, want) in got.boxes.iter().flatten().zip(want.boxes.iter().flatten()) {
            assert_eq!((&got.track, got.class, &got.source_class), (&want.track, want.class, &want.source_class));
            same_box(got, want);
        }
        assert_eq!(
            got.rig().cameras.iter().map(|c| &c.intrinsics).collect::<Vec<_>>(),
            want.rig().cameras.iter().map(|c| &c.intrinsics).collect::<Vec<_>>()
        );
        for (got, want) in got.views.iter().zip(&want.views) {
            assert_eq!((&got.channel, got.timestamp_ns, got.lens), (&want.channel, want.timestamp_ns, want.lens));
            same_pose(&got.world_from_ego, &want.world_from_ego);
            same_pose(&got.ego_from_cam, &want.ego_from_cam);
            let bytes = |view: &View| match view.image.as_ref().unwrap() {
                ImageSource::File { file, .. } => file.bytes().unwrap(),
                _ => panic!("a picture is no file"),
            };
            assert_eq!(bytes(got), bytes(want));
        }
    }
}

#[test]
fn plain_calibration_is_pickled_as_python_pickles_it() {
    let Some(root) = folder("RIGSCAPE_DATA", "nuplan") else { return };
    let dir = tempfile::tempdir().unwrap();
    let config = NuPlanWriterConfig { utm_origin_m: [0.0; 2], ..NuPlanWriterConfig::new(dir.path().join("set")) };
    write_nuplan(&frames(&open(&NuPlanConfig::new(&root))), &config, &mut quiet()).unwrap();
    let log = "nuplan-v1.1/splits/mini/2021.05.12.22.00.38_veh-35_01008_01518.db";
    let blobs = |root: &Path| -> Vec<[Vec<u8>; 3]> {
        let uri = format!("file:{}?mode=ro&immutable=1", root.join(log).display());
        let database = rusqlite::Connection::open(uri).unwrap();
        // The other cameras of the fixture are pickled in class form.
        let sql = "SELECT translation, intrinsic, distortion FROM camera WHERE channel IN ('CAM_F0', 'CAM_B0') ORDER BY channel";
        let mut statement = database.prepare(sql).unwrap();
        let rows = statement.query_map([], |row| Ok([row.get(0)?, row.get(1)?, row.get(2)?])).unwrap();
        rows.collect::<Result<_, _>>().unwrap()
    };
    assert_eq!(blobs(&config.out), blobs(&root));
}

#[test]
fn the_procedural_world_is_read_back() {
    let want = world_frames(2, 4);
    let made = Made::of(&want);
    let got = frames(&open(&made.config()));
    assert_eq!(got.len(), want.len());
    assert!(want.iter().any(|frame| frame.boxes.as_ref().unwrap().len() > 3));
    for (got, want) in got.iter().zip(&want) {
        assert_eq!((&got.id.scene, &got.scene_text), (&want.id.scene, &want.scene_text));
        // The layout counts microseconds.
        assert!((got.timestamp_ns - want.timestamp_ns).abs() <= 500);
        let moved = got.world_from_ego.translation - want.world_from_ego.translation;
        assert!(moved.abs_diff_eq(DVec3::new(664_000.0, 3_997_000.0, 0.0), 2e-9), "{moved}");
        let (ours, theirs) = (got.boxes.as_ref().unwrap(), want.boxes.as_ref().unwrap());
        assert_eq!(ours.len(), theirs.len());
        for theirs in theirs {
            let near = |b: &&ObjectBox| b.box3d.center.distance(theirs.box3d.center) < 1e-6;
            let ours = ours.iter().find(near).expect("a box is lost");
            same_box(ours, theirs);
            let motor = theirs.class.index() <= ObjectClass::Motorcycle.index();
            assert_eq!(ours.class, if motor { ObjectClass::Car } else { theirs.class });
        }
        assert_eq!(got.views.len(), 8);
        for (got_view, view) in got.views.iter().zip(&want.views) {
            assert_eq!((&got_view.channel, got_view.lens), (&view.channel, view.lens));
            let (i, k) = (&got_view.intrinsics, &view.intrinsics);
            assert_eq!((i.width, i.height), SIZE);
            assert!((i.fx - k.fx * 64.0 / 1920.0).abs() < 1e-12 && (i.cy - k.cy * 36.0 / 1080.0).abs() < 1e-12);
            same_pose(&relative(got, &got_view.world_from_ego), &relative(want, &view.world_from_ego));
            same_pose(&got_view.ego_from_cam, &view.ego_from_cam);
            let edit = ImageEdit::identity(1920, 1080).resize(SIZE.0, SIZE.1);
            let rendered = view.image.as_ref().unwrap().load(&edit).unwrap();
            let stored = got_view.image.as_ref().unwrap().decode().unwrap();
            let sum: u64 = rendered.as_raw().iter().zip(stored.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
            let mean = sum as f64 / rendered.as_raw().len() as f64;
            assert!(mean < 4.0, "{} differs by {mean} on average", view.channel);
        }
    }
}

#[test]
fn tracks_stay_tracks() {
    let want = world_frames(1, 3);
    let made = Made::of(&want);
    let got = frames(&open(&made.config()));
    let first = by_track(&want[0]);
    let again: Vec<&str> = by_track(&want[1]).keys().copied().filter(|track| first.contains_key(track)).collect();
    assert!(!again.is_empty());
    let place = |frame: &SceneFrame, center: DVec3| -> String {
        let near = |b: &&ObjectBox| b.box3d.center.distance(center) < 1e-6;
        frame.boxes.as_ref().unwrap().iter().find(near).unwrap().track.clone()
    };
    for track in again {
        let before = place(&got[0], first[track].box3d.center);
        assert_eq!(before, place(&got[1], by_track(&want[1])[track].box3d.center));
        assert_eq!(before.len(), 16);
    }
}

#[test]
fn coordinates_need_double_precision() {
    let want = world_frames(1, 2);
    let made = Made::of(&want);
    let got = frames(&open(&made.config()));
    let mut worst = 0.0_f64;
    for found in got
        .iter()
        .flat_map(|frame| frame.boxes.iter().flatten().map(move |found| frame.world_from_ego * found.box3d.center))
    {
        let single = DVec3::new(f64::from(found.x as f32), f64::from(found.y as f32), found.z);
        worst = worst.max(single.distance(found));
    }
    assert!(worst > 0.05, "f32 would have been good enough: {worst}");
}

#[test]
fn two_runs_give_the_same_bytes_and_the_manifest_names_the_source() {
    let source = world_frames(2, 2);
    let (a, b) = (Made::of(&source), Made::of(&source));
    let (a, b) = (files(&a.root()), files(&b.root()));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in &a {
        assert!(bytes == &b[name], "{name} differs");
    }
    let manifest: NuPlanManifest = serde_json::from_slice(&a["manifest.json"]).unwrap();
    assert_eq!((manifest.picture_count, manifest.scenes.len(), manifest.source.as_str()), (32, 2, "procedural"));
    assert_eq!(manifest.scenes[1].frames[1].source_frame, "0001");
    assert_eq!(
        manifest.sha256.keys().collect::<Vec<_>>(),
        ["nuplan-v1.1/splits/mini/scene-0000.db", "nuplan-v1.1/splits/mini/scene-0001.db"]
    );
    assert!(!String::from_utf8_lossy(&a["manifest.json"]).contains("/tmp"));
    let other = tempfile::tempdir().unwrap();
    let config = NuPlanWriterConfig { seed: 1, ..writer(other.path().join("set")) };
    write_nuplan(&source, &config, &mut quiet()).unwrap();
    let other = files(&other.path().join("set"));
    assert!(
        a.keys().filter(|name| name.ends_with(".jpg")).all(|name| !other.contains_key(name)),
        "tokens ignore the seed"
    );
}

#[test]
fn nothing_is_overwritten_and_failures_leave_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let frames = world_frames(1, 1);
    write_nuplan(&frames, &writer(out.clone()), &mut quiet()).unwrap();
    let error = write_nuplan(&frames, &writer(out.clone()), &mut quiet()).unwrap_err().to_string();
    assert!(error.contains("exists already"), "{error}");
    let mut seen = Vec::new();
    let forced = NuPlanWriterConfig { force: true, ..writer(out) };
    write_nuplan(&frames, &forced, &mut |done, all| seen.push((done, all))).unwrap();
    assert_eq!(seen.last(), Some(&(8, 8)));
    let mut broken = frames.clone();
    let absent = ImageSource::File { file: dir.path().join("absent.jpg").into(), size: (1920, 1080) };
    broken[0].views[3].image = Some(absent);
    let fresh = writer(dir.path().join("fresh"));
    assert!(matches!(write_nuplan(&broken, &fresh, &mut quiet()), Err(DataError::Missing { .. })));
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["set"]);
}

/// One camera that exposes with the reference instant; no pictures are needed where only rows count.
fn simple(time_ms: i64, x: f64, boxes: Option<Vec<ObjectBox>>) -> SceneFrame {
    static FRAME: LazyLock<SceneFrame> = LazyLock::new(|| world_frames(1, 1).remove(0));
    let mut frame = FRAME.clone();
    frame.timestamp_ns = 1_700_000_000_000_000_000 + time_ms * 1_000_000;
    frame.world_from_ego = Rigid::from_yaw(0.3, DVec3::new(x, 0.0, 0.0));
    frame.id.frame = time_ms.to_string();
    frame.boxes = boxes;
    frame.views.truncate(2);
    for (at, view) in frame.views.iter_mut().enumerate() {
        view.timestamp_ns = frame.timestamp_ns + at as i64 * 7_000_000;
        view.world_from_ego = Rigid::from_yaw(0.3, DVec3::new(x + 0.1 * at as f64, 0.0, 0.0));
    }
    frame
}

fn read(frames_to_write: &[SceneFrame]) -> (Made, NuPlan) {
    let made = Made::of(frames_to_write);
    let dataset = open(&made.config());
    (made, dataset)
}

#[test]
fn annotated_empty_and_unannotated_frames_differ() {
    let some = simple(0, 0.0, None);
    let boxes = |frame: &SceneFrame| frame.boxes.as_ref().map(Vec::len);
    let (_keep, none) = read(&[some.clone(), simple(100, 1.0, None)]);
    assert_eq!(frames(&none).iter().map(boxes).collect::<Vec<_>>(), [None, None]);
    assert_eq!(frames(&none)[1].timestamp_ns, simple(100, 1.0, None).timestamp_ns);
    let (_keep, empty) = read(&[simple(0, 0.0, Some(vec![])), simple(100, 1.0, Some(vec![]))]);
    assert_eq!(frames(&empty).iter().map(boxes).collect::<Vec<_>>(), [Some(0), Some(0)]);
    let (_keep, mixed) = read(&[some, simple(100, 1.0, Some(vec![])), simple(200, 2.0, None)]);
    assert_eq!(frames(&mixed).iter().map(boxes).collect::<Vec<_>>(), [None, Some(0), None]);
}

#[test]
fn a_picture_that_is_not_there_keeps_its_place_and_time() {
    let mut source = vec![simple(0, 0.0, None), simple(500, 4.0, None)];
    source[1].views[0].image = None;
    let (_keep, dataset) = read(&source);
    let got = frames(&dataset);
    assert_eq!(got.len(), 2);
    let view = got[1].views.iter().find(|view| view.channel == source[1].views[0].channel).unwrap();
    assert!(view.image.is_none());
    assert_eq!(view.timestamp_ns, source[1].views[0].timestamp_ns);
    same_pose(&relative(&got[1], &view.world_from_ego), &relative(&source[1], &source[1].views[0].world_from_ego));
}

#[test]
fn pinholes_other_channels_and_missing_velocities_survive() {
    let mut source = vec![simple(0, 0.0, None)];
    let found = ObjectBox {
        box3d: geometry::Box3d { center: DVec3::new(8.0, -2.0, 0.9), size: DVec3::new(4.5, 1.9, 1.6), yaw: -3.1 },
        class: ObjectClass::Bicycle,
        track: "some car".into(),
        source_class: "BICYCLE".into(),
        velocity: None,
        attributes: vec!["parked".into()],
        points: Some(3),
        visibility: Some(2),
        interpolated: true,
    };
    source[0].boxes = Some(vec![found.clone()]);
    for view in &mut source[0].views {
        view.lens = Lens::Pinhole;
    }
    let dir = tempfile::tempdir().unwrap();
    let mut config = writer(dir.path().join("set"));
    config.channels.insert(source[0].views[0].channel.clone(), "CAM_MINE".to_owned());
    write_nuplan(&source, &config, &mut quiet()).unwrap();
    let got = frames(&open(&NuPlanConfig::new(config.out))).remove(0);
    assert_eq!((got.views[0].channel.as_str(), got.views[0].lens), ("CAM_MINE", Lens::Pinhole));
    let back = &got.boxes.as_ref().unwrap()[0];
    same_box(back, &found);
    assert_eq!((back.class, back.source_class.as_str()), (ObjectClass::Bicycle, "bicycle"));
    assert_eq!(
        (back.attributes.len(), back.points, back.visibility),
        (0, None, None),
        "the layout has no place for them"
    );
}

#[test]
fn what_the_layout_cannot_hold_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |frames: &[SceneFrame], text: &str| {
        let error = write_nuplan(frames, &writer(dir.path().join("set")), &mut quiet()).unwrap_err();
        assert!(error.to_string().contains(text), "{error} does not say {text:?}");
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    };
    let change = |change: &dyn Fn(&mut [SceneFrame])| {
        let mut frames = vec![simple(0, 0.0, Some(vec![])), simple(100, 1.0, Some(vec![]))];
        change(&mut frames);
        frames
    };
    refused(&[], "empty");
    refused(
        &change(&|f| f[1].views[0].intrinsics = Intrinsics { fx: 1000.0, ..f[1].views[0].intrinsics }),
        "another calibration",
    );
    refused(&change(&|f| f[0].views[0].lens = Lens::KannalaBrandt { k: [0.0; 4] }), "fisheye");
    refused(&change(&|f| f[1].id.dataset = "other".into()), "procedural and from other");
    refused(&change(&|f| f.iter_mut().for_each(|f| f.id.scene = "../x".into())), "scene name");
    refused(&change(&|f| f[1].world_from_ego.translation.x = 9e6), "utm_origin_m");
    refused(&change(&|f| f[1].world_from_ego.translation.x = f64::NAN), "utm_origin_m");
    refused(&change(&|f| f[1].timestamp_ns += 60_000_000), "could not be told");
    refused(&[simple(0, 0.0, None), simple(3, 0.1, None)], "");
    let two = [simple(0, 0.0, None), simple(0, 1.0, None)];
    refused(&two, "");
    let mut config = writer(dir.path().join("set"));
    config.jpeg_quality = 0;
    assert!(write_nuplan(&change(&|_| {}), &config, &mut quiet()).unwrap_err().to_string().contains("jpeg_quality"));
    assert!(serde_json::from_str::<NuPlanWriterConfig>("{}").is_err());
}

#[test]
fn other_rigs_are_written_too() {
    let rig: CameraRig = RigPreset::Waymo.rig();
    let mut frame = simple(0, 0.0, None);
    let image = frame.views[0].image.clone();
    let (timestamp_ns, world_from_ego) = (frame.timestamp_ns, frame.world_from_ego);
    let view = |camera: &geometry::RigCamera| View {
        channel: camera.channel.clone(),
        timestamp_ns,
        image: image.clone(),
        mask: None,
        intrinsics: camera.intrinsics,
        lens: camera.lens,
        ego_from_cam: camera.ego_from_cam,
        world_from_ego,
    };
    frame.views = rig.cameras.iter().map(view).collect();
    let (_keep, dataset) = read(&[frame]);
    let got = frames(&dataset).remove(0).rig();
    assert_eq!(got.len(), 5);
    for camera in &got.cameras {
        let want = rig.cameras.iter().find(|want| want.channel == camera.channel).unwrap();
        same_pose(&camera.ego_from_cam, &want.ego_from_cam);
        assert_eq!(camera.lens, want.lens);
    }
}
