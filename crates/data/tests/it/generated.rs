//! Pictures from memory, as a model makes them, through every writer and back.

use std::path::Path;

use data::argoverse2::{Argoverse2, Argoverse2Config, Split};
use data::nuplan::{NuPlan, NuPlanConfig};
use data::nuscenes::{NuScenes, NuScenesConfig, NuScenesExportConfig, export_nuscenes};
use data::waymo::{Waymo, WaymoConfig, WaymoRelease};
use data::wayvescenes::{WayveScenes, WayveScenesConfig};
use data::{
    Argoverse2Log, Argoverse2WriterConfig, DataError, ImageSource, NuPlanWriterConfig, Procedural, ProceduralConfig,
    RigSource, SceneDataset, SceneFrame, WaymoWriterConfig, WayveScenesWriterConfig, write_argoverse2, write_nuplan,
    write_waymo, write_wayvescenes,
};
use geometry::{ImageEdit, RigPreset};
use image::{Rgb, RgbImage};
use world::WorldConfig;

const SIZE: (u32, u32) = (64, 36);

/// A smooth picture that differs from frame to frame and view to view.
fn picture(frame: usize, view: usize) -> RgbImage {
    RgbImage::from_fn(SIZE.0, SIZE.1, |x, y| Rgb([(x * 2 + frame as u32 * 40) as u8, (y * 3) as u8, (view * 30) as u8]))
}

/// Frames of one rig in which nothing but the pictures is generated.
fn frames(preset: RigPreset, rate: f64) -> Vec<SceneFrame> {
    let config = ProceduralConfig {
        scenes: 1,
        frames_per_scene: 3,
        rig: RigSource::Preset(preset),
        world: WorldConfig { duration_secs: 3.0 / rate, ..WorldConfig::default() },
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config).unwrap();
    let frame = |index: usize| {
        let mut frame = dataset.frame(index).unwrap();
        for (at, view) in frame.views.iter_mut().enumerate() {
            *view = view.with_picture(picture(index, at));
        }
        frame
    };
    (0..dataset.len()).map(frame).collect()
}

/// Pictures and pinhole cameras come back; `JPEG` at the writers' quality costs a few grey levels.
fn compare(written: &[SceneFrame], read: &dyn SceneDataset) {
    assert_eq!(read.len(), written.len());
    for (index, frame) in written.iter().enumerate() {
        let back = read.frame(index).unwrap();
        for (at, view) in frame.views.iter().enumerate() {
            let same = |other: &&data::View| {
                other.ego_from_cam.angle_to(&view.ego_from_cam) < 1e-6
                    && (other.ego_from_cam.translation - view.ego_from_cam.translation).length() < 1e-6
            };
            let found = back.views.iter().find(same).unwrap();
            assert_eq!((found.intrinsics.width, found.intrinsics.height), SIZE);
            assert!((found.intrinsics.fx - view.intrinsics.fx).abs() < 1e-9);
            let pixels = found.image.as_ref().unwrap().decode().unwrap();
            let off = pixels.as_raw().iter().zip(picture(index, at).as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(off.unwrap() < 30, "{off:?}");
        }
    }
}

#[test]
fn nuplan() {
    let (dir, frames) = (tempfile::tempdir().unwrap(), frames(RigPreset::NuPlan, 2.0));
    let out = dir.path().join("set");
    write_nuplan(&frames, &NuPlanWriterConfig::new(out.clone()), &mut |_, _| {}).unwrap();
    compare(&frames, &NuPlan::open(&NuPlanConfig::new(out)).unwrap());
}

#[test]
fn waymo() {
    let (dir, frames) = (tempfile::tempdir().unwrap(), frames(RigPreset::Waymo, 10.0));
    let config = WaymoWriterConfig::new(dir.path().join("set"));
    write_waymo(&config, &frames, &mut |_, _| {}).unwrap();
    let config = WaymoConfig { split: config.split, ..WaymoConfig::new(config.out, WaymoRelease::V2) };
    compare(&frames, &Waymo::open(&config).unwrap());
}

#[test]
fn argoverse2() {
    let (dir, frames) = (tempfile::tempdir().unwrap(), frames(RigPreset::Argoverse2, 10.0));
    let out = dir.path().join("set");
    let log = Argoverse2Log { split: Split::Val, frames: frames.clone(), city: "XXX".into(), map: None, ground: None };
    write_argoverse2(&Argoverse2WriterConfig::new(out.clone(), "a test"), &[log], &mut |_, _| {}).unwrap();
    compare(&frames, &Argoverse2::open(&Argoverse2Config::new(out)).unwrap());
}

#[test]
fn wayve_scenes101() {
    let (dir, frames) = (tempfile::tempdir().unwrap(), frames(RigPreset::WayveScenes101, 10.0));
    let config = WayveScenesWriterConfig::new(dir.path().join("set"));
    write_wayvescenes(&config, &frames, &mut |_, _| {}).unwrap();
    compare(&frames, &WayveScenes::open(&WayveScenesConfig::new(config.out)).unwrap());
}

#[test]
fn a_picture_of_another_size_than_its_camera_is_refused() {
    let frame = &frames(RigPreset::NuPlan, 2.0)[0];
    let Some(ImageSource::Memory { picture, .. }) = &frame.views[0].image else { panic!("no picture in memory") };
    let wrong = ImageSource::Memory { picture: picture.clone(), size: (65, 36) };
    for error in [wrong.decode().map(drop), wrong.inspect(), wrong.load(&ImageEdit::identity(65, 36)).map(drop)] {
        assert!(matches!(error, Err(DataError::ImageSize { got: (64, 36), want: (65, 36), .. })), "{error:?}");
    }
}

#[test]
fn nuscenes_keeps_tokens_names_and_boxes() {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else { return };
    let chain = Path::new(&root).join("nuscenes_chain");
    let source = NuScenes::open(&NuScenesConfig::new(chain.clone(), "v1.0-mini")).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let config = NuScenesExportConfig::new(dir.path().join("set"), "a test");
    let mut made = |index: usize, frame: &SceneFrame| {
        let view = |(at, view): (usize, &data::View)| {
            view.image.is_some().then(|| view.with_picture(picture(index % 6, at)).image)
        };
        Ok(frame.views.iter().enumerate().map(|seen| view(seen).flatten()).collect())
    };
    let manifest = export_nuscenes(&source, &config, &mut made, &mut |_, _| {}).unwrap();
    assert_eq!(manifest.sha256.len() - 13, manifest.sha256.keys().filter(|name| name.starts_with("maps/")).count());
    let written = NuScenes::open(&NuScenesConfig::new(config.out.clone(), "v1.0-mini")).unwrap();
    assert_eq!(written.len(), source.len());
    for index in 0..source.len() {
        let (a, b) = (source.frame(index).unwrap(), written.frame(index).unwrap());
        assert_eq!((&a.id, &a.boxes, a.world_from_ego, a.rig()), (&b.id, &b.boxes, b.world_from_ego, b.rig()));
        for (at, (a, b)) in a.views.iter().zip(&b.views).enumerate().filter(|(_, (a, _))| a.image.is_some()) {
            let (Some(ImageSource::File { file: a, .. }), Some(b)) = (&a.image, &b.image) else { panic!("no files") };
            let ImageSource::File { file, size } = b else { panic!("no file") };
            assert_eq!(a.path().strip_prefix(&chain).unwrap(), file.path().strip_prefix(&config.out).unwrap());
            let small = b.load(&ImageEdit::identity(size.0, size.1).resize(SIZE.0, SIZE.1)).unwrap();
            let off = small.as_raw().iter().zip(picture(index % 6, at).as_raw()).map(|(a, b)| a.abs_diff(*b)).max();
            assert!(off.unwrap() < 30, "{off:?}");
        }
    }
    let mut short = |_: usize, _: &SceneFrame| Ok(Vec::new());
    let config = NuScenesExportConfig::new(dir.path().join("other"), "a test");
    assert!(
        export_nuscenes(&source, &config, &mut short, &mut |_, _| {}).unwrap_err().to_string().contains("0 pictures")
    );
    assert!(!dir.path().join("other").exists());
}
