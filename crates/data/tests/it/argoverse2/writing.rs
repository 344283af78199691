//! The writer: identical bytes, exact types, and our reader gets back what was written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use data::argoverse2::{Argoverse2, Argoverse2Config, FrameChoice, Split};
use data::{
    Argoverse2Log, Argoverse2WriterConfig, DataError, ObjectBox, ObjectClass, Procedural, ProceduralConfig, RigSource,
    SceneDataset, SceneFrame, write_argoverse2,
};
use geometry::glam::{DQuat, DVec3};
use geometry::{Box3d, RigPreset, Rigid};

use super::{LOG, fixture, frames, image_path, open, tables};

fn quiet() -> impl FnMut(usize, usize) {
    |_, _| {}
}

fn procedural() -> Procedural {
    let config = ProceduralConfig {
        scenes: 2,
        frames_per_scene: 3,
        seed: 11,
        rig: RigSource::Preset(RigPreset::Argoverse2),
        ..ProceduralConfig::default()
    };
    Procedural::open(&config).unwrap()
}

fn config(out: PathBuf) -> Argoverse2WriterConfig {
    Argoverse2WriterConfig {
        image_scale: 0.05,
        lidar_columns: 90,
        ..Argoverse2WriterConfig::new(out, "procedural world, seed 11")
    }
}

fn worlds(dataset: &Procedural) -> Vec<Argoverse2Log> {
    [(0, Split::Train), (1, Split::Val)]
        .map(|(scene, split)| Argoverse2Log::of_procedural(dataset, scene, split).unwrap())
        .to_vec()
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn close(a: &Rigid, b: &Rigid) {
    assert!(a.translation.distance(b.translation) < 1e-12 && a.angle_to(b) < 1e-12, "{a:?} instead of {b:?}");
}

#[test]
fn procedural_worlds_come_back_and_two_runs_are_identical() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = procedural();
    let mut calls = Vec::new();
    let out = folder.path().join("set");
    let manifest = write_argoverse2(&config(out.clone()), &worlds(&dataset), &mut |a, b| calls.push((a, b))).unwrap();
    assert_eq!((manifest.picture_count, calls.last()), (42, Some(&(42, 42))));
    let other = folder.path().join("again");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    pool.install(|| write_argoverse2(&config(other.clone()), &worlds(&dataset), &mut quiet()).unwrap());
    let (first, second) = (files(&out), files(&other));
    assert!(first == second, "the runs differ");
    let text: serde_json::Value = serde_json::from_slice(&first[Path::new("manifest.json")]).unwrap();
    assert_eq!(text["scenes"][1]["source_scene"], "scene-0001");
    assert_eq!(text["sha256"].as_object().unwrap().len(), 2 * 7);

    let back = open(&Argoverse2Config::new(&out));
    assert_eq!(back.logs().iter().map(|log| log.split.unwrap()).collect::<Vec<_>>(), ["train", "val"]);
    assert_eq!(back.len(), 6);
    for (got, want) in frames(&back).iter().zip(frames(&dataset)) {
        same_world_frame(got, &want);
    }
    let local = back.local_map(0, 40.0).unwrap();
    assert!(!local.lines.is_empty() && !local.areas.is_empty());
    let world = dataset.world(0);
    assert_eq!(back.city_map(0).unwrap(), data::argoverse2::Argoverse2Map::from_world(world.map()));
    let car = dataset.frame(0).unwrap().world_from_ego.translation;
    assert_eq!(back.ground_height(0).unwrap().at(car.truncate()), Some(0.0));
}

fn same_world_frame(got: &SceneFrame, want: &SceneFrame) {
    assert_eq!(got.timestamp_ns, want.timestamp_ns);
    close(&got.world_from_ego, &want.world_from_ego);
    for (view, other) in got.views.iter().zip(&want.views) {
        assert_eq!((&view.channel, view.timestamp_ns), (&other.channel, other.timestamp_ns));
        close(&view.ego_from_cam, &other.ego_from_cam);
        close(&view.world_from_ego, &other.world_from_ego);
        let edit = geometry::ImageEdit::identity(other.intrinsics.width, other.intrinsics.height);
        let edit = edit.resize(view.intrinsics.width, view.intrinsics.height);
        let scaled = edit.intrinsics(&other.intrinsics);
        assert!((scaled.cx - view.intrinsics.cx).abs() < 1e-9 && (scaled.fy - view.intrinsics.fy).abs() < 1e-9);
        let (picture, exact) =
            (view.image.as_ref().unwrap().decode().unwrap(), other.image.as_ref().unwrap().load(&edit).unwrap());
        let pairs = picture.as_raw().iter().zip(exact.as_raw());
        let mean = pairs.map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / exact.as_raw().len() as f64;
        assert!(mean < 6.0, "{} differs by {mean}", view.channel);
    }
    let (boxes, other) = (got.boxes.as_ref().unwrap(), want.boxes.as_ref().unwrap());
    assert_eq!(boxes.len(), other.len());
    let mut counted = 0;
    for (found, other) in boxes.iter().zip(other) {
        assert!(found.box3d.center.distance(other.box3d.center) < 1e-12 && found.box3d.size == other.box3d.size);
        assert!(geometry::wrap_angle(found.box3d.yaw - other.box3d.yaw).abs() < 1e-12);
        assert_eq!(found.track, other.track);
        match other.class {
            ObjectClass::ConstructionVehicle => assert_eq!(found.class, ObjectClass::Truck),
            ObjectClass::Barrier => assert_eq!(found.class, ObjectClass::Other),
            class => assert_eq!(found.class, class),
        }
        counted += found.points.unwrap();
    }
    assert!(counted > 0, "the lidar met no box");
}

#[test]
fn the_real_log_comes_back_with_the_release_types() {
    let Some(root) = fixture("argoverse2") else { return };
    let folder = tempfile::tempdir().unwrap();
    let source = open(&Argoverse2Config::new(&root));
    let log = Argoverse2Log::of_argoverse2(&source, 0, Split::Val).unwrap();
    let out = folder.path().join("set");
    let manifest = write_argoverse2(&Argoverse2WriterConfig::new(&out, "copy"), &[log], &mut quiet()).unwrap();
    assert_eq!(manifest.scenes[0].log, LOG);
    let back = open(&Argoverse2Config { name: source.name().to_owned(), ..Argoverse2Config::new(&out) });
    let (ours, theirs) = (frames(&back), frames(&source));
    assert_eq!(ours.len(), 3);
    for (at, (got, want)) in ours.iter().zip(&theirs).enumerate() {
        assert_eq!(got.id, want.id);
        close(&got.world_from_ego, &want.world_from_ego);
        for (view, other) in got.views.iter().zip(&want.views) {
            assert_eq!((view.timestamp_ns, view.intrinsics), (other.timestamp_ns, other.intrinsics));
            close(&view.world_from_ego, &other.world_from_ego);
            close(&view.ego_from_cam, &other.ego_from_cam);
            let bytes = |view: &data::View| std::fs::read(image_path(view.image.as_ref()).unwrap()).unwrap();
            assert!(bytes(view) == bytes(other), "the picture was encoded anew");
        }
        for (found, other) in got.boxes.iter().flatten().zip(want.boxes.iter().flatten()) {
            let velocity = if at == 1 { other.velocity } else { found.velocity };
            let box3d = Box3d { yaw: other.box3d.yaw, ..found.box3d };
            assert!((found.box3d.yaw - other.box3d.yaw).abs() < 1e-12);
            let near = |a: Option<[f64; 2]>, b: Option<[f64; 2]>| match (a, b) {
                (Some(a), Some(b)) => (a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 1e-6,
                // A track of three annotations may end here.
                (a, b) => a == b || a.is_none() || b.is_none(),
            };
            assert!(near(found.velocity, velocity));
            assert_eq!(ObjectBox { box3d, velocity: other.velocity, ..found.clone() }, *other);
        }
    }
    assert_eq!(back.city_map(0).unwrap(), source.city_map(0).unwrap());
    assert_eq!(format!("{:?}", back.ground_height(0).unwrap()), format!("{:?}", source.ground_height(0).unwrap()));
    assert_eq!(back.logs()[0].city.as_deref(), Some("PIT"));
    let (release, written) = (root.join("sensor/val").join(LOG), out.join("val").join(LOG));
    for table in [
        "annotations",
        "city_SE3_egovehicle",
        "calibration/intrinsics",
        "calibration/egovehicle_SE3_sensor",
        "sensors/lidar/315966265259836000",
    ] {
        let file = format!("{table}.feather");
        assert_eq!(tables::types(&written.join(&file)), tables::types(&release.join(&file)), "{table}");
    }
    let npy =
        |folder: &Path| std::fs::read(folder.join(format!("map/{LOG}_ground_height_surface____PIT.npy"))).unwrap();
    assert!(npy(&release) == npy(&written), "the ground height file differs");
}

/// A car that drives and turns past one that drives straight on, at 10 Hz, with two cameras one nanosecond apart.
fn drive() -> Argoverse2Log {
    let dataset = procedural();
    let mut log = Argoverse2Log::of_scene(&dataset, 0, Split::Train).unwrap();
    let template = log.frames[0].clone();
    let start = template.timestamp_ns;
    log.frames = (0..5)
        .map(|step| {
            let time_ns = start + step * 100_000_000;
            let world_from_ego = |time_ns: i64| {
                let secs = (time_ns - start) as f64 * 1e-9;
                Rigid { rotation: DQuat::from_rotation_z(0.5 * secs), translation: DVec3::new(5.0 * secs, 0.1, 1.0) }
            };
            let mut frame =
                SceneFrame { timestamp_ns: time_ns, world_from_ego: world_from_ego(time_ns), ..template.clone() };
            frame.id.frame = step.to_string();
            frame.views.truncate(2);
            for (at, view) in frame.views.iter_mut().enumerate() {
                view.timestamp_ns = time_ns - 7_000_000 + at as i64;
                view.world_from_ego = world_from_ego(view.timestamp_ns);
            }
            let secs = step as f64 * 0.1;
            let object = |class: &str, world: DVec3, track: &str| ObjectBox {
                box3d: Box3d {
                    center: frame.world_from_ego.inverse() * world,
                    size: DVec3::new(2.0, 1.0, 1.5),
                    yaw: 3.1,
                },
                class: ObjectClass::Car,
                track: track.to_owned(),
                source_class: class.to_owned(),
                velocity: None,
                attributes: Vec::new(),
                points: None,
                visibility: None,
                interpolated: false,
            };
            let place = DVec3::new(20.0 + 3.0 * secs, 4.0 - 2.0 * secs, 1.0);
            let mut boxes =
                vec![object("BICYCLE", place, "wheels"), object("BICYCLIST", place + DVec3::Z * 0.3, "rider")];
            if step == 2 {
                boxes.push(object("BICYCLIST", place + DVec3::X * 9.0, "alone"));
            }
            frame.boxes = Some(boxes);
            frame
        })
        .collect();
    log
}

#[test]
fn stamps_a_nanosecond_apart_velocities_and_riders_survive() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let log = drive();
    let config = Argoverse2WriterConfig { lidar_columns: 0, ..config(out.clone()) };
    write_argoverse2(&config, std::slice::from_ref(&log), &mut quiet()).unwrap();
    let poses = tables::integers(
        &out.join("train").join(&open(&Argoverse2Config::new(&out)).logs()[0].name).join("city_SE3_egovehicle.feather"),
        "timestamp_ns",
    );
    assert_eq!(poses.len(), 15);
    assert!(poses.windows(2).any(|pair| pair[1] - pair[0] == 1));
    let all = frames(&open(&Argoverse2Config::new(&out)));
    for (got, want) in all.iter().zip(&log.frames) {
        for (view, other) in got.views.iter().zip(&want.views) {
            assert_eq!(view.timestamp_ns, other.timestamp_ns);
            close(&view.world_from_ego, &other.world_from_ego);
        }
        let expected = got.world_from_ego.inverse().transform_vector(DVec3::new(3.0, -2.0, 0.0));
        for found in got.boxes.as_ref().unwrap() {
            assert_eq!(found.points, None);
            match (found.track.as_str(), found.velocity) {
                ("alone", velocity) => assert_eq!(velocity, None),
                (_, Some([x, y])) => assert!((x - expected.x).abs() < 1e-6 && (y - expected.y).abs() < 1e-6),
                _ => panic!("{} has no velocity", found.track),
            }
        }
    }
    let merged = open(&Argoverse2Config { merge_riders: true, ..Argoverse2Config::new(&out) });
    let tracks: Vec<Vec<String>> = frames(&merged)
        .into_iter()
        .map(|frame| frame.boxes.unwrap().into_iter().map(|found| found.track).collect())
        .collect();
    assert_eq!(tracks, [vec!["wheels"], vec!["wheels"], vec!["wheels", "alone"], vec!["wheels"], vec!["wheels"]]);
}

#[test]
fn without_annotations_there_is_no_table_and_every_set_is_a_frame() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let mut log = drive();
    log.split = Split::Test;
    log.frames.iter_mut().for_each(|frame| frame.boxes = None);
    write_argoverse2(&config(out.clone()), &[log], &mut quiet()).unwrap();
    for choice in [FrameChoice::Annotated, FrameChoice::AllPictures] {
        let dataset = open(&Argoverse2Config { frames: choice, ..Argoverse2Config::new(&out) });
        assert!(!dataset.capabilities().boxes);
        assert_eq!(frames(&dataset).iter().map(|frame| frame.boxes.is_none()).collect::<Vec<_>>(), [true; 5]);
    }
    // Without sweeps the pictures alone make the sets.
    let name = open(&Argoverse2Config::new(&out)).logs()[0].name.clone();
    std::fs::remove_dir_all(out.join("test").join(&name).join("sensors/lidar")).unwrap();
    let dataset = open(&Argoverse2Config::new(&out));
    assert_eq!(dataset.len(), 5);
    assert!(frames(&dataset).iter().all(|frame| frame.views.iter().all(|view| view.image.is_some())));
    assert!(matches!(
        Argoverse2::open(&Argoverse2Config { split: Split::Val, ..Argoverse2Config::new(&out) }),
        Err(DataError::Empty { .. })
    ));
}

#[test]
fn what_the_layout_cannot_hold_is_refused_and_leaves_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("set");
    let refused = |change: fn(&mut Argoverse2Log)| {
        let mut log = drive();
        change(&mut log);
        write_argoverse2(&config(out.clone()), &[log], &mut quiet()).unwrap_err().to_string()
    };
    assert!(refused(|log| log.frames.clear()).contains("no frames"));
    assert!(refused(|log| log.split = Split::All).contains("split"));
    assert!(refused(|log| log.city = "../x".into()).contains("city"));
    assert!(refused(|log| log.frames.reverse()).contains("does not follow"));
    assert!(refused(|log| log.frames[1].views[0].intrinsics.fx += 1.0).contains("another rig"));
    assert!(refused(|log| log.frames[0].views[1].timestamp_ns -= 1).contains("two different poses"));
    let lens = geometry::Lens::KannalaBrandt { k: [0.0; 4] };
    let with_lens = |log: &mut Argoverse2Log, lens| log.frames.iter_mut().for_each(|frame| frame.views[0].lens = lens);
    let mut log = drive();
    with_lens(&mut log, lens);
    let error = write_argoverse2(&config(out.clone()), &[log], &mut quiet()).unwrap_err();
    assert!(error.to_string().contains("pinhole"), "{error}");
    assert!(
        refused(|log| log.frames.iter_mut().for_each(|f| f.views[0].channel = "CAM_FRONT".into())).contains("channels")
    );
    let twice = write_argoverse2(&config(out.clone()), &[drive(), drive()], &mut quiet()).unwrap_err();
    assert!(twice.to_string().contains("two logs"), "{twice}");
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);

    write_argoverse2(&config(out.clone()), &[drive()], &mut quiet()).unwrap();
    let again = write_argoverse2(&config(out.clone()), &[drive()], &mut quiet()).unwrap_err();
    assert!(again.to_string().contains("exists already"), "{again}");
    write_argoverse2(&Argoverse2WriterConfig { force: true, ..config(out.clone()) }, &[drive()], &mut quiet()).unwrap();
    std::fs::remove_file(out.join("manifest.json")).unwrap();
    let foreign =
        write_argoverse2(&Argoverse2WriterConfig { force: true, ..config(out.clone()) }, &[drive()], &mut quiet());
    assert!(foreign.unwrap_err().to_string().contains("not written by rigscape"));
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
}
