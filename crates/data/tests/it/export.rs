//! Painted frames as native datasets, and histories with painted frames, read back by the readers.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use data::argoverse2::{Argoverse2, Argoverse2Config};
use data::export::{
    ExportConfig, ExportFormat, ExportManifest, Exported, Generator, HistoryConfig, LinkKind, conditioned, export,
    replace_history,
};
use data::layout::{Layout, LayoutClasses};
use data::nuscenes::{NuScenes, NuScenesConfig};
use data::{
    DataError, ImageSource, NuScenesWriterConfig, Procedural, ProceduralConfig, RigSource, SceneDataset, SceneFrame,
    write_nuscenes,
};
use geometry::{CameraRig, ImageEdit, RigPreset};
use image::{Rgb, RgbImage};
use world::WorldConfig;

/// What the painter paints; the cameras have other sizes.
const PAINTED: (u32, u32) = (32, 24);

fn small_rig(preset: RigPreset) -> CameraRig {
    let mut rig = preset.rig();
    rig.cameras.truncate(2);
    for camera in &mut rig.cameras {
        let raw = camera.intrinsics;
        camera.intrinsics = ImageEdit::identity(raw.width, raw.height).resize(64, 40).intrinsics(&raw);
    }
    rig
}

fn world(preset: RigPreset, name: &str) -> Procedural {
    let config = ProceduralConfig {
        name: name.to_owned(),
        scenes: 2,
        frames_per_scene: 3,
        rig: RigSource::Cameras(small_rig(preset)),
        world: WorldConfig { duration_secs: 1.5, ..WorldConfig::default() },
        ..ProceduralConfig::default()
    };
    Procedural::open(&config).unwrap()
}

/// A real-looking tree of four frames in two scenes.
fn tree(out: &Path) -> NuScenes {
    let config = NuScenesWriterConfig {
        scenes: 2,
        key_frames_per_scene: 3,
        lidar_columns: 0,
        ..NuScenesWriterConfig::new(out.to_owned(), small_rig(RigPreset::NuScenes))
    };
    write_nuscenes(&config, &mut |_, _| {}).unwrap();
    NuScenes::open(&NuScenesConfig::new(out, "v1.0-mini")).unwrap()
}

/// A smooth picture that depends on the frame and the view only.
fn picture(frame: usize, view: usize) -> RgbImage {
    let (width, height) = PAINTED;
    RgbImage::from_fn(width, height, |x, y| Rgb([(x * 4 + frame as u32 * 20) as u8, (y * 6) as u8, (view * 60) as u8]))
}

fn paint(index: usize, frame: &SceneFrame) -> Result<Vec<Option<RgbImage>>, DataError> {
    Ok((0..frame.views.len()).map(|view| Some(picture(index, view))).collect())
}

fn generator() -> Generator {
    Generator {
        model: "ramps".to_owned(),
        checkpoint_sha256: None,
        seed: 7,
        sampler: "none".to_owned(),
        guidance: Some(4.0),
        condition: "a test".to_owned(),
        edits: vec!["remove:car-1".to_owned()],
        config: serde_json::json!({"steps": 3}),
    }
}

fn run(source: &dyn SceneDataset, config: &ExportConfig<'_>) -> Exported {
    export(source, config, &mut paint, &mut |_, _| {}).unwrap()
}

fn whole(source: &dyn SceneDataset, config: &ExportConfig<'_>) -> ExportManifest {
    match run(source, config) {
        Exported::Whole(manifest) => *manifest,
        part => panic!("{part:?}"),
    }
}

/// Every file below a folder with its bytes; links are followed.
fn files(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let (mut found, mut folders) = (BTreeMap::new(), vec![root.to_owned()]);
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(root).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn check_pictures(frame: &SceneFrame, index: usize) {
    for (at, view) in frame.views.iter().enumerate() {
        let ImageSource::File { size, .. } = view.image.as_ref().unwrap() else { panic!("no file") };
        assert_eq!(*size, (view.intrinsics.width, view.intrinsics.height));
        let edit = ImageEdit::identity(size.0, size.1).resize(PAINTED.0, PAINTED.1);
        let small = view.image.as_ref().unwrap().load(&edit).unwrap();
        let off = small.as_raw().iter().zip(picture(index, at).as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(off.unwrap() < 30, "frame {index} view {at}: {off:?}");
    }
}

/// Poses, cameras and boxes of two frames: `tolerance` metres and pixels.
fn check_geometry(a: &SceneFrame, b: &SceneFrame, classes: &dyn Fn(&data::ObjectBox) -> bool) {
    assert!((a.world_from_ego.translation - b.world_from_ego.translation).length() < 1e-6);
    assert!(a.world_from_ego.angle_to(&b.world_from_ego) < 1e-9);
    let kept: Vec<_> = a.boxes.as_ref().unwrap().iter().filter(|found| classes(found)).collect();
    let back = b.boxes.as_ref().unwrap();
    assert_eq!(kept.len(), back.len());
    for found in kept {
        let near = |other: &&data::ObjectBox| (other.box3d.center - found.box3d.center).length() < 1e-6;
        let same = back.iter().find(near).unwrap();
        assert!((same.box3d.size - found.box3d.size).length() < 1e-9);
        assert!(geometry::wrap_angle(same.box3d.yaw - found.box3d.yaw).abs() < 1e-6);
        // The centres land on the same pixels of every camera.
        for (mine, theirs) in a.views.iter().map(|view| (view, b.views.iter().find(|v| v.channel == view.channel))) {
            let theirs = theirs.unwrap();
            let pixel = |view: &data::View, frame: &SceneFrame, center| {
                let cam_from_ego = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
                view.camera().unwrap().project(cam_from_ego * center)
            };
            let (p, q) = (pixel(mine, a, found.box3d.center), pixel(theirs, b, same.box3d.center));
            assert_eq!(p.is_some(), q.is_some());
            assert!(p.zip(q).is_none_or(|(p, q)| (p - q).length() < 0.5));
        }
    }
}

#[test]
fn tables_of_a_tree_are_kept_and_pictures_are_new() {
    let dir = tempfile::tempdir().unwrap();
    let source = tree(&dir.path().join("real"));
    let out = dir.path().join("made");
    let config = ExportConfig::new(&out, ExportFormat::NuScenesTables(&source), generator());
    let manifest = whole(&source, &config);
    assert_eq!((manifest.frames.len(), manifest.generator), (source.len(), generator()));
    let text = std::fs::read_to_string(out.join("generated.json")).unwrap();
    assert_eq!(serde_json::from_str::<ExportManifest>(&text).unwrap().frames, manifest.frames);
    assert!(text.contains("linear between pixel centres"), "the filter is declared");
    let made = NuScenes::open(&NuScenesConfig::new(&out, "v1.0-mini")).unwrap();
    for index in 0..source.len() {
        let (a, b) = (source.frame(index).unwrap(), made.frame(index).unwrap());
        assert_eq!((&a.id, &a.boxes, a.rig()), (&b.id, &b.boxes, b.rig()));
        check_pictures(&b, index);
    }
    assert!(!dir.path().join("made.frames").exists());
    let again = export(&source, &config, &mut paint, &mut |_, _| {}).unwrap_err().to_string();
    assert!(again.contains("exists already"), "{again}");
    whole(&source, &ExportConfig { force: true, ..config });
}

#[test]
fn frames_of_any_dataset_become_nuscenes_tables() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::Argoverse2, "streets");
    let out = dir.path().join("made");
    whole(&source, &ExportConfig::new(&out, ExportFormat::NuScenes, generator()));
    let made = NuScenes::open(&NuScenesConfig::new(&out, "v1.0-generated")).unwrap();
    assert_eq!((made.len(), made.scene_ranges()), (source.len(), source.scene_ranges()));
    for index in 0..source.len() {
        let (a, b) = (source.frame(index).unwrap(), made.frame(index).unwrap());
        assert!((a.timestamp_ns - b.timestamp_ns).abs() < 1000, "stamps are microseconds");
        check_geometry(&a, &b, &|_| true);
        check_pictures(&reordered(&b, &a), index);
    }
}

/// The views of `frame` in the order of `like`.
fn reordered(frame: &SceneFrame, like: &SceneFrame) -> SceneFrame {
    let view = |channel: &str| frame.views.iter().find(|view| view.channel == channel).unwrap().clone();
    SceneFrame { views: like.views.iter().map(|like| view(&like.channel)).collect(), ..frame.clone() }
}

#[test]
fn frames_of_any_dataset_become_argoverse2_logs() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::Argoverse2, "streets");
    let out = dir.path().join("made");
    whole(&source, &ExportConfig::new(&out, ExportFormat::Argoverse2, generator()));
    let made = Argoverse2::open(&Argoverse2Config::new(&out)).unwrap();
    assert_eq!(made.len(), source.len());
    let mut seen = 0;
    for back in (0..made.len()).map(|index| made.frame(index).unwrap()) {
        let index = (0..source.len()).find(|at| source.frame(*at).unwrap().timestamp_ns == back.timestamp_ns).unwrap();
        let frame = source.frame(index).unwrap();
        check_geometry(&frame, &back, &|_| true);
        check_pictures(&reordered(&back, &frame), index);
        seen += 1;
    }
    assert_eq!(seen, 6);
}

#[test]
fn any_split_into_shards_gives_the_same_files() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::Argoverse2, "streets");
    for format in [ExportFormat::NuScenes, ExportFormat::Argoverse2] {
        let (one, three) = (dir.path().join(format.name()), dir.path().join(format!("{}-3", format.name())));
        whole(&source, &ExportConfig::new(&one, format.clone(), generator()));
        for shard in ["3/3", "1/3", "2/3"] {
            let config = ExportConfig::new(&three, format.clone(), generator());
            let run = run(&source, &ExportConfig { shard: shard.parse().unwrap(), ..config });
            match shard {
                "2/3" => assert!(matches!(run, Exported::Whole(_))),
                "1/3" => assert_eq!(run, Exported::Part { finished: 4, frames: 6 }),
                _ => assert_eq!(run, Exported::Part { finished: 2, frames: 6 }),
            }
            assert_eq!(three.exists(), shard == "2/3", "the folder appears whole");
        }
        assert!(files(&one) == files(&three), "{}", format.name());
    }
}

#[test]
fn an_interrupted_export_goes_on_and_never_reads_half_a_frame() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::NuScenes, "streets");
    let out = dir.path().join("made");
    let config = ExportConfig::new(&out, ExportFormat::NuScenes, generator());
    let mut painted = Vec::new();
    let mut failing = |index: usize, frame: &SceneFrame| {
        painted.push(index);
        if index == 2 { Err(DataError::Config("the lights went out".into())) } else { paint(index, frame) }
    };
    let error = export(&source, &config, &mut failing, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("lights") && error.contains("frame"), "{error}");
    assert_eq!(painted, [0, 1, 2]);
    assert!(!out.exists());
    // What a killed run leaves: a frame under its temporary name.
    let half = dir.path().join("made.frames/.part-killed/frame");
    std::fs::create_dir_all(&half).unwrap();
    std::fs::write(half.join("00.jpg"), b"half").unwrap();

    let other = Generator { seed: 8, ..generator() };
    let other = ExportConfig::new(&out, ExportFormat::NuScenes, other);
    let error = export(&source, &other, &mut paint, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("seed: 7, now 8") && error.contains("made.frames"), "{error}");

    let mut painted = Vec::new();
    let mut counting = |index: usize, frame: &SceneFrame| {
        painted.push(index);
        paint(index, frame)
    };
    let end = export(&source, &config, &mut counting, &mut |_, _| {}).unwrap();
    assert!(matches!(end, Exported::Whole(_)));
    assert_eq!(painted, [2, 3, 4, 5], "finished frames are kept");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "nothing is left beside the dataset");
    let straight = dir.path().join("straight");
    whole(&source, &ExportConfig::new(&straight, ExportFormat::NuScenes, generator()));
    assert!(files(&out) == files(&straight));
}

#[test]
fn a_run_that_another_one_overtook_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::NuScenes, "streets");
    let out = dir.path().join("made");
    let config = ExportConfig::new(&out, ExportFormat::NuScenes, generator());
    let mut overtaken = |index: usize, frame: &SceneFrame| {
        if index == 1 {
            whole(&source, &config);
        }
        paint(index, frame)
    };
    let error = export(&source, &config, &mut overtaken, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("has finished it meanwhile"), "{error}");
    let before = files(&out);
    assert_eq!(before.keys().filter(|name| name.extension().is_some_and(|end| end == "jpg")).count(), 12);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn painters_and_settings_that_do_not_fit_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let source = world(RigPreset::NuScenes, "streets");
    let out = dir.path().join("made");
    let config = ExportConfig::new(&out, ExportFormat::Argoverse2, generator());
    let mut short = |_: usize, _: &SceneFrame| Ok(Vec::new());
    let error = export(&source, &config, &mut short, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("0 pictures for 2 views"), "{error}");
    let error = export(&source, &config, &mut paint, &mut |_, _| {}).unwrap_err().to_string();
    assert!(error.contains("no camera of the layout"), "nuScenes channels: {error}");
    let config = ExportConfig { jpeg_quality: 0, ..config };
    assert!(export(&source, &config, &mut paint, &mut |_, _| {}).unwrap_err().to_string().contains("jpeg_quality"));
}

#[test]
fn conditioning_boxes_replace_those_of_the_frame() {
    let source = world(RigPreset::NuScenes, "streets");
    let (classes, frame) = (LayoutClasses::nuscenes(), source.frame(0).unwrap());
    let layout = Layout::of_frame(&frame, &classes);
    let same = conditioned(&frame, &layout).boxes.unwrap();
    let mine = frame.boxes.as_ref().unwrap();
    assert_eq!(same.len(), layout.boxes.len());
    assert!(same.iter().all(|found| mine.contains(found)), "untouched boxes keep every word");
    let id = layout.boxes[0].id.clone();
    let edits = [format!("move:{id}:dx=3"), "add:bus:x=10,y=2,id=new".to_owned()].map(|text| text.parse().unwrap());
    let made = conditioned(&frame, &layout.edited(&edits, &classes).unwrap()).boxes.unwrap();
    assert_eq!(made.len(), same.len() + 1);
    assert_eq!(made.last().unwrap().track, "new");
    let moved = made[0].box3d.center - same[0].box3d.center;
    assert!((moved.x - 3.0).abs() < 1e-12 && made[0].velocity == same[0].velocity);
}

#[test]
fn histories_are_replaced_in_all_views_or_none_and_originals_stay() {
    let dir = tempfile::tempdir().unwrap();
    let real = tree(&dir.path().join("real"));
    let made = dir.path().join("made");
    whole(&real, &ExportConfig::new(&made, ExportFormat::NuScenesTables(&real), generator()));
    let made = NuScenes::open(&NuScenesConfig::new(&made, "v1.0-mini")).unwrap();
    let before = files(&dir.path().join("real"));
    let mut counts = Vec::new();
    for (share, link) in
        [(0.0, LinkKind::Symbolic), (0.5, LinkKind::Symbolic), (0.5, LinkKind::Hard), (1.0, LinkKind::Hard)]
    {
        let out = dir.path().join(format!("mixed-{share}-{link:?}"));
        let config = HistoryConfig { out: out.clone(), force: false, share, seed: 3, link };
        let manifest = replace_history(&real, &made, &config).unwrap();
        assert_eq!((manifest.past_frames, manifest.generator), (4, Some(generator())));
        let mixed = NuScenes::open(&NuScenesConfig::new(&out, "v1.0-mini")).unwrap();
        for range in mixed.scene_ranges() {
            for index in range.clone() {
                let (a, b) = (real.frame(index).unwrap(), mixed.frame(index).unwrap());
                assert_eq!((&a.id, &a.boxes, a.rig()), (&b.id, &b.boxes, b.rig()));
                let replaced = manifest.replaced.iter().any(|frame| frame.sample == a.id.frame);
                assert!(!(replaced && index + 1 == range.end), "the last frame is nobody's past");
                let from = if replaced { made.frame(index).unwrap() } else { a };
                let pixels = |frame: &SceneFrame, at: usize| frame.views[at].image.as_ref().unwrap().decode().unwrap();
                (0..b.views.len()).for_each(|at| assert_eq!(pixels(&b, at), pixels(&from, at)));
            }
        }
        assert_eq!(files(&out).len(), before.len(), "every file is there");
        counts.push(manifest.replaced);
        assert!(replace_history(&real, &made, &config).unwrap_err().to_string().contains("exists already"));
    }
    assert_eq!([counts[0].len(), counts[3].len()], [0, 4]);
    assert_eq!(counts[1], counts[2], "the kind of link does not choose");
    assert!(counts[1].iter().all(|frame| counts[3].contains(frame)));
    assert!(files(&dir.path().join("real")) == before, "originals are untouched");
    let config = HistoryConfig { out: dir.path().join("x"), force: false, share: 1.5, seed: 0, link: LinkKind::Hard };
    assert!(replace_history(&real, &made, &config).unwrap_err().to_string().contains("share"));
    // A generated folder that lacks a picture.
    let lost = made.frame(0).unwrap();
    let ImageSource::File { file, .. } = lost.views[1].image.as_ref().unwrap() else { panic!("no file") };
    std::fs::remove_file(file.path()).unwrap();
    let error = replace_history(&real, &made, &HistoryConfig { share: 1.0, ..config }).unwrap_err().to_string();
    assert!(error.contains("whole split") && error.contains(&lost.id.frame), "{error}");
    assert!(!dir.path().join("x").exists());
}
