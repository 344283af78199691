use std::ops::Range;
use std::path::Path;

use geometry::glam::DVec3;
use geometry::{Box3d, RigPreset, Rigid};

use super::*;
use crate::procedural::{Procedural, ProceduralConfig, RigSource};
use crate::{FrameId, ObjectBox, ObjectClass, SceneFrame, View};

fn procedural(rig: RigPreset) -> Procedural {
    let config =
        ProceduralConfig { scenes: 2, frames_per_scene: 3, rig: RigSource::Preset(rig), ..ProceduralConfig::default() };
    Procedural::open(&config).unwrap()
}

fn all(dataset: &dyn SceneDataset) -> CheckReport {
    check_all(dataset, &CheckOptions::default(), &mut |_, _| {})
}

/// Two scenes of four frames seen by the nuScenes rig, each picture a small file.
struct OnDisk {
    folder: tempfile::TempDir,
    /// Stamps of each scene's frames, ms.
    stamps_ms: [i64; 4],
    unreadable: Option<usize>,
    move_front_to: Option<DVec3>,
    turn: f64,
    parts: Capabilities,
}

impl OnDisk {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for index in 0..8 {
            for camera in 0..6 {
                let picture = image::RgbImage::from_pixel(32, 18, image::Rgb([index * 20, camera * 30, 7]));
                picture.save(folder.path().join(format!("{index}-{camera}.png"))).unwrap();
            }
        }
        let stamps_ms = [0, 500, 1000, 1500];
        Self { folder, stamps_ms, unreadable: None, move_front_to: None, turn: 0.0, parts: Capabilities::default() }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }
}

impl SceneDataset for OnDisk {
    fn len(&self) -> usize {
        8
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        if self.unreadable == Some(index) {
            return Err(DataError::Empty { what: format!("pose of frame {index}"), path: "poses.json".into() });
        }
        let timestamp_ns = self.stamps_ms[index % 4] * 1_000_000;
        let mut rig = RigPreset::NuScenes.rig().rotated(self.turn);
        if let Some(place) = self.move_front_to {
            rig.cameras[0].ego_from_cam.translation = place;
        }
        let views = rig.cameras.into_iter().enumerate().map(|(at, camera)| {
            let mut intrinsics = camera.intrinsics;
            let scale = 32.0 / f64::from(intrinsics.width);
            (intrinsics.fx, intrinsics.fy) = (scale * intrinsics.fx, scale * intrinsics.fy);
            (intrinsics.cx, intrinsics.cy) = (scale * intrinsics.cx, scale * intrinsics.cy);
            (intrinsics.width, intrinsics.height) = (32, 18);
            let file = self.path().join(format!("{index}-{at}.png")).into();
            View {
                channel: camera.channel,
                timestamp_ns: timestamp_ns + 1_000_000 * at as i64,
                // The last camera drops one picture.
                image: (index != 7 || at != 5).then_some(ImageSource::File { file, size: (32, 18) }),
                mask: None,
                intrinsics,
                lens: camera.lens,
                ego_from_cam: camera.ego_from_cam,
                world_from_ego: Rigid::from_yaw(0.0, DVec3::new(0.1 * at as f64, 0.0, 0.0)),
            }
        });
        let object = |x: f64, z: f64, class| ObjectBox {
            box3d: Box3d { center: DVec3::new(x, 0.0, z), size: DVec3::new(4.0, 2.0, 1.5), yaw: 0.0 },
            class,
            track: "t".into(),
            source_class: "native".into(),
            velocity: None,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        };
        let boxes = [(15.0, 1.0, ObjectClass::Car), (20.0, 400.0, ObjectClass::Bus)];
        Ok(SceneFrame {
            id: FrameId { dataset: "disk".into(), scene: format!("s{}", index / 4), frame: index.to_string() },
            timestamp_ns,
            world_from_ego: Rigid::IDENTITY,
            views: views.collect(),
            boxes: index.is_multiple_of(2).then(|| boxes.map(|(x, z, class)| object(x, z, class)).to_vec()),
            scene_text: None,
        })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        vec![0..4, 4..8]
    }

    fn name(&self) -> &str {
        "disk"
    }

    fn capabilities(&self) -> Capabilities {
        self.parts
    }

    fn max_views(&self) -> usize {
        6
    }
}

#[test]
fn a_sound_dataset_is_counted() {
    let report = all(&OnDisk::new());
    assert!(report.could_train(), "{:?} {:?}", report.problems, report.unreadable_frames);
    assert_eq!((report.scenes, report.frames, report.pictures, report.absent_views), (2, 8, 47, 1));
    assert_eq!((report.decoded, report.rendered_views, report.largest_picture), (4, 0, (32, 18)));
    assert_eq!((report.boxes.annotated_frames, report.boxes.count), (4, 8));
    assert_eq!(report.boxes.by_class, BTreeMap::from([(ObjectClass::Car, 4), (ObjectClass::Bus, 4)]));
    assert_eq!(report.boxes.outside_all_pictures, 4, "the bus hovers above all views");
    assert_eq!(report.warnings, Vec::<String>::new());
    assert_eq!((report.times.median_secs, report.times.gaps.len()), (0.5, 0));
    assert!((report.times.longest_picture_offset_secs - 0.005).abs() < 1e-9);
    assert!((report.times.longest_picture_way_m - 0.5).abs() < 1e-9);
}

#[test]
fn every_broken_picture_and_frame_is_listed() {
    let mut dataset = OnDisk::new();
    std::fs::remove_file(dataset.path().join("0-3.png")).unwrap();
    std::fs::write(dataset.path().join("5-1.png"), b"no picture").unwrap();
    image::RgbImage::new(8, 8).save(dataset.path().join("6-2.png")).unwrap();
    dataset.unreadable = Some(2);
    let report = all(&dataset);
    assert!(!report.could_train());
    assert_eq!((report.missing(), report.damaged(), report.unreadable_frames.len()), (1, 2, 1));
    assert_eq!(report.pictures, 41, "the frames around the broken one are looked at");
    for name in ["0-3.png", "5-1.png", "6-2.png"] {
        assert!(report.problems.iter().any(|problem| problem.to_string().ends_with(name)), "{name}");
    }
    let json = serde_json::to_value(&report).unwrap();
    assert_eq!(json["problems"].as_array().unwrap().len(), 3);
    assert!(json["unreadable_frames"][0].as_str().unwrap().contains("poses.json"));
    assert!(check(&dataset, 1).unwrap_err().to_string().ends_with("poses.json"));
}

#[test]
fn a_picture_broken_inside_is_found_by_decoding() {
    let dataset = OnDisk::new();
    let path = dataset.path().join("1-1.jpg");
    image::RgbImage::from_fn(32, 18, |x, y| image::Rgb([(x * 7) as u8, (y * 9) as u8, 0])).save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let scan = bytes.windows(2).position(|pair| pair == [0xFF, 0xDA]).unwrap() + 14;
    std::fs::write(dataset.path().join("1-1.png"), [&bytes[..scan + 4], &[0xFF, 0xD9]].concat()).unwrap();
    let with = |decode| {
        let options = CheckOptions { decode, ..CheckOptions::default() };
        check_all(&dataset, &options, &mut |_, _| {}).problems.len()
    };
    assert_eq!((with(0), with(usize::MAX)), (0, 1));
}

#[test]
fn holes_and_disorder_are_found() {
    let report = all(&OnDisk { stamps_ms: [0, 100, 200, 700], ..OnDisk::new() });
    let found: Vec<_> = report.times.gaps.iter().map(|gap| (gap.scene.as_str(), gap.after_frame)).collect();
    assert_eq!(found, [("s0", 2), ("s1", 6)]);
    assert_eq!((report.times.gaps[0].secs, report.times.longest_secs, report.times.shortest_secs), (0.5, 0.5, 0.1));
    let report = all(&OnDisk { stamps_ms: [0, 500, 400, 1000], ..OnDisk::new() });
    assert!(report.warnings.iter().any(|text| text.contains("after frame 1")), "{:?}", report.warnings);
}

#[test]
fn odd_calibration_is_named_once() {
    let dataset = OnDisk { move_front_to: Some(DVec3::new(1.0, 5.0, 1.5)), turn: 0.2, ..OnDisk::new() };
    let report = all(&dataset);
    assert_eq!(report.warnings.len(), 2, "{:?}", report.warnings);
    assert!(report.warnings[0].starts_with("no camera looks straight ahead"), "{:?}", report.warnings);
    assert!(report.warnings[1].contains("stands outside a car") && report.warnings[1].contains("y 5.00"));
    assert!(report.could_train(), "odd is not broken");
    assert_eq!((report.rigs.len(), report.rigs[0].calibrations, report.rigs[0].frames), (1, 1, 8));
}

#[test]
fn every_preset_is_a_sound_car_with_the_published_ring() {
    for preset in RigPreset::ALL {
        let report = all(&procedural(preset));
        assert!(report.could_train() && report.warnings.is_empty(), "{preset:?} {:?}", report.warnings);
        let rig = &report.rigs[0];
        assert_eq!((report.rigs.len(), rig.scenes, rig.frames), (1, 2, 6), "{preset:?}");
        assert_eq!(rig.closed, preset != RigPreset::Waymo);
        assert_eq!((report.rendered_views, report.pictures, report.decoded), (6 * rig.cameras.len(), 0, 4));
        assert_eq!((report.maps_read, report.occupancy_read), (2, 2));
    }
    let rig = all(&procedural(RigPreset::Waymo)).rigs.swap_remove(0);
    let last = rig.cameras.last().unwrap();
    assert!((last.azimuth_deg + 90.1).abs() < 0.1 && (last.overlap_deg.unwrap() + 130.2).abs() < 0.2, "{last:?}");
}

#[test]
fn parts_that_cannot_be_delivered_are_problems() {
    let parts = Capabilities { map: true, occupancy: true, ..Capabilities::default() };
    let report = all(&OnDisk { parts, ..OnDisk::new() });
    assert_eq!((report.maps_read, report.problems.len()), (0, 4));
    assert!(report.problems[0].to_string().contains("no map"));
}

#[test]
fn choices_are_different_inside_and_repeatable() {
    let chosen = choose(100, 10, 3, 1);
    assert_eq!((chosen.len(), chosen.last().is_some_and(|last| *last < 100)), (10, true));
    assert_eq!((choose(100, 10, 3, 1) == chosen, choose(100, 10, 3, 2) == chosen), (true, false));
    assert_eq!(choose(3, usize::MAX, 0, 0), BTreeSet::from([0, 1, 2]));
    assert_eq!(spread(10, 2).collect::<Vec<_>>(), [2, 7]);
    assert_eq!(spread(2, 5).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(spread(0, 5).count(), 0);
}

#[test]
fn memory_grows_with_what_is_held() {
    let loader = crate::LoaderConfig { batch_size: 2, prefetch: 3, workers: 4, ..crate::LoaderConfig::default() };
    let memory = batch_memory(&loader, 6, (1600, 900));
    assert_eq!(memory.batch_bytes, 2 * 2 * 6 * (3 * 64 * 64 * 4 + 233));
    assert_eq!(memory.loader_bytes, 4 * memory.batch_bytes + 4 * 1600 * 900 * 3);
    let padded = crate::LoaderConfig { pad_views: crate::PadViews::To(8), ..loader };
    assert_eq!(batch_memory(&padded, 6, (1, 1)).views, 8);
}
