//! What frames hold: order, pictures, maps, words, choices of the config.

use std::collections::BTreeMap;

use data::taxonomy::ClassRule;
use data::waymo::{Waymo, WaymoConfig, WaymoRelease};
use data::{DataError, DatasetConfig, MapKind, ObjectClass, SceneDataset};
use geometry::glam::DVec3;
use geometry::{ImageEdit, Lens};

use super::{assert_same, config, fixture, frames, made, picture_bytes, variant};

const CHAIN: [&str; 5] = ["SIDE_LEFT", "FRONT_LEFT", "FRONT", "FRONT_RIGHT", "SIDE_RIGHT"];
const SEGMENT: &str = "9000000000000000001_0000_000_0020_000";

fn published() -> Option<Waymo> {
    let root = fixture("waymo/v1")?;
    Some(Waymo::open(&config(&root, WaymoRelease::V1, "validation")).unwrap())
}

#[test]
fn both_releases_of_the_made_segment_give_equal_frames() {
    let Some([v1, v2]) = made() else { return };
    assert_eq!((v1.len(), v1.scene_ranges().len(), v1.scene_ranges()[0].clone(), v1.max_views()), (3, 1, 0..3, 5));
    assert_eq!((v2.len(), v2.scene_ranges().len(), v2.scene_ranges()[0].clone(), v2.max_views()), (3, 1, 0..3, 5));
    for (a, b) in frames(&v1).iter().zip(&frames(&v2)) {
        assert_eq!((a.id.scene.as_str(), a.boxes.as_ref().unwrap().len()), (SEGMENT, 7));
        assert_eq!(a.scene_text.as_deref(), Some("Day, location_other, sunny"));
        assert_same(a, b, 0.0);
    }
}

#[test]
fn tables_derived_from_the_published_frame_give_the_same_frame() {
    let Some(v1) = published() else { return };
    let v2 = Waymo::open(&config(&fixture("waymo").unwrap(), WaymoRelease::V2, "v2_derived")).unwrap();
    assert_eq!((v1.len(), v2.len()), (1, 1));
    let (a, b) = (v1.frame(0).unwrap(), v2.frame(0).unwrap());
    assert_eq!(a.boxes.as_ref().unwrap().len(), 75);
    assert_same(&a, &b, 0.0);
}

#[test]
fn cameras_run_from_left_to_right_and_do_not_close() {
    let Some(dataset) = published() else { return };
    let frame = dataset.frame(0).unwrap();
    let rig = frame.rig();
    assert_eq!(rig.cameras.iter().map(|camera| camera.channel.as_str()).collect::<Vec<_>>(), CHAIN);
    let adjacency = rig.adjacency().unwrap();
    assert!(!adjacency.closed);
    assert_eq!(adjacency.right, [Some(1), Some(2), Some(3), Some(4), None]);
    assert_eq!(adjacency.left, [None, Some(0), Some(1), Some(2), Some(3)]);
    let azimuths = [89.2, 44.2, 0.2, -44.6, -90.1];
    let overlaps = [5.1, 6.2, 6.1, 5.0, -130.2];
    for at in 0..5 {
        assert!((rig.cameras[at].azimuth().to_degrees() - azimuths[at]).abs() < 0.06);
        assert!((rig.overlap(at, (at + 1) % 5).unwrap().to_degrees() - overlaps[at]).abs() < 0.1);
    }
    let front = &rig.cameras[2];
    assert!(front.ego_from_cam.translation.x > 0.0);
    assert!(front.ego_from_cam.transform_vector(DVec3::Z).angle_between(DVec3::X).to_degrees() < 5.0);
    for (camera, preset) in rig.cameras.iter().zip(geometry::RigPreset::Waymo.rig().cameras) {
        assert!(matches!(camera.lens, Lens::BrownConrady { k: [_, _, 0.0], .. }));
        assert!((camera.intrinsics.cx - preset.intrinsics.cx).abs() < 1e-3, "half a pixel is added");
    }
}

#[test]
fn stamps_and_sizes_of_the_published_frame() {
    let Some(dataset) = published() else { return };
    let frame = dataset.frame(0).unwrap();
    let native_ns = 1_553_735_853_462_203_000;
    assert_eq!(frame.timestamp_ns, native_ns + 50_000_000);
    for (view, late_ms) in frame.views.iter().zip([22, 42, 52, 62, 72]) {
        let ms = (view.timestamp_ns - native_ns) as f64 * 1e-6;
        assert!((ms - f64::from(late_ms)).abs() < 1.0, "{} at {ms} ms", view.channel);
        let rows = if view.channel.starts_with("SIDE") { 886 } else { 1280 };
        assert_eq!((view.intrinsics.width, view.intrinsics.height), (1920, rows));
        let image = view.image.as_ref().unwrap();
        image.inspect().unwrap();
        let pixels = image.decode().unwrap();
        assert_eq!(pixels.dimensions(), (1920, rows));
        let edit = ImageEdit::identity(1920, rows).resize(96, 64);
        assert_eq!(image.load(&edit).unwrap().dimensions(), (96, 64));
        let mean = pixels.as_raw().iter().map(|v| f64::from(*v)).sum::<f64>() / pixels.as_raw().len() as f64;
        let spread = pixels.as_raw().iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>();
        assert!((spread / pixels.as_raw().len() as f64).sqrt() > 20.0, "{} is nearly flat", view.channel);
    }
}

#[test]
fn boxes_are_longer_than_wide_and_have_their_classes() {
    let Some(dataset) = published() else { return };
    let frame = dataset.frame(0).unwrap();
    let mut counts: BTreeMap<(&str, ObjectClass), usize> = BTreeMap::new();
    for object in frame.boxes.iter().flatten() {
        *counts.entry((&object.source_class, object.class)).or_default() += 1;
        assert!(object.source_class != "VEHICLE" || object.box3d.size.x > object.box3d.size.y, "{object:?}");
        assert!(object.points.is_some() && !object.interpolated && object.visibility.is_none());
    }
    let want = [
        (("CYCLIST", ObjectClass::Bicycle), 1),
        (("PEDESTRIAN", ObjectClass::Pedestrian), 12),
        (("SIGN", ObjectClass::Sign), 25),
        (("VEHICLE", ObjectClass::Car), 37),
    ];
    assert_eq!(counts, BTreeMap::from(want));
}

#[test]
fn the_map_of_the_first_frame_serves_all() {
    let Some([v1, v2]) = made() else { return };
    assert!(v1.capabilities().map && !v2.capabilities().map && v2.capabilities().boxes && v2.capabilities().text);
    assert_eq!(variant(&v2.local_map(0, 50.0).unwrap_err()), "Unsupported");
    assert_eq!(variant(&v2.projected_lidar_labels(0).unwrap_err()), "Unsupported");
    let maps: Vec<_> = (0..3).map(|index| v1.local_map(index, 1e4).unwrap()).collect();
    for (index, map) in maps.iter().enumerate() {
        let count = |kind| map.lines.iter().filter(|line| line.kind == kind).count();
        let kinds = [MapKind::Centerline, MapKind::Divider, MapKind::Boundary].map(count);
        assert_eq!((kinds, map.lines.len(), map.areas.len()), ([4, 3, 2], 9, 1));
        assert_eq!((map.areas[0].kind, map.areas[0].holes.len()), (MapKind::Crossing, 0));
        // Seen from any frame, the same points of the world.
        let (here, first) = (v1.frame(index).unwrap().world_from_ego, v1.frame(0).unwrap().world_from_ego);
        for (a, b) in map.lines.iter().zip(&maps[0].lines) {
            assert_eq!((a.kind, a.points.len()), (b.kind, b.points.len()));
            for (a, b) in a.points.iter().zip(&b.points) {
                assert!((here * DVec3::from_array(*a) - first * DVec3::from_array(*b)).length() < 1e-6);
            }
        }
        let nearest = map.lines.iter().filter(|line| line.kind == MapKind::Centerline).flat_map(|line| &line.points);
        let nearest = nearest.map(|point| point[0].hypot(point[1])).fold(f64::INFINITY, f64::min);
        assert!(nearest < 5.0, "the nearest lane point is {nearest} m away");
        let near = v1.local_map(index, 20.0).unwrap();
        assert!(!near.lines.is_empty());
        assert!(near.lines.iter().flat_map(|line| &line.points).all(|p| p[0].abs().max(p[1].abs()) < 20.0 + 1e-9));
    }
    let published = published().unwrap();
    assert_eq!(variant(&published.local_map(0, 50.0).unwrap_err()), "Missing", "a frame of a release before maps");
}

#[test]
fn configs_choose_cameras_classes_segments_and_frames() {
    let Some(root) = fixture("waymo") else { return };
    for (folder, release) in [("v1_made", WaymoRelease::V1), ("v2_made", WaymoRelease::V2)] {
        let base = config(&root.join(folder), release, "validation");
        let open = |change: &dyn Fn(&mut WaymoConfig)| {
            let mut config = base.clone();
            change(&mut config);
            Waymo::open(&config)
        };
        let few = open(&|c| c.cameras = vec!["FRONT_RIGHT".to_owned(), "FRONT".to_owned()]).unwrap();
        let channels = |index| few.frame(index).unwrap().views.into_iter().map(|v| v.channel).collect::<Vec<_>>();
        assert_eq!((few.max_views(), channels(0)), (2, vec!["FRONT".to_owned(), "FRONT_RIGHT".to_owned()]));
        let rules = [("CYCLIST", ClassRule::Drop), ("VEHICLE", ClassRule::As(ObjectClass::Truck))];
        let ruled = open(&|c| c.classes = rules.map(|(name, rule)| (name.to_owned(), rule)).into()).unwrap();
        let boxes = ruled.frame(0).unwrap().boxes.unwrap();
        assert!(boxes.len() < 7 && boxes.iter().any(|b| b.class == ObjectClass::Truck && b.source_class == "VEHICLE"));
        assert!(boxes.iter().all(|b| b.source_class != "CYCLIST" && b.class != ObjectClass::Car));
        let chosen = open(&|c| c.scenes = vec![SEGMENT.to_owned()]).unwrap();
        assert_eq!(chosen.len(), 3);
        assert_eq!(variant(&open(&|c| c.scenes = vec!["other".to_owned()]).unwrap_err()), "Missing");
        assert_eq!(variant(&open(&|c| c.split = "testing".to_owned()).unwrap_err()), "Empty");
        assert_eq!(variant(&open(&|c| c.cameras = vec!["REAR".to_owned()]).unwrap_err()), "Empty");
        let rest = open(&|c| c.exclude = vec!["1600000000000000".to_owned()]).unwrap();
        let names: Vec<String> = frames(&rest).into_iter().map(|frame| frame.id.frame).collect();
        assert_eq!(names, ["1600000000100000", "1600000000200000"]);
        if release == WaymoRelease::V1 {
            assert!(!rest.local_map(0, 50.0).unwrap().lines.is_empty(), "an excluded first frame still holds the map");
        }
        assert!(matches!(rest.frame(2), Err(DataError::Config(_))));
    }
}

#[test]
fn the_registry_opens_it_and_a_single_folder_is_a_split() {
    let Some(root) = fixture("waymo") else { return };
    let text = format!(
        r#"{{"kind": "waymo", "release": "v1", "root": {:?}, "split": ".", "name": "w"}}"#,
        root.join("v1_made/validation").to_str().unwrap()
    );
    let config: DatasetConfig = serde_json::from_str(&text).unwrap();
    let dataset = data::open(&config).unwrap();
    assert_eq!((dataset.len(), dataset.name()), (3, "w"));
    let frame = dataset.frame(2).unwrap();
    assert_eq!((frame.id.dataset.as_str(), frame.id.scene.as_str()), ("w", SEGMENT));
    assert!(picture_bytes(frame.views[0].image.as_ref()).starts_with(&[0xFF, 0xD8]));
}

#[test]
fn many_threads_read_the_same_frames() {
    let Some(datasets) = made() else { return };
    for dataset in &datasets {
        let alone = frames(dataset);
        std::thread::scope(|scope| {
            for turn in 0..8 {
                let alone = &alone;
                scope.spawn(move || {
                    for step in 0..6 {
                        let index = (turn + step) % 3;
                        assert_same(&dataset.frame(index).unwrap(), &alone[index], 0.0);
                    }
                });
            }
        });
    }
}
