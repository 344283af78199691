//! The reader on the fixture datasets: whole scenes with gaps, interpolated tables, splits, pictures.

use std::collections::BTreeMap;
use std::path::Path;

use data::nuscenes::{BoxMode, FrameChoice, NuScenes, NuScenesConfig, PictureTime, check};
use data::{DataError, SceneDataset};
use geometry::ImageEdit;

use super::{folder, frames, open};

fn chain(root: &Path, change: impl FnOnce(&mut NuScenesConfig)) -> NuScenesConfig {
    let mut config = NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini");
    change(&mut config);
    config
}

fn missing_views(dataset: &NuScenes) -> BTreeMap<String, usize> {
    let mut missing = BTreeMap::new();
    for view in frames(dataset).into_iter().flat_map(|frame| frame.views).filter(|view| view.image.is_none()) {
        *missing.entry(view.channel).or_default() += 1;
    }
    missing
}

#[test]
fn the_chain_gives_its_key_frames_and_its_sets() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let keys = open(&chain(&root, |_| {}));
    assert_eq!(keys.scenes().iter().map(|scene| scene.frames.len()).collect::<Vec<_>>(), [8, 3]);
    assert!(missing_views(&keys).is_empty());
    let all = open(&chain(&root, |config| config.frames = FrameChoice::all_pictures()));
    // 42 and 13 pictures of the cameras that lost none; one picture of the back and two of the front right are lost.
    assert_eq!(all.scenes().iter().map(|scene| scene.frames.len()).collect::<Vec<_>>(), [42, 13]);
    let want = BTreeMap::from([("CAM_BACK".to_owned(), 1), ("CAM_FRONT_RIGHT".to_owned(), 2)]);
    assert_eq!(missing_views(&all), want);
    for frame in frames(&all) {
        let channels: Vec<&str> = frame.views.iter().map(|view| view.channel.as_str()).collect();
        let clockwise =
            ["CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT"];
        assert_eq!(channels, clockwise);
        assert!(frame.rig().adjacency().unwrap().closed);
        let stamps: Vec<i64> = frame.views.iter().map(|view| view.timestamp_ns).collect();
        let spread = stamps.iter().max().unwrap() - stamps.iter().min().unwrap();
        assert!(spread < 50_000_000, "a set spans {spread} ns, more than a lidar turn");
        assert!(frame.views[0].ego_from_cam.translation.x > 0.0);
    }
    let rigs: Vec<_> = all.scenes().iter().map(|scene| all.frame(scene.frames.start).unwrap().rig()).collect();
    assert_ne!(rigs[0], rigs[1], "the scenes have different rigs");
}

#[test]
fn an_object_without_annotation_is_absent_around_the_hole() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let open_mode = |boxes| {
        let frames = FrameChoice::AllPictures { pairing_window_ms: 25.0, boxes };
        open(&chain(&root, |config| config.frames = frames))
    };
    let has_rider = |frame: &data::SceneFrame| {
        frame.boxes.as_ref().is_some_and(|boxes| boxes.iter().any(|found| found.source_class == "vehicle.motorcycle"))
    };
    let (both, devkit) = (frames(&open_mode(BoxMode::Both)), frames(&open_mode(BoxMode::Devkit)));
    let keys: Vec<usize> =
        (0..42).filter(|at| both[*at].boxes.iter().flatten().any(|found| !found.interpolated)).collect();
    assert_eq!(keys.len(), 8);
    assert_eq!(keys.iter().map(|at| has_rider(&both[*at])).filter(|has| !has).count(), 1);
    let hole = keys.iter().position(|at| !has_rider(&both[*at])).unwrap();
    assert!((keys[hole - 1] + 1..keys[hole + 1]).all(|at| !has_rider(&both[at])));
    assert!((keys[hole] + 1..keys[hole + 1]).all(|at| has_rider(&devkit[at])));
}

#[test]
fn every_picture_of_the_fixtures_decodes() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let config = chain(&root, |config| config.frames = FrameChoice::all_pictures());
    let report = check(&config, usize::MAX).unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    assert_eq!((report.scenes, report.frames, report.absent_views), (2, 55, 3));
    assert_eq!((report.pictures, report.decoded), (327, 327));
    let keyframe = open(&NuScenesConfig::new(root.join("nuscenes_keyframe"), "v1.0-mini"));
    let frame = keyframe.frame(0).unwrap();
    for view in &frame.views {
        let edit = ImageEdit::identity(1600, 900).resize(400, 225).crop(0, 1, 400, 224);
        let picture = view.image.as_ref().unwrap().load(&edit).unwrap();
        assert_eq!(picture.dimensions(), (400, 224));
        let values: Vec<f64> = picture.as_raw().iter().map(|value| f64::from(*value)).collect();
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let spread = (values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt();
        assert!(spread > 20.0, "{} is nearly flat", view.channel);
    }
}

#[test]
fn interpolated_tables_load_and_their_real_times_differ() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let version = |config: &mut NuScenesConfig| config.version = "interp_12Hz_mini".to_owned();
    let real = frames(&open(&chain(&root, version)));
    let written = frames(&open(&chain(&root, |config| {
        version(config);
        config.timestamps = PictureTime::AsWritten;
    })));
    assert_eq!((real.len(), written.len()), (56, 56));
    assert!(real.iter().any(|frame| frame.id.frame.len() == 33));
    let mut worst: BTreeMap<&str, f64> = BTreeMap::new();
    for (view, other) in real.iter().zip(&written).flat_map(|(a, b)| a.views.iter().zip(&b.views)) {
        let difference_ms = ((view.timestamp_ns - other.timestamp_ns) as f64 * 1e-6).abs();
        let worst = worst.entry(&view.channel).or_default();
        *worst = difference_ms.max(*worst);
        assert_eq!(view.world_from_ego, other.world_from_ego);
    }
    // Behind two lost sweeps the last picture is repeated.
    assert!((worst["CAM_FRONT"] - 54.5).abs() < 0.6 && (worst["CAM_FRONT_RIGHT"] - 186.0).abs() < 0.6, "{worst:?}");
}

#[test]
fn splits_choose_scenes_and_an_absent_split_is_empty() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let names = |split: &str| -> Result<Vec<String>, DataError> {
        let dataset = NuScenes::open(&chain(&root, |config| config.split = split.to_owned()))?;
        Ok(dataset.scenes().into_iter().map(|scene| scene.name).collect())
    };
    assert_eq!(names("mini_val").unwrap(), ["scene-0916"]);
    assert_eq!(names("mini_train").unwrap(), ["scene-0655"]);
    assert!(matches!(names("test"), Err(DataError::Empty { .. })));
}
