//! The reader on the fixture log: frames, rig, filters, velocities, map.

use std::collections::HashSet;

use data::argoverse2::{Argoverse2, Argoverse2Config, FrameChoice, Split};
use data::{DataError, MapKind, SceneDataset, check};
use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};

use super::{LOG, copy, fixture, frames, open, tables};

const RING: [&str; 7] = [
    "ring_front_center",
    "ring_front_right",
    "ring_side_right",
    "ring_rear_right",
    "ring_rear_left",
    "ring_side_left",
    "ring_front_left",
];

fn config(change: impl FnOnce(&mut Argoverse2Config)) -> Option<Argoverse2Config> {
    let mut config = Argoverse2Config::new(fixture("argoverse2")?);
    change(&mut config);
    Some(config)
}

#[test]
fn the_log_gives_its_three_frames_with_the_ring() {
    let Some(config) = config(|_| ()) else { return };
    let dataset = open(&config);
    let info = &dataset.logs()[0];
    assert_eq!((info.name.as_str(), info.split, info.city.as_deref()), (LOG, Some("val"), Some("PIT")));
    assert_eq!((info.frames.clone(), info.bare_instants), (0..3, 153));
    let stamps = [315_966_265_259_836_000, 315_966_265_360_032_000, 315_966_265_459_565_000];
    for (frame, stamp) in frames(&dataset).iter().zip(stamps) {
        assert_eq!((frame.timestamp_ns, frame.id.frame.as_str()), (stamp, stamp.to_string().as_str()));
        let rig = frame.rig();
        let channels: Vec<&str> = rig.cameras.iter().map(|camera| camera.channel.as_str()).collect();
        assert_eq!(channels, RING);
        assert_eq!(rig.clockwise_order(), [0, 1, 2, 3, 4, 5, 6], "the list agrees with the calibration");
        assert!(rig.adjacency().unwrap().closed);
        let front = &rig.cameras[0];
        assert_eq!((front.intrinsics.width, front.intrinsics.height), (1550, 2048));
        assert!(front.ego_from_cam.translation.x > 0.0 && front.azimuth().abs() < 0.09);
        assert!((front.intrinsics.cx - 778.4906).abs() < 1e-4 && (front.intrinsics.cy - 1014.0243).abs() < 1e-4);
        for view in &frame.views {
            let picture = view.image.as_ref().unwrap().decode().unwrap();
            assert_eq!(picture.dimensions(), (view.intrinsics.width, view.intrinsics.height));
            assert_eq!(view.lens, geometry::Lens::Pinhole);
        }
        for found in frame.boxes.as_ref().unwrap().iter().filter(|found| found.source_class == "REGULAR_VEHICLE") {
            assert!(found.box3d.size.x > found.box3d.size.y, "a car is longer than wide");
        }
    }
    let report = check(&dataset, 2).unwrap();
    assert!(report.is_sound(), "{:?}", report.problems);
    assert_eq!((report.frames, report.pictures, report.absent_views, report.decoded), (3, 21, 0, 2));
    assert_eq!(dataset.max_views(), 7);
}

#[test]
fn splits_logs_cameras_and_sets_are_chosen() {
    let Some(base) = config(|_| ()) else { return };
    assert_eq!(open(&Argoverse2Config { split: Split::Val, ..base.clone() }).len(), 3);
    let train = Argoverse2::open(&Argoverse2Config { split: Split::Train, ..base.clone() });
    assert!(matches!(train, Err(DataError::Empty { .. })));
    assert_eq!(open(&Argoverse2Config { logs: vec![LOG.into()], ..base.clone() }).len(), 3);
    // The stereo cameras are calibrated but have no pictures here.
    let cameras: Vec<String> = ["stereo_front_left", "ring_rear_left"].map(String::from).to_vec();
    let dataset = open(&Argoverse2Config { cameras, ..base.clone() });
    let frame = dataset.frame(1).unwrap();
    assert_eq!(frame.views.iter().map(|view| view.image.is_some()).collect::<Vec<_>>(), [false, true]);
    assert_eq!(frame.views[0].timestamp_ns, frame.timestamp_ns);
    let cameras = dataset.frame(1).unwrap().rig();
    assert_eq!(cameras.cameras[0].channel, "stereo_front_left");
    let all = open(&Argoverse2Config { frames: FrameChoice::AllPictures, ..base.clone() });
    assert_eq!(frames(&all).iter().filter(|frame| frame.boxes.is_some()).count(), 3);
    let strict = open(&Argoverse2Config {
        cameras: vec!["stereo_front_left".into(), "ring_rear_left".into()],
        require_all_views: true,
        ..base
    });
    assert_eq!(strict.len(), 0);
}

#[test]
fn a_lost_picture_is_a_view_without_image_or_leaves_the_frame_out() {
    let Some(root) = fixture("argoverse2/sensor/val") else { return };
    let folder = tempfile::tempdir().unwrap();
    copy(&root, folder.path());
    let lost = folder.path().join(LOG).join("sensors/cameras/ring_side_left/315966265342441193.jpg");
    std::fs::remove_file(lost).unwrap();
    let base = Argoverse2Config::new(folder.path());
    let frame = open(&base).frame(1).unwrap();
    let view = frame.views.iter().find(|view| view.channel == "ring_side_left").unwrap();
    assert!(view.image.is_none());
    // Where its neighbours in time were, 17 ms before the lidar.
    assert!((view.timestamp_ns - 315_966_265_342_441_193).abs() < 1_000_000);
    assert!((view.world_from_ego.translation - frame.world_from_ego.translation).length() < 0.2);
    assert_eq!(open(&Argoverse2Config { require_all_views: true, ..base.clone() }).len(), 2);
    // A camera that the intrinsics lack is absent, the others stay.
    tables::retain(&folder.path().join(LOG).join("calibration/intrinsics.feather"), "sensor_name", |name| {
        name != "ring_side_left"
    });
    let strict = open(&Argoverse2Config { require_all_views: true, ..base });
    assert_eq!((strict.len(), strict.max_views()), (3, 6));
    assert!(strict.frame(0).unwrap().views.iter().all(|view| view.channel != "ring_side_left"));
}

#[test]
fn boxes_are_filtered_only_when_asked() {
    let Some(base) = config(|_| ()) else { return };
    let count = |config: &Argoverse2Config| open(config).frame(0).unwrap().boxes.unwrap();
    let all = count(&base);
    let annotations = base.root.as_slice()[0].path.join("sensor/val").join(LOG).join("annotations.feather");
    let stamps = tables::integers(&annotations, "timestamp_ns");
    assert_eq!(all.len(), stamps.iter().filter(|stamp| **stamp == 315_966_265_259_836_000).count());
    let near = count(&Argoverse2Config { max_range_m: Some(50.0), ..base.clone() });
    let in_range = |found: &data::ObjectBox| found.box3d.center.truncate().length() <= 50.0;
    assert!(near.len() < all.len() && near.iter().all(in_range));
    assert_eq!(near.len(), all.iter().filter(|found| in_range(found)).count());
    let seen = count(&Argoverse2Config { min_points: 1, ..base });
    assert!(seen.len() < all.len());
    assert_eq!(seen.len(), all.iter().filter(|found| found.points.unwrap() > 0).count());
}

#[test]
fn velocities_are_central_differences_over_the_track() {
    let Some(base) = config(|_| ()) else { return };
    let log = base.root.as_slice()[0].path.join("sensor/val").join(LOG);
    let annotations = log.join("annotations.feather");
    let stamps = tables::integers(&annotations, "timestamp_ns");
    let tracks = tables::texts(&annotations, "track_uuid");
    let [x, y, z] = ["tx_m", "ty_m", "tz_m"].map(|name| tables::floats(&annotations, name));
    let poses = log.join("city_SE3_egovehicle.feather");
    let pose_stamps = tables::integers(&poses, "timestamp_ns");
    let pose = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"].map(|name| tables::floats(&poses, name));
    let at = |stamp: i64| {
        let row = pose_stamps.iter().position(|other| *other == stamp).unwrap();
        let [w, qx, qy, qz, tx, ty, tz] = pose.each_ref().map(|column| column[row]);
        Rigid::from_wxyz([w, qx, qy, qz], [tx, ty, tz]).unwrap()
    };
    let (mut compared, mut moving) = (0, 0);
    for frame in frames(&open(&base)) {
        for found in frame.boxes.as_ref().unwrap() {
            let mut rows: Vec<usize> = (0..stamps.len()).filter(|row| tracks[*row] == found.track).collect();
            rows.sort_by_key(|row| stamps[*row]);
            let place = rows.iter().position(|row| stamps[*row] == frame.timestamp_ns).unwrap();
            let (first, last) = (rows[place.saturating_sub(1)], rows[(place + 1).min(rows.len() - 1)]);
            let world = |row: usize| at(stamps[row]) * DVec3::new(x[row], y[row], z[row]);
            let secs = (stamps[last] - stamps[first]) as f64 * 1e-9;
            let limit = if first == rows[place] || last == rows[place] { 1.5 } else { 3.0 };
            if secs <= 0.0 || secs > limit {
                assert_eq!(found.velocity, None);
                continue;
            }
            let want = frame.world_from_ego.inverse().transform_vector((world(last) - world(first)) / secs);
            let got = found.velocity.unwrap();
            assert!((got[0] - want.x).abs() < 1e-6 && (got[1] - want.y).abs() < 1e-6, "{got:?} instead of {want}");
            compared += 1;
            moving += usize::from(want.length() > 2.0);
        }
    }
    assert!(compared > 150 && moving > 5, "{compared} {moving}");
}

#[test]
fn the_map_has_its_kinds_once_and_is_cut_at_the_square() {
    let Some(base) = config(|_| ()) else { return };
    let dataset = open(&base);
    assert!(dataset.capabilities().map);
    let map = dataset.city_map(0).unwrap();
    assert_eq!((map.pedestrian_crossings.len(), map.lane_segments.len(), map.drivable_areas.len()), (11, 183, 13));
    let known: HashSet<i64> = map.lane_segments.values().map(|lane| lane.id).collect();
    assert!(map.lane_segments.values().flat_map(|lane| &lane.successors).any(|id| !known.contains(id)));
    let half = 30.0;
    let local = dataset.local_map(0, half).unwrap();
    for kind in [MapKind::Divider, MapKind::Boundary, MapKind::Centerline] {
        assert!(local.lines.iter().any(|line| line.kind == kind), "{kind:?}");
    }
    assert!(local.areas.iter().any(|area| area.kind == MapKind::Crossing));
    let border = half + 1e-9;
    for line in &local.lines {
        assert!(line.points.len() > 1 && line.points.iter().all(|[x, y, _]| x.abs() <= border && y.abs() <= border));
        // The ego frame lies 0.3 m above a road that rises slowly.
        assert!(line.points.iter().all(|[_, _, z]| z.abs() < 3.0));
    }
    // The whole map: every painted boundary once, in either direction.
    let whole = dataset.local_map(0, 1e4).unwrap();
    let mut painted = HashSet::new();
    for lane in map.lane_segments.values() {
        for (line, mark) in [
            (&lane.left_lane_boundary, &lane.left_lane_mark_type),
            (&lane.right_lane_boundary, &lane.right_lane_mark_type),
        ] {
            let mut text: Vec<String> = line.iter().map(|point| format!("{} {}", point.x, point.y)).collect();
            let back: Vec<String> = text.iter().rev().cloned().collect();
            text = text.min(back);
            if mark != "NONE" && mark != "UNKNOWN" {
                painted.insert(text);
            }
        }
    }
    let count = |kind: MapKind| whole.lines.iter().filter(|line| line.kind == kind).count();
    assert_eq!(count(MapKind::Divider), painted.len());
    assert_eq!(count(MapKind::Centerline), 183);
    assert_eq!(whole.areas.iter().filter(|area| area.kind == MapKind::Crossing).count(), 11);
    let boundary = whole.lines.iter().filter(|line| line.kind == MapKind::Boundary);
    let length: f64 = boundary
        .flat_map(|line| line.points.windows(2))
        .map(|pair| DVec2::new(pair[1][0] - pair[0][0], pair[1][1] - pair[0][1]).length())
        .sum();
    // Outline of the union of the thirteen polygons by GEOS, which knows no seam width.
    assert!((length - 6794.0).abs() < 1.0, "{length} m");
    assert!(matches!(dataset.local_map(0, -1.0), Err(DataError::Config(_))));
    assert!(matches!(dataset.occupancy(0), Err(DataError::Unsupported { .. })));
}

#[test]
fn a_map_with_bare_nan_loads_and_a_log_without_map_says_so() {
    let Some(root) = fixture("argoverse2/sensor/val") else { return };
    let folder = tempfile::tempdir().unwrap();
    copy(&root, folder.path());
    let maps = folder.path().join(LOG).join("map");
    let archive = maps.join(format!("log_map_archive_{LOG}____PIT_city_47896.json"));
    let text = std::fs::read_to_string(&archive).unwrap();
    std::fs::write(&archive, text.replacen("\"z\": 69.5", "\"z\": NaN", 1)).unwrap();
    let dataset = open(&Argoverse2Config::new(folder.path()));
    let map = dataset.city_map(0).unwrap();
    assert!(map.pedestrian_crossings.values().flat_map(|c| &c.edge1).all(|point| point.z.is_finite()));
    std::fs::copy(&archive, maps.join("log_map_archive_other.json")).unwrap();
    let two = Argoverse2::open(&Argoverse2Config::new(folder.path()));
    assert!(matches!(two, Err(DataError::Format { .. })));
    std::fs::remove_dir_all(&maps).unwrap();
    let dataset = open(&Argoverse2Config::new(folder.path()));
    assert!(!dataset.capabilities().map);
    for error in [dataset.local_map(0, 10.0).unwrap_err(), dataset.ground_height(0).unwrap_err()] {
        assert!(matches!(&error, DataError::Missing { path, .. } if path.ends_with("map")), "{error}");
    }
}
