//! The procedural dataset.

use std::sync::Arc;

use data::{
    AugmentConfig, DataError, DatasetConfig, ImageSize, ImageSource, InOrder, Loader, LoaderConfig, Mixture,
    MixtureConfig, PadViews, PoseMode, Procedural, ProceduralConfig, RigMotion, RigSource, Sample, SampleOptions,
    SceneDataset, SceneFrame, ViewArrays, assemble, novel_targets, rerig,
};
use geometry::glam::DVec3;
use geometry::{Box3d, Camera, RigPreset, Rigid};
use world::Rendering;

const SIZE: ImageSize = ImageSize { height: 48, width: 64 };
const OPTIONS: SampleOptions = SampleOptions { size: SIZE, pose_mode: PoseMode::Compensated };

fn config(rig: RigPreset) -> ProceduralConfig {
    ProceduralConfig {
        seed: 3,
        scenes: 2,
        frames_per_scene: 3,
        rig: RigSource::Preset(rig),
        ..ProceduralConfig::default()
    }
}

fn frame(rig: RigPreset, index: usize) -> SceneFrame {
    Procedural::open(&config(rig)).unwrap().frame(index).unwrap()
}

#[test]
fn frames_are_pure_and_seeds_differ() {
    let first = Procedural::open(&config(RigPreset::NuScenes)).unwrap();
    let again = Procedural::open(&config(RigPreset::NuScenes)).unwrap();
    assert_eq!((first.len(), first.max_views()), (6, 6));
    // The second dataset is asked in another order, so that its cache works differently.
    let later: Vec<SceneFrame> = (0..6).rev().map(|i| again.frame(i).unwrap()).collect();
    for (a, b) in (0..6).map(|i| first.frame(i).unwrap()).zip(later.iter().rev()) {
        assert_eq!((&a.id, a.timestamp_ns, a.world_from_ego), (&b.id, b.timestamp_ns, b.world_from_ego));
        assert_eq!((&a.boxes, &a.scene_text), (&b.boxes, &b.scene_text));
        let batch = |frame| assemble(vec![Sample::load(frame, &OPTIONS).unwrap()], PadViews::Largest).unwrap();
        assert_eq!(batch(&a), batch(b));
    }
    let times: Vec<i64> = (0..6).map(|i| first.frame(i).unwrap().timestamp_ns).collect();
    assert!(times.windows(2).all(|pair| pair[0] < pair[1]));
    let other = Procedural::open(&ProceduralConfig { seed: 4, ..config(RigPreset::NuScenes) }).unwrap();
    assert_ne!(other.frame(0).unwrap().boxes, first.frame(0).unwrap().boxes);
}

/// Renders what view `v` of these arrays shows, labels included, with a camera made from the arrays' own frame.
fn labels(frame: &SceneFrame, v: usize) -> Rendering {
    let Some(ImageSource::Rendered { snapshot, camera, world_from_cam }) = &frame.views[v].image else {
        panic!("a procedural view is rendered");
    };
    let raw = camera.intrinsics;
    let edit = geometry::ImageEdit::identity(raw.width, raw.height).resize(SIZE.width, SIZE.height);
    let camera = Camera::new(edit.intrinsics(&raw), geometry::Lens::Pinhole).unwrap();
    snapshot.render_serial(&camera, world_from_cam, &world::RenderOptions::default())
}

/// Lifts every pixel that shows an actor by its rendered depth through `ego_from_img` and looks whether it falls into the actor's box;
/// returns how many did and the worst distance outside, metres.
fn lift(arrays: &ViewArrays, v: usize, labels: &Rendering, mirrored: bool, boxes: &[(String, Box3d)]) -> (usize, f64) {
    let (mut count, mut worst) = (0, 0.0f64);
    for (i, instance) in labels.instance.iter().enumerate().filter(|(_, id)| **id > 0) {
        let (column, row) = (i % arrays.width, i / arrays.width);
        let column = if mirrored { arrays.width - 1 - column } else { column };
        let z = labels.depth[i];
        let q = [(column as f32 + 0.5) * z, (row as f32 + 0.5) * z, z, 1.0];
        let m = &arrays.ego_from_img[v * 12..][..12];
        let p: [f32; 3] = std::array::from_fn(|r| (0..4).map(|c| m[r * 4 + c] * q[c]).sum());
        let p = DVec3::from_array(p.map(f64::from));
        let track = (instance - 1).to_string();
        let bounds = &boxes.iter().find(|b| b.0 == track).expect("every visible actor has a box").1;
        let local = Rigid::from_yaw(bounds.yaw, bounds.center).inverse() * p;
        worst = worst.max((local.abs() - bounds.size * 0.5).max_element());
        count += 1;
    }
    (count, worst)
}

#[test]
fn pixels_lie_on_their_boxes_whatever_the_augmentation() {
    let augment = AugmentConfig {
        flip_probability: 0.5,
        rig_motion: RigMotion { probability: 0.5, ..RigMotion::default() },
        ..Default::default()
    };
    for rig in [RigPreset::NuScenes, RigPreset::Argoverse2, RigPreset::NuPlan] {
        let mut seen = 0;
        for index in 0..6 {
            let frame = frame(rig, index);
            let mut sample = Sample::load(&frame, &OPTIONS).unwrap();
            let before = sample.target[0].ego_from_cam;
            augment.apply(&mut sample, 1, index as u64);
            let motion = sample.target[0].ego_from_cam * before.inverse();
            let moved = |b: &data::ObjectBox| (b.track.clone(), b.box3d.transformed(&motion));
            let boxes: Vec<(String, Box3d)> = frame.boxes.iter().flatten().map(moved).collect();
            let batch = assemble(vec![sample], PadViews::Largest).unwrap();
            for v in 0..frame.views.len() {
                let labels = labels(&frame, v);
                for arrays in [&batch.input, &batch.target] {
                    let mirrored = arrays.img_from_raw[v * 9] < 0.0;
                    let (count, worst) = lift(arrays, v, &labels, mirrored, &boxes);
                    assert!(worst < 0.05, "{rig:?} frame {index} view {v}: {worst} m outside");
                    seen += count;
                }
                let clean = |i: usize, c: usize| {
                    batch.target.images[(v * 3 + c) * (48 * 64) + i] == f32::from(labels.rgb[i * 3 + c]) / 255.0
                };
                assert!((0..48 * 64).all(|i| (0..3).all(|c| clean(i, c))), "the target is the clean picture");
            }
        }
        assert!(seen > 500, "{rig:?}: only {seen} pixels showed actors");
    }
}

#[test]
fn moved_rigs_see_the_same_world() {
    let frame = frame(RigPreset::NuScenes, 1);
    let own = assemble(vec![Sample::load(&frame, &OPTIONS).unwrap()], PadViews::Largest).unwrap();
    let same = novel_targets(std::slice::from_ref(&frame), &[frame.rig()], SIZE, PadViews::Largest).unwrap();
    assert_eq!(same, own.target);
    // A rig turned by 360 degrees sees the same, one turned by 30 degrees something else.
    let full = frame.rig().rotated(std::f64::consts::TAU);
    let full = novel_targets(std::slice::from_ref(&frame), &[full], SIZE, PadViews::Largest).unwrap();
    let difference = |a: &ViewArrays| {
        a.images.iter().zip(&own.target.images).map(|(x, y)| f64::from((x - y).abs())).sum::<f64>()
            / a.images.len() as f64
    };
    assert!(difference(&full) < 1e-3, "{}", difference(&full));
    let turned = frame.rig().rotated(30f64.to_radians());
    let turned_arrays =
        novel_targets(std::slice::from_ref(&frame), std::slice::from_ref(&turned), SIZE, PadViews::Largest).unwrap();
    assert!(difference(&turned_arrays) > 0.01);
    // Another vehicle's cameras on this car, and boxes seen by them where they are.
    let other = RigPreset::Argoverse2.rig();
    let moved = rerig(&frame, &other).unwrap();
    let arrays = novel_targets(std::slice::from_ref(&frame), &[other], SIZE, PadViews::Largest).unwrap();
    let boxes: Vec<(String, Box3d)> = frame.boxes.iter().flatten().map(|b| (b.track.clone(), b.box3d)).collect();
    for v in 0..7 {
        let (_, worst) = lift(&arrays, v, &labels(&moved, v), false, &boxes);
        assert!(worst < 0.05, "view {v}: {worst} m outside");
    }
}

#[test]
fn rigs_of_different_vehicles_mix() {
    let open = |rig, cameras: &[&str]| -> Arc<dyn SceneDataset> {
        let cameras = cameras.iter().map(|c| (*c).to_owned()).collect();
        Arc::new(Procedural::open(&ProceduralConfig { cameras, ..config(rig) }).unwrap())
    };
    let four = ["CAM_FRONT", "CAM_BACK", "CAM_FRONT_LEFT", "CAM_FRONT_RIGHT"];
    let datasets =
        vec![open(RigPreset::NuScenes, &four), open(RigPreset::NuScenes, &[]), open(RigPreset::Argoverse2, &[])];
    let blend = Arc::new(Mixture::new(datasets, &MixtureConfig::default(), 6, 1).unwrap());
    let run = |workers| {
        let config = LoaderConfig { batch_size: 6, workers, size: ImageSize::square(16), ..LoaderConfig::default() };
        Loader::new(blend.clone(), config, 0).unwrap().next_batch().unwrap()
    };
    let batch = run(2);
    assert_eq!(batch, run(1));
    assert_eq!(batch.input.views, batch.channels.iter().map(Vec::len).max().unwrap());
    for (b, channels) in batch.channels.iter().enumerate() {
        let mask = &batch.input.mask[b * batch.input.views..][..batch.input.views];
        assert_eq!(mask.iter().filter(|m| **m).count(), channels.len());
    }
}

#[test]
fn jitter_turns_the_rig_and_the_pictures() {
    let jittered = Procedural::open(&ProceduralConfig { yaw_jitter_deg: 20.0, ..config(RigPreset::NuScenes) }).unwrap();
    let mut turns = vec![];
    for index in 0..6 {
        let frame = jittered.frame(index).unwrap();
        let azimuth = |frame: &SceneFrame| frame.rig().cameras[0].azimuth().to_degrees();
        let plain = self::frame(RigPreset::NuScenes, index);
        turns.push(azimuth(&frame) - azimuth(&plain));
        let truth = novel_targets(&[plain], &[frame.rig()], SIZE, PadViews::Largest).unwrap();
        assert_eq!(truth, assemble(vec![Sample::load(&frame, &OPTIONS).unwrap()], PadViews::Largest).unwrap().target);
    }
    assert!(turns.iter().all(|t| t.abs() <= 20.0) && turns.iter().any(|t| t.abs() > 2.0), "{turns:?}");
}

#[test]
fn configs_are_strict() {
    let parse = |text: &str| serde_json::from_str::<DatasetConfig>(text);
    let parsed = parse(r#"{"kind": "procedural", "seed": 9, "rig": {"preset": "argoverse2"}}"#).unwrap();
    assert_eq!(data::open(&parsed).unwrap().max_views(), 7);
    assert_eq!(parse(&serde_json::to_string(&parsed).unwrap()).unwrap(), parsed);
    assert!(parse(r#"{"kind": "procedurel"}"#).is_err());
    assert!(parse(r#"{"kind": "procedural", "sede": 9}"#).is_err());
    assert!(parse(r#"{"seed": 9}"#).is_err());
    assert!(matches!(parse(r#"{"kind": "nuscenes", "root": "absent"}"#), Ok(DatasetConfig::NuScenes(_))));
    assert!(parse(r#"{"kind": "nuscenes", "root": "absent", "seed": 9}"#).is_err());
    let absent = data::open(&parse(r#"{"kind": "nuscenes", "root": "absent"}"#).unwrap()).err().unwrap();
    assert!(matches!(absent, DataError::Missing { .. }), "{absent}");
    let refused = |config: ProceduralConfig| matches!(Procedural::open(&config), Err(DataError::Config(_)));
    assert!(refused(ProceduralConfig { scenes: 0, ..config(RigPreset::NuScenes) }));
    assert!(refused(ProceduralConfig { yaw_jitter_deg: -1.0, ..config(RigPreset::NuScenes) }));
    assert!(refused(ProceduralConfig { cameras: vec!["CAM_TOP".into()], ..config(RigPreset::NuScenes) }));
}

#[test]
fn rigs_come_from_files() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.json");
    let open =
        || Procedural::open(&ProceduralConfig { rig: RigSource::File(path.clone()), ..config(RigPreset::Waymo) });
    assert!(matches!(open(), Err(DataError::Missing { .. })));
    let rig = RigPreset::Waymo.rig();
    std::fs::write(&path, serde_json::to_string(&rig).unwrap()).unwrap();
    assert_eq!(open().unwrap().rig(), &rig);
    let mut broken = rig.clone();
    broken.cameras[2].intrinsics.fx = 0.0;
    std::fs::write(&path, serde_json::to_string(&broken).unwrap()).unwrap();
    assert!(matches!(open(), Err(DataError::Calibration { .. })));
    std::fs::write(&path, r#"{"cameras": []}"#).unwrap();
    assert!(matches!(open(), Err(DataError::Empty { .. })));
    std::fs::write(&path, "{").unwrap();
    assert!(open().unwrap_err().to_string().ends_with("rig.json"));
}

/// A fisheye rig is rendered as pinhole cameras with the same K.
#[test]
fn fisheye_rigs_enter_as_pinholes() {
    let dataset = Procedural::open(&config(RigPreset::WayveScenes101)).unwrap();
    let batch = InOrder::new(&dataset, 6, PadViews::Largest, OPTIONS).next().unwrap().unwrap();
    let frame = dataset.frame(0).unwrap();
    assert!(frame.views.iter().all(|v| v.lens != geometry::Lens::Pinhole));
    let labels = labels(&frame, 2);
    let picture = &batch.target.images[2 * 3 * 48 * 64..][..3 * 48 * 64];
    let close =
        (0..48 * 64).all(|i| (0..3).all(|c| picture[c * 48 * 64 + i] == f32::from(labels.rgb[i * 3 + c]) / 255.0));
    assert!(close);
}
