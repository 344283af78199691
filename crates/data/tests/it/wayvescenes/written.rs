//! The writer: the way there and back, identical bytes, refusals.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use data::wayvescenes::{Scale, TimeUnit, WayveScenes, WayveScenesConfig};
use data::{
    DataError, ImageSource, SceneDataset, SceneFrame, WayveScenesManifest, WayveScenesWriterConfig, colmap,
    store::Store, write_wayvescenes,
};
use geometry::glam::DVec3;
use geometry::{Lens, RigPreset};
use tempfile::TempDir;

use super::made::{FRAMES, SCENES, TEXT, frames as made_frames, write};
use super::{fixture, frames, frames_of, open, world_from_cam};

/// Written once for all tests that only read.
static WRITTEN: LazyLock<(TempDir, Vec<SceneFrame>, WayveScenesManifest)> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let frames = made_frames(RigPreset::WayveScenes101);
    let manifest = write(&dir.path().join("set"), &frames, |config| config.units_per_metre = 0.31);
    (dir, frames, manifest)
});

fn root() -> PathBuf {
    WRITTEN.0.path().join("set")
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut open) = (BTreeMap::new(), vec![folder.to_owned()]);
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

/// Views of both lists are the same cameras at the same places of one world, which may be moved as a whole.
fn assert_same_poses(written: &[SceneFrame], read: &[SceneFrame], tolerance: f64) {
    assert_eq!(written.len(), read.len());
    let ours_from_theirs = world_from_cam(&read[0].views[0]) * world_from_cam(&written[0].views[0]).inverse();
    for (a, b) in written.iter().zip(read) {
        assert_eq!((&a.id.scene, a.timestamp_ns), (&b.id.scene, b.timestamp_ns));
        for (a, b) in a.views.iter().zip(&b.views) {
            assert_eq!((&a.channel, a.timestamp_ns), (&b.channel, b.timestamp_ns));
            assert_eq!((a.intrinsics, a.lens), (b.intrinsics, b.lens));
            let (want, got) = (ours_from_theirs * world_from_cam(a), world_from_cam(b));
            let off = (got.translation.distance(want.translation), got.angle_to(&want));
            assert!(off.0 < tolerance && off.1 < tolerance, "{} is off by {off:?}", a.channel);
        }
    }
}

#[test]
fn what_is_written_is_read() {
    let (_, frames, manifest) = &*WRITTEN;
    let dataset = open(&WayveScenesConfig::new(root()));
    assert_eq!((dataset.len(), dataset.scenes().len()), (SCENES * FRAMES, SCENES));
    for (info, row) in dataset.scenes().iter().zip(&manifest.scenes) {
        assert_eq!((&info.name, &info.region, row.text.as_deref()), (&row.name, &row.region, Some(TEXT)));
        // The preset's distances are those of the cars in the US, rounded.
        assert_eq!(info.region.as_deref(), Some("us"));
        assert!((info.metres_per_unit * 0.31 - 1.0).abs() < 1e-9);
        assert!((info.camera_height_m - 1.42).abs() < 1e-6 && info.ground_points.unwrap() > 40, "{info:?}");
        let written: Vec<SceneFrame> = frames.iter().filter(|f| f.id.scene == info.name).cloned().collect();
        let read = frames_of(&dataset, info);
        assert_same_poses(&written, &read, 1e-6);
        for (a, b) in written.iter().zip(&read) {
            assert_eq!((b.scene_text.as_deref(), b.boxes.is_none()), (Some(TEXT), true));
            // Only the place of the ego's origin differs: below the forward camera instead of at the rear axle.
            let moved = b.views[0].ego_from_cam * a.views[0].ego_from_cam.inverse();
            assert!(moved.translation.distance(DVec3::new(-1.75, 0.2, 0.0)) < 1e-6, "{moved:?}");
            assert!(moved.rotation.w.abs() > 1.0 - 1e-9);
        }
    }
}

#[test]
fn pictures_come_back_but_for_the_codec() {
    let read = frames(&open(&WayveScenesConfig::new(root())));
    for (a, b) in WRITTEN.1.iter().zip(&read).flat_map(|(a, b)| a.views.iter().zip(&b.views)) {
        assert!(b.mask.is_none());
        let (a, b) = (a.image.as_ref().unwrap().decode().unwrap(), b.image.as_ref().unwrap().decode().unwrap());
        let total: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        assert!(
            (total as f64) < 4.0 * a.as_raw().len() as f64,
            "mean difference {}",
            total as f64 / a.as_raw().len() as f64
        );
    }
}

#[test]
fn the_model_is_consistent() {
    let store = Store::open(root()).unwrap();
    for row in &WRITTEN.2.scenes {
        let folder = format!("{}/colmap_sparse/rig", row.name);
        let model = colmap::Model::read(&store, &folder, colmap::Detail::Whole).unwrap();
        assert_eq!((model.cameras.len(), model.images.len()), (5, 5 * FRAMES));
        let mut links = 0;
        for point in &model.points {
            for element in &point.track {
                let image = model.images.iter().find(|image| image.id == element.image_id).unwrap();
                let camera = model.cameras.iter().find(|camera| camera.id == image.camera_id).unwrap();
                let lens = geometry::Camera::new(camera.intrinsics(), camera.model.lens()).unwrap();
                let seen = lens.project(image.cam_from_world().unwrap() * DVec3::from_array(point.xyz)).unwrap();
                let feature = image.points[element.point2d_index as usize];
                assert_eq!(feature.point3d_id, Some(point.id));
                assert!(seen.distance(feature.xy.into()) < 1e-6 && camera.intrinsics().contains(seen));
                links += 1;
            }
        }
        assert_eq!(links, model.images.iter().map(|image| image.points.len()).sum::<usize>());
        assert!(links > 400, "{links}");
    }
}

#[test]
fn two_runs_give_identical_bytes_on_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let config =
        WayveScenesWriterConfig { units_per_metre: 0.31, ..WayveScenesWriterConfig::new(dir.path().join("b")) };
    let mut calls = vec![];
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let manifest =
        pool.install(|| write_wayvescenes(&config, &WRITTEN.1, &mut |done, total| calls.push((done, total))));
    let expected = WayveScenesManifest { config: config.clone(), ..WRITTEN.2.clone() };
    assert_eq!(manifest.unwrap(), expected);
    assert!(files(&root()) == files(&config.out));
    let total = SCENES * FRAMES * 5;
    assert_eq!(calls.last(), Some(&(total, total)));
    let read: WayveScenesManifest =
        serde_json::from_slice(&std::fs::read(root().join("manifest.json")).unwrap()).unwrap();
    let bare = WayveScenesWriterConfig { out: PathBuf::new(), ..config };
    assert_eq!(read, WayveScenesManifest { config: bare, ..WRITTEN.2.clone() });
    assert_eq!((read.picture_count, read.copied_pictures, read.mask_count), (total, 0, 0));
    assert_eq!(read.scenes[0].frames.len(), FRAMES);
    assert_eq!(read.sha256.len(), 3 * SCENES + 2);
}

#[test]
fn nothing_is_overwritten_and_nothing_is_left_behind() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("set");
    let few = &WRITTEN.1[..1];
    write(&out, few, |_| {});
    let before = files(&out);
    let again = WayveScenesWriterConfig::new(&out);
    let error = write_wayvescenes(&again, few, &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, DataError::Config(_)) && error.to_string().contains("exists already"), "{error}");
    assert!(files(&out) == before);
    write(&out, few, |config| (config.force, config.jpeg_quality) = (true, 40));
    assert!(files(&out) != before);
    std::fs::remove_file(out.join("manifest.json")).unwrap();
    let forced = WayveScenesWriterConfig { force: true, ..again };
    assert!(write_wayvescenes(&forced, few, &mut |_, _| {}).is_err(), "a foreign folder is never replaced");
    // A picture that cannot be read: the run fails and leaves nothing.
    let mut lost = few.to_vec();
    lost[0].views[3].image = Some(ImageSource::File { file: dir.path().join("absent.jpg").into(), size: (128, 72) });
    let elsewhere = WayveScenesWriterConfig::new(dir.path().join("other"));
    let error = write_wayvescenes(&elsewhere, &lost, &mut |_, _| {}).unwrap_err();
    assert!(matches!(error, DataError::Frame { .. }) && error.to_string().ends_with("absent.jpg"), "{error}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn the_fixtures_survive_the_way_through_the_writer() {
    let Some(config) = fixture(|_| {}) else { return };
    let dir = tempfile::tempdir().unwrap();
    let first = frames(&open(&config));
    let manifest = write(&dir.path().join("set"), &first, |config| config.time_unit = TimeUnit::Microseconds);
    assert_eq!((manifest.picture_count, manifest.copied_pictures, manifest.mask_count), (35, 35, 35));
    let regions: Vec<Option<&str>> = manifest.scenes.iter().map(|scene| scene.region.as_deref()).collect();
    assert_eq!(regions, [Some("us"), Some("uk")]);
    let again = open(&WayveScenesConfig::new(dir.path().join("set")));
    for (info, scene) in again.scenes().iter().zip(["scene_901", "scene_902"]) {
        let written: Vec<SceneFrame> = first.iter().filter(|frame| frame.id.scene == scene).cloned().collect();
        let read = frames_of(&again, info);
        assert_same_poses(&written, &read, 1e-6);
        assert!((info.metres_per_unit - 1.0).abs() < 1e-9 && (info.camera_height_m - 1.42).abs() < 0.02, "{info:?}");
        for (a, b) in written.iter().zip(&read).flat_map(|(a, b)| a.views.iter().zip(&b.views)) {
            let bytes = |source: &Option<ImageSource>| match source {
                Some(ImageSource::File { file, .. }) => file.bytes().unwrap(),
                _ => panic!("no file"),
            };
            assert!(bytes(&a.image) == bytes(&b.image), "pictures are copied");
            let grey = |source: &Option<ImageSource>| source.as_ref().unwrap().decode().unwrap();
            assert!(grey(&a.mask) == grey(&b.mask), "{}", a.channel);
            let png = bytes(&b.mask);
            assert_eq!((png[24], png[25]), (8, 0), "8-bit grey");
        }
    }
}

#[test]
fn another_rig_is_written_under_native_names() {
    let frames = made_frames(RigPreset::NuScenes);
    let dir = tempfile::tempdir().unwrap();
    let config = WayveScenesWriterConfig::new(dir.path().join("set"));
    let error = write_wayvescenes(&config, &frames, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("no picture of front-forward") && error.contains("channels"), "{error}");
    let names = [("CAM_FRONT", "front-forward"), ("CAM_FRONT_LEFT", "left-forward")];
    write(&config.out, &frames, |config| {
        config.channels = names.map(|(from, to)| (from.to_owned(), to.to_owned())).into();
    });
    let dataset = open(&WayveScenesConfig::new(&config.out));
    let read = super::frames(&dataset);
    assert_eq!((read.len(), dataset.max_views()), (SCENES * FRAMES, 6));
    let mut renamed = frames;
    renamed.iter_mut().flat_map(|frame| &mut frame.views).for_each(|view| {
        if let Some((_, to)) = names.iter().find(|(from, _)| *from == view.channel) {
            view.channel = (*to).to_owned();
        }
    });
    for scene in dataset.scenes() {
        assert_eq!(scene.region.as_deref(), Some("rig_1"));
        let of_scene: Vec<SceneFrame> = renamed.iter().filter(|f| f.id.scene == scene.name).cloned().collect();
        assert_same_poses(&of_scene, &frames_of(&dataset, &scene), 1e-6);
    }
    assert!(read.iter().flat_map(|frame| &frame.views).all(|view| view.lens == Lens::Pinhole));
}

type Change = dyn Fn(&mut WayveScenesWriterConfig, &mut Vec<SceneFrame>);

#[test]
fn frames_the_layout_cannot_hold_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let refuse = |change: &Change| {
        let (mut config, mut frames) = (WayveScenesWriterConfig::new(dir.path().join("set")), WRITTEN.1.clone());
        change(&mut config, &mut frames);
        let error = write_wayvescenes(&config, &frames, &mut |_, _| {}).unwrap_err();
        assert!(std::fs::read_dir(dir.path()).unwrap().next().is_none());
        error.to_string()
    };
    const K3: Lens = Lens::BrownConrady { k: [-0.1, 0.0, 0.01], p: [0.0; 2] };
    let cases: [(&str, &Change); 10] = [
        ("no frames", &|_, frames| frames.clear()),
        ("sixth order", &|_, frames| frames[2].views[1].lens = K3),
        ("scene name", &|_, frames| frames[1].id.scene = "../away".into()),
        ("channel", &|_, frames| frames[1].views[2].channel = "a/b".into()),
        ("write them apart", &|_, frames| frames[1].id.dataset = "another".into()),
        ("second picture", &|_, frames| frames[1] = frames[0].clone()),
        ("cannot be written", &|_, frames| frames[0].views[4].timestamp_ns = -7),
        ("time_unit", &|config, _| config.time_unit = TimeUnit::Infer),
        ("jpeg_quality", &|config, _| config.jpeg_quality = 0),
        ("units_per_metre", &|config, _| config.units_per_metre = -1.0),
    ];
    for (word, change) in cases {
        let text = refuse(change);
        assert!(text.contains(word), "{text:?} does not say {word:?}");
    }
}

#[test]
fn absent_pictures_and_single_cameras_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let mut frames = WRITTEN.1[..FRAMES].to_vec();
    frames[1].views[0].image = None;
    frames[2].views[3].image = None;
    let set = dir.path().join("holes");
    write(&set, &frames, |_| {});
    let config = WayveScenesConfig::new(&set);
    let read = super::frames(&open(&config));
    let absent: Vec<(usize, usize)> = (0..FRAMES)
        .flat_map(|f| (0..5).map(move |v| (f, v)))
        .filter(|(f, v)| read[*f].views[*v].image.is_none())
        .collect();
    assert_eq!(absent, [(1, 0), (2, 3)]);
    // The car is known without the forward camera's picture, too.
    let from_first =
        |frames: &[SceneFrame]| (frames[0].world_from_ego.inverse() * frames[1].world_from_ego).translation;
    let moved = read[0].views[0].ego_from_cam * frames[0].views[0].ego_from_cam.inverse();
    let way = moved.rotation.inverse() * from_first(&read);
    assert!((way.length() - from_first(&frames).length()).abs() < 0.05, "{way}");
    let whole = open(&WayveScenesConfig { require_all_views: true, ..config });
    assert_eq!(whole.len(), FRAMES - 2);
    for frame in &mut frames {
        frame.views.truncate(1);
        frame.views[0].image = WRITTEN.1[0].views[0].image.clone();
        frame.scene_text = Some("a long way home".into());
    }
    let set = dir.path().join("one");
    let manifest = write(&set, &frames, |_| {});
    assert_eq!((&manifest.scenes[0].region, manifest.scenes[0].text.as_deref()), (&None, Some("a long way home")));
    let config = WayveScenesConfig::new(&set);
    assert!(WayveScenes::open(&config).unwrap_err().to_string().contains("no camera has a known baseline"));
    let single = open(&WayveScenesConfig { scale: Scale::MetresPerUnit(1.0), ..config });
    assert_eq!((single.len(), single.max_views()), (FRAMES, 1));
    assert_eq!(single.frame(0).unwrap().scene_text, None, "the table of tags has no place for other words");
}
