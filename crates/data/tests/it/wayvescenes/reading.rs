//! What the reader makes of the fixtures besides poses: lenses, time, masks, cameras, tags, pictures.

use data::wayvescenes::{Scale, TimeUnit, ViewSplit, WayveScenes, WayveScenesConfig};
use data::{
    Capabilities, DataError, DatasetConfig, ImageSize, PadViews, PoseMode, Sample, SampleOptions, SceneDataset,
    assemble,
};
use geometry::glam::DVec2;
use geometry::{ImageEdit, Lens};
use image::Rgb;

use super::{CHANNELS, fixture, frames, frames_of, open, world_from_cam};

#[test]
fn traps_of_scale_time_and_lenses() {
    let Some(config) = fixture(|_| {}) else { return };
    let dataset = open(&config);
    for (info, (region, scale)) in dataset.scenes().iter().zip([("us", 2.702703), ("uk", 0.384615)]) {
        assert_eq!(info.region.as_deref(), Some(region));
        assert!((info.metres_per_unit - scale).abs() < 1e-6, "{}", info.metres_per_unit);
        let found = frames_of(&dataset, info);
        for pair in found.windows(2) {
            assert_eq!(pair[1].timestamp_ns - pair[0].timestamp_ns, 100_000_000, "10 Hz");
        }
        for frame in &found {
            assert!(frame.rig().adjacency().unwrap().closed);
            assert!(frame.boxes.is_none() && frame.scene_text.is_none(), "the csv has no row for made scenes");
            let first = world_from_cam(&frame.views[0]).translation;
            assert!(frame.views.iter().all(|view| world_from_cam(view).translation.distance(first) < 3.0));
            for view in &frame.views {
                let opencv = info.name == "scene_902" && view.channel == "right-backward";
                assert_eq!(matches!(view.lens, Lens::BrownConrady { .. }), opencv, "{}", view.channel);
                assert_eq!(matches!(view.lens, Lens::KannalaBrandt { .. }), !opencv, "{}", view.channel);
            }
        }
        // COLMAP's pixel centres are ours.
        assert_eq!((found[0].views[0].intrinsics.cx, found[0].views[0].intrinsics.cy), (957.5, 541.25));
    }
    assert_eq!(dataset.capabilities(), Capabilities { masks: true, ..Capabilities::default() });
    assert!(matches!(dataset.local_map(0, 10.0), Err(DataError::Unsupported { .. })));
    assert!(matches!(dataset.frame(7), Err(DataError::Config(_))));
}

#[test]
fn frames_are_pure_and_open_through_the_registry() {
    let Some(config) = fixture(|_| {}) else { return };
    let text = format!(r#"{{"kind": "wayve_scenes101", "root": {}}}"#, serde_json::to_string(&config.root).unwrap());
    let registered = data::open(&serde_json::from_str::<DatasetConfig>(&text).unwrap()).unwrap();
    let dataset = open(&config);
    assert_eq!(registered.scene_ranges(), dataset.scene_ranges());
    for index in (0..dataset.len()).rev() {
        let (a, b) = (dataset.frame(index).unwrap(), registered.frame(index).unwrap());
        assert_eq!(
            (&a.id, a.timestamp_ns, a.world_from_ego, a.rig()),
            (&b.id, b.timestamp_ns, b.world_from_ego, b.rig())
        );
    }
}

#[test]
fn every_picture_decodes_and_its_mask_has_its_size_and_polarity() {
    let Some(config) = fixture(|_| {}) else { return };
    for frame in frames(&open(&config)) {
        for view in &frame.views {
            let picture = view.image.as_ref().unwrap().decode().unwrap();
            let mask = view.mask.as_ref().unwrap().decode().unwrap();
            assert_eq!(picture.dimensions(), mask.dimensions());
            let ignored = mask.pixels().filter(|pixel| pixel.0 == [0; 3]).count();
            let share = ignored as f64 / f64::from(1920 * 1080);
            // The bonnet and a blurred face.
            assert!((0.005..0.1).contains(&share), "{} {} ignores {share}", frame.id.scene, view.channel);
            assert_eq!(mask.get_pixel(960, 2), &Rgb([255; 3]), "the sky is kept");
        }
    }
    let Some(config) = fixture(|config| config.masks = false) else { return };
    let dataset = open(&config);
    assert!(!dataset.capabilities().masks);
    assert!(frames(&dataset).iter().flat_map(|frame| &frame.views).all(|view| view.mask.is_none()));
}

/// The mask's way into a batch: the same way as the pixels, through lens and resize.
#[test]
fn masks_reach_the_batch_through_lens_and_resize() {
    const SIZE: ImageSize = ImageSize { height: 54, width: 96 };
    let Some(config) = fixture(|_| {}) else { return };
    let dataset = open(&config);
    for index in [0, 4] {
        let frame = dataset.frame(index).unwrap();
        let sample = Sample::load(&frame, &SampleOptions { size: SIZE, pose_mode: PoseMode::Compensated }).unwrap();
        let batch = assemble(vec![sample.clone()], PadViews::To(6)).unwrap();
        assert_eq!(batch.target.pixel_mask.len(), 6 * 54 * 96);
        assert!(batch.target.pixel_mask[5 * 54 * 96..].iter().all(|counts| !counts), "padding counts nowhere");
        let (mut ignored, mut checked) = (0, 0);
        for (v, view) in frame.views.iter().enumerate() {
            let raw = view.mask.as_ref().unwrap().decode().unwrap();
            let camera = view.camera().unwrap();
            let edit = ImageEdit::identity(1920, 1080).resize(96, 54);
            let mask = &batch.target.pixel_mask[v * 54 * 96..][..54 * 96];
            ignored += mask.iter().filter(|counts| !**counts).count();
            for (at, counts) in mask.iter().enumerate() {
                let center = DVec2::new((at % 96) as f64 + 0.5, (at / 96) as f64 + 0.5);
                let ray = view.intrinsics.matrix().inverse() * edit.invert(center).extend(1.0);
                let Some(seen) = camera.project(ray).filter(|pixel| view.intrinsics.contains(*pixel)) else {
                    assert!(!counts, "nothing was seen there");
                    continue;
                };
                let here = raw.get_pixel(seen.x as u32, seen.y as u32).0[0];
                // What the mask ignores never counts; what it keeps counts unless the border is near.
                assert!(here != 0 || !counts, "{} pixel {at} counts", view.channel);
                let near = |dx: i64, dy: i64| {
                    let x = (seen.x as i64 + dx).clamp(0, 1919) as u32;
                    raw.get_pixel(x, (seen.y as i64 + dy).clamp(0, 1079) as u32).0[0] != 0
                };
                let inside =
                    [-45, -20, 0, 20, 45].iter().all(|dx| [-45, -20, 0, 20, 45].iter().all(|dy| near(*dx, *dy)));
                assert!(*counts || !inside, "{} pixel {at} is lost", view.channel);
                checked += 1;
            }
        }
        assert!(ignored > 50 && checked > 20_000, "{ignored} ignored, {checked} checked");
        let mut flipped = sample.clone();
        flipped.target.iter_mut().for_each(data::SampleView::flip);
        for (a, b) in sample.target.iter().zip(&flipped.target) {
            let (a, b) = (a.pixel_mask.as_ref().unwrap(), b.pixel_mask.as_ref().unwrap());
            assert!(a.chunks(96).zip(b.chunks(96)).all(|(a, b)| a.iter().eq(b.iter().rev())));
        }
    }
}

#[test]
fn the_forward_camera_can_be_held_out() {
    let channels = |views: ViewSplit| {
        let config = fixture(|config| config.views = views)?;
        Some(frames(&open(&config)).into_iter().map(|frame| {
            let names: Vec<String> = frame.views.iter().map(|view| view.channel.clone()).collect();
            (names, frame)
        }))
    };
    let Some(test) = channels(ViewSplit::NovelViewTest) else { return };
    assert!(test.clone().all(|(names, _)| names == CHANNELS[..1]));
    let train = channels(ViewSplit::NovelViewTrain).unwrap();
    assert!(train.clone().all(|(names, _)| names == CHANNELS[1..]));
    for ((_, a), (_, b)) in test.zip(train) {
        // One car, one world: the held-out camera can be asked for from the others.
        assert_eq!((a.id, a.timestamp_ns, a.world_from_ego), (b.id, b.timestamp_ns, b.world_from_ego));
    }
    let two = channels(ViewSplit::Cameras(vec!["left-forward".into(), "front-forward".into()])).unwrap();
    assert!(two.clone().all(|(names, _)| names == ["front-forward", "left-forward"]));
    let none = fixture(|config| config.views = ViewSplit::Cameras(vec!["roof".into()])).unwrap();
    assert!(matches!(WayveScenes::open(&none), Err(DataError::Empty { .. })));
}

#[test]
fn scenes_splits_and_exclusions() {
    let names = |change: &dyn Fn(&mut WayveScenesConfig)| {
        let config = fixture(|config| change(config)).unwrap();
        WayveScenes::open(&config).map(|dataset| dataset.scenes().into_iter().map(|info| info.name).collect::<Vec<_>>())
    };
    if fixture(|_| {}).is_none() {
        return;
    }
    assert_eq!(names(&|_| {}).unwrap(), ["scene_901", "scene_902"]);
    assert_eq!(names(&|config| config.scenes = vec!["scene_902".into()]).unwrap(), ["scene_902"]);
    let order = |config: &mut WayveScenesConfig| config.scenes = vec!["scene_902".into(), "scene_901".into()];
    assert_eq!(names(&order).unwrap(), ["scene_902", "scene_901"]);
    assert!(matches!(names(&|config| config.split = "train".into()), Err(DataError::Empty { .. })));
    assert!(matches!(names(&|config| config.split = "test".into()), Err(DataError::Config(_))));
    let absent = names(&|config| config.scenes = vec!["scene_001".into()]).unwrap_err();
    assert!(matches!(absent, DataError::Missing { .. }) && absent.to_string().contains("scene_001"), "{absent}");
    let outside = names(&|config| {
        config.split = "val".into();
        config.scenes = vec!["scene_901".into()];
    });
    assert!(matches!(outside, Err(DataError::Config(_))));
    let hostile = names(&|config| config.scenes = vec!["../wayve101/scene_901".into()]).unwrap_err();
    assert!(matches!(hostile, DataError::UnsafePath { .. }), "{hostile}");
    let config = fixture(|config| config.exclude = vec!["scene_901/1690000000100000".into()]).unwrap();
    let dataset = open(&config);
    assert_eq!(dataset.scene_ranges(), [0..3, 3..6]);
    assert!(frames(&dataset).iter().all(|frame| frame.id.frame != "1690000000100000"));
}

#[test]
fn scale_unit_and_metadata_can_be_given() {
    let Some(config) = fixture(|config| {
        config.scenes = vec!["scene_901".into()];
        config.scale = Scale::MetresPerUnit(1.0 / 0.37);
        config.time_unit = TimeUnit::Nanoseconds;
    }) else {
        return;
    };
    let given = open(&config);
    let info = &given.scenes()[0];
    assert_eq!((info.region.as_deref(), info.metres_per_unit), (None, 1.0 / 0.37));
    // Stamps of 100 µs then lie within the window: one set per camera's picture.
    assert_eq!(given.len(), 4);
    assert_eq!(given.frame(0).unwrap().timestamp_ns, 1_690_000_000_000_000);
    let measured = open(&fixture(|config| config.scenes = vec!["scene_901".into()]).unwrap());
    let (a, b) = (given.frame(2).unwrap(), measured.frame(2).unwrap());
    assert!(a.world_from_ego.translation.distance(b.world_from_ego.translation) < 1e-9);
    let nowhere = fixture(|config| config.metadata = Some(config.root.as_slice()[0].path.join("scene_901"))).unwrap();
    assert!(matches!(WayveScenes::open(&nowhere), Err(DataError::Missing { .. })));
}
