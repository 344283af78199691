//! The writer: what it writes reads back, byte for byte the same every time, and it never harms what is there.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use data::waymo::{Waymo, WaymoRelease};
use data::{
    DataError, ObjectClass, Procedural, ProceduralConfig, RigSource, SceneDataset, SceneFrame, WaymoManifest,
    WaymoWriterConfig, write_waymo,
};
use geometry::{ImageEdit, Lens, RigPreset};
use sha2::{Digest, Sha256};

use super::{assert_same, config, fixture, frames, made};

fn write(out: &Path, frames: &[SceneFrame]) -> Result<WaymoManifest, DataError> {
    write_waymo(&WaymoWriterConfig::new(out.to_owned()), frames, &mut |_, _| {})
}

fn open(out: &Path) -> Waymo {
    Waymo::open(&config(out, WaymoRelease::V2, "training")).unwrap()
}

/// All files of a folder by relative path.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Two procedural scenes seen by a small Waymo rig.
fn procedural(folder: &Path) -> Vec<SceneFrame> {
    let mut rig = RigPreset::Waymo.rig();
    for camera in &mut rig.cameras {
        let i = &mut camera.intrinsics;
        let edit = ImageEdit::identity(i.width, i.height).resize(96, i.height / 20);
        *i = edit.intrinsics(i);
    }
    let path = folder.join("rig.json");
    std::fs::write(&path, serde_json::to_vec(&rig).unwrap()).unwrap();
    let config = ProceduralConfig {
        seed: 3,
        scenes: 2,
        frames_per_scene: 11,
        rig: RigSource::File(path),
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config).unwrap();
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

#[test]
fn frames_of_both_releases_read_back_with_the_same_pictures() {
    let Some(datasets) = made() else { return };
    for dataset in &datasets {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("set");
        let original = frames(dataset);
        let manifest = write(&out, &original).unwrap();
        assert_eq!(
            (manifest.picture_count, manifest.scenes[0].frames.len(), &manifest.source[..]),
            (15, 3, &["waymo".to_owned()][..])
        );
        let written = open(&out);
        for (a, b) in original.iter().zip(&frames(&written)) {
            assert_same(a, b, 1e-9);
        }
        assert_eq!(contents(&out).len(), 6);
    }
}

#[test]
fn the_published_frame_reads_back() {
    let Some(root) = fixture("waymo/v1") else { return };
    let dataset = Waymo::open(&config(&root, WaymoRelease::V1, "validation")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("set"), &frames(&dataset)).unwrap();
    assert_same(&dataset.frame(0).unwrap(), &open(&dir.path().join("set")).frame(0).unwrap(), 1e-9);
}

#[test]
fn procedural_scenes_read_back_within_the_formats_precision() {
    let dir = tempfile::tempdir().unwrap();
    let original = procedural(dir.path());
    let mut calls = Vec::new();
    let settings = WaymoWriterConfig { seed: Some(3), ..WaymoWriterConfig::new(dir.path().join("set")) };
    let manifest = write_waymo(&settings, &original, &mut |done, total| calls.push((done, total))).unwrap();
    assert_eq!(calls, [(8, 22), (11, 22), (19, 22), (22, 22)]);
    assert_eq!((manifest.picture_count, manifest.config.seed, manifest.scenes.len()), (110, Some(3), 2));
    let written = open(&dir.path().join("set"));
    assert_eq!((written.len(), written.scene_ranges(), written.max_views()), (22, vec![0..11, 11..22], 5));
    let mut objects = 0;
    for (a, b) in original.iter().zip(&frames(&written)) {
        assert_eq!((&a.id.scene, &a.scene_text), (&b.id.scene, &b.scene_text));
        assert!((0..1000).contains(&(a.timestamp_ns - b.timestamp_ns)));
        assert!((a.world_from_ego.translation - b.world_from_ego.translation).length() < 1e-9);
        for (a, b) in a.views.iter().zip(&b.views) {
            assert_eq!(a.channel, b.channel, "the preset is in rig order");
            assert_eq!(a.lens, b.lens);
            assert!((a.timestamp_ns - b.timestamp_ns).abs() < 240);
            assert!((a.intrinsics.cx - b.intrinsics.cx).abs() + (a.intrinsics.fy - b.intrinsics.fy).abs() < 1e-12);
            assert!(a.ego_from_cam.angle_to(&b.ego_from_cam) < 1e-12);
            let [a, b] = [a, b].map(|view| view.image.as_ref().unwrap().decode().unwrap());
            assert_eq!(a.dimensions(), b.dimensions());
            let sum: u64 = a.as_raw().iter().zip(b.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
            assert!((sum as f64) < 6.0 * a.as_raw().len() as f64, "{sum}");
        }
        let (a, b) = (a.boxes.as_ref().unwrap(), b.boxes.as_ref().unwrap());
        assert_eq!(a.len(), b.len());
        for (a, b) in a.iter().zip(b) {
            assert_eq!((&a.track, a.box3d, a.points), (&b.track, b.box3d, b.points));
            let coarse = match a.class {
                ObjectClass::Pedestrian => ObjectClass::Pedestrian,
                ObjectClass::Bicycle => ObjectClass::Bicycle,
                ObjectClass::TrafficCone | ObjectClass::Barrier | ObjectClass::Animal => ObjectClass::Other,
                _ => ObjectClass::Car,
            };
            assert_eq!(b.class, coarse, "{}", a.source_class);
            let (a, b) = (a.velocity.unwrap(), b.velocity.unwrap());
            assert!((a[0] - b[0]).abs() + (a[1] - b[1]).abs() < 1e-9);
            objects += 1;
        }
    }
    assert!(objects > 50, "{objects}");
}

#[test]
fn two_runs_give_identical_bytes_and_the_manifest_knows_them() {
    let dir = tempfile::tempdir().unwrap();
    let frames = procedural(dir.path());
    let [a, b] = ["a", "b"].map(|name| {
        let out = dir.path().join(name);
        let pool = rayon_threads(if name == "a" { 1 } else { 4 });
        pool.install(|| write(&out, &frames)).unwrap();
        contents(&out)
    });
    assert_eq!(a, b);
    let manifest: WaymoManifest = serde_json::from_slice(&a[Path::new("manifest.json")]).unwrap();
    assert_eq!(manifest.sha256.len() + 1, a.len());
    for (name, want) in &manifest.sha256 {
        let sum: String = Sha256::digest(&a[Path::new(name)]).iter().map(|byte| format!("{byte:02x}")).collect();
        assert_eq!(sum, *want, "{name}");
    }
    assert_eq!(manifest.source, ["procedural"]);
}

fn rayon_threads(count: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap()
}

#[test]
fn nothing_is_overwritten_unless_told_and_nothing_is_left_of_a_failure() {
    let dir = tempfile::tempdir().unwrap();
    let frames = &procedural(dir.path())[..1];
    let out = dir.path().join("set");
    write(&out, frames).unwrap();
    let before = contents(&out);
    assert!(write(&out, frames).unwrap_err().to_string().contains("exists already"));
    assert_eq!(contents(&out), before);
    let forced = WaymoWriterConfig { force: true, jpeg_quality: 50, ..WaymoWriterConfig::new(out.clone()) };
    write_waymo(&forced, frames, &mut |_, _| {}).unwrap();
    assert_ne!(contents(&out), before);
    let mut broken = frames.to_vec();
    broken[0].views[0].image =
        Some(data::ImageSource::File { file: dir.path().join("absent.jpg").into(), size: (1, 1) });
    let error = write(&dir.path().join("other"), &broken).unwrap_err();
    assert!(error.to_string().ends_with("absent.jpg"), "{error}");
    let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    names.sort();
    assert_eq!(names, ["rig.json", "set"]);
}

#[test]
fn frames_that_the_layout_cannot_hold_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let sound = &procedural(dir.path())[..3];
    let refusal = |change: &dyn Fn(&mut Vec<SceneFrame>)| {
        let mut frames = sound.to_vec();
        change(&mut frames);
        let error = write(&dir.path().join("set"), &frames).unwrap_err();
        assert!(matches!(error, DataError::Config(_)), "{error:?}");
        error.to_string()
    };
    assert!(refusal(&|frames| frames.clear()).contains("no frames"));
    assert!(refusal(&|frames| frames.swap(0, 1)).contains("out of order"));
    assert!(refusal(&|frames| frames[1].boxes = None).contains("annotated in 2 of 3"));
    assert!(refusal(&|frames| frames[1].id.scene = "x".to_owned()).contains("occurs twice"));
    assert!(refusal(&|frames| frames.iter_mut().for_each(|f| f.id.scene = "../x".to_owned())).contains("may hold"));
    assert!(refusal(&|frames| frames[0].views[2].channel = "TOP".to_owned()).contains("TOP"));
    assert!(refusal(&|frames| frames[1].views[2].intrinsics.fx += 1.0).contains("calibration"));
    assert!(refusal(&|frames| frames[1].views[0].lens = Lens::KannalaBrandt { k: [0.0; 4] }).contains("fisheye"));
    assert!(refusal(&|frames| frames.iter_mut().for_each(|f| f.views.clear())).contains("no cameras"));
}

#[test]
fn other_rigs_need_names_and_unannotated_or_pictureless_frames_stay_so() {
    let dir = tempfile::tempdir().unwrap();
    let mut frames = procedural(dir.path())[..2].to_vec();
    for frame in &mut frames {
        frame.boxes = None;
        frame.scene_text = None;
        frame.views[0].channel = "behind".to_owned();
        frame.views[1].image = None;
        frame.views[2].lens = Lens::Pinhole;
    }
    let out = dir.path().join("set");
    let settings = WaymoWriterConfig {
        cameras: BTreeMap::from([("behind".to_owned(), "REAR".to_owned())]),
        ..WaymoWriterConfig::new(out.clone())
    };
    let manifest = write_waymo(&settings, &frames, &mut |_, _| {}).unwrap();
    assert_eq!((manifest.picture_count, manifest.sha256.len()), (8, 3));
    let written = open(&out);
    let frame = written.frame(1).unwrap();
    assert!(frame.boxes.is_none() && frame.scene_text.is_none());
    let view = |channel: &str| frame.views.iter().find(|view| view.channel == channel).unwrap();
    assert!(view("REAR").image.is_some() && view("FRONT_LEFT").image.is_none());
    assert_eq!(view("FRONT").lens, Lens::Pinhole);
    frames.iter_mut().for_each(|frame| frame.boxes = Some(Vec::new()));
    let out = dir.path().join("empty");
    write_waymo(&WaymoWriterConfig { out: out.clone(), ..settings }, &frames, &mut |_, _| {}).unwrap();
    assert_eq!(open(&out).frame(0).unwrap().boxes, Some(Vec::new()));
}
