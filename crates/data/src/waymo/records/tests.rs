//! On records made here field by field, as other writers of the format might.

use geometry::glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::super::{Waymo, WaymoConfig, WaymoRelease, raw};
use super::*;
use crate::tfrecord::tests::encode;
use crate::{ImageSource, MapKind, SceneDataset};

const MICROS: i64 = 1_553_735_853_462_203;

fn transform(x: f64) -> proto::Transform {
    let pose = Rigid::from_yaw(0.5, DVec3::new(x, 20.0, 3.0));
    proto::Transform { transform: cameras::pose_numbers(&pose).to_vec() }
}

fn calibration(name: i32) -> proto::CameraCalibration {
    let yaw = [0.0, 0.0, 0.8, -0.8, 1.6, -1.6][name as usize];
    proto::CameraCalibration {
        name: Some(name),
        intrinsic: vec![40.0, 40.0, 24.0, 14.0, 0.01, 0.0, 0.0, 0.0, 0.0],
        vehicle_from_camera: Some(proto::Transform {
            transform: cameras::pose_numbers(&Rigid::from_yaw(yaw, DVec3::ZERO)).to_vec(),
        }),
        width: Some(48),
        height: Some(28),
    }
}

fn image(name: i32) -> proto::CameraImage {
    proto::CameraImage {
        name: Some(name),
        image: Some(Bytes::from(format!("picture of camera {name}"))),
        pose: Some(transform(10.0 + f64::from(name))),
        pose_timestamp: Some(MICROS as f64 * 1e-6 + 0.01 * f64::from(name)),
    }
}

/// Pictures in the order of the published files.
fn frame(micros: i64) -> proto::Frame {
    let stats = proto::Stats { weather: Some("sunny".to_owned()), ..proto::Stats::default() };
    proto::Frame {
        context: Some(proto::Context { camera_calibrations: (1..=5).map(calibration).collect(), stats: Some(stats) }),
        timestamp_micros: Some(micros),
        pose: Some(transform(10.0)),
        images: [1, 2, 4, 3, 5].map(image).to_vec(),
        ..proto::Frame::default()
    }
}

fn label(metadata: Option<proto::Metadata>) -> proto::Label {
    let numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 0.25].map(Some);
    let [center_x, center_y, center_z, width, length, height, heading] = numbers;
    proto::Label {
        r#box: Some(proto::LabelBox { center_x, center_y, center_z, width, length, height, heading }),
        metadata,
        r#type: Some(1),
        id: Some("x".to_owned()),
        num_lidar_points_in_box: None,
    }
}

struct Split {
    folder: tempfile::TempDir,
}

impl Split {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap() }
    }

    fn open(&self, payloads: &[Vec<u8>]) -> Result<Waymo, DataError> {
        std::fs::create_dir_all(self.folder.path().join("training")).unwrap();
        let path = self.folder.path().join("training/segment-s_with_camera_labels.tfrecord");
        std::fs::write(path, encode(payloads)).unwrap();
        Waymo::open(&WaymoConfig::new(self.folder.path(), WaymoRelease::V1))
    }

    fn frames(&self, frames: &[proto::Frame]) -> Result<Waymo, DataError> {
        self.open(&frames.iter().map(Message::encode_to_vec).collect::<Vec<_>>())
    }
}

/// A field of bytes as it stands in a message.
fn field(number: u32, bytes: &[u8]) -> Vec<u8> {
    let mut out = Vec::new();
    prost::encoding::encode_key(number, prost::encoding::WireType::LengthDelimited, &mut out);
    prost::encoding::encode_varint(bytes.len() as u64, &mut out);
    out.extend(bytes);
    out
}

fn picture(image: Option<&ImageSource>) -> String {
    match image.unwrap() {
        ImageSource::Embedded { picture, .. } => String::from_utf8(picture.bytes().unwrap()).unwrap(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn pictures_are_found_by_name_behind_megabytes_of_lasers() {
    let whole = frame(MICROS);
    let pictures = proto::Frame { images: whole.images.clone(), ..proto::Frame::default() }.encode_to_vec();
    let rest = proto::Frame { images: Vec::new(), ..whole }.encode_to_vec();
    let lasers = field(5, &vec![0x5A; 16 << 20]);
    let payload = [&rest[..], &lasers, &pictures].concat();
    // What is decoded neither holds the lasers nor copies a picture.
    let shared = Bytes::from(payload.clone());
    let decoded = proto::Frame::decode(shared.clone()).unwrap();
    assert!(decoded.encoded_len() < 10_000);
    for image in &decoded.images {
        let offset = offset_in(&shared, image.image.as_ref().unwrap()).unwrap();
        assert!(offset > 16 << 20);
    }
    assert_eq!(offset_in(&shared, &Bytes::from_static(b"elsewhere")), None);
    let split = Split::new();
    let frame = split.open(&[payload]).unwrap().frame(0).unwrap();
    assert_eq!(
        (frame.views[0].channel.as_str(), picture(frame.views[0].image.as_ref())),
        ("SIDE_LEFT", "picture of camera 4".to_owned())
    );
    assert_eq!(picture(frame.views[3].image.as_ref()), "picture of camera 3");
}

#[test]
fn rows_carry_their_own_pose_and_time() {
    let split = Split::new();
    let dataset = split.frames(&[frame(MICROS), frame(MICROS + 100_000)]).unwrap();
    assert_eq!((dataset.len(), dataset.max_views()), (2, 5));
    let frame = dataset.frame(0).unwrap();
    let order = [("SIDE_LEFT", 4), ("FRONT_LEFT", 2), ("FRONT", 1), ("FRONT_RIGHT", 3), ("SIDE_RIGHT", 5)];
    for (view, (channel, number)) in frame.views.iter().zip(order) {
        assert_eq!(
            (view.channel.as_str(), picture(view.image.as_ref())),
            (channel, format!("picture of camera {number}"))
        );
        assert!((view.world_from_ego.translation.x - 10.0 - f64::from(number)).abs() < 1e-12);
        let late_ns = view.timestamp_ns - MICROS * 1000;
        assert!((late_ns - 10_000_000 * i64::from(number)).abs() < 300);
        assert_eq!((view.intrinsics.cx, view.intrinsics.cy), (24.5, 14.5));
    }
    assert_eq!(frame.timestamp_ns, raw::reference_ns(MICROS));
    assert_eq!((frame.boxes, frame.scene_text.as_deref()), (None, Some("sunny")));
}

#[test]
fn packed_and_unpacked_numbers_are_the_same() {
    let unpacked = frame(MICROS);
    let numbers: Vec<u8> = transform(10.0).transform.iter().flat_map(|v| v.to_le_bytes()).collect();
    let packed_pose = field(3, &field(1, &numbers));
    let without = proto::Frame { pose: None, ..unpacked.clone() };
    let packed = [without.encode_to_vec(), packed_pose].concat();
    assert!(packed.len() < unpacked.encoded_len());
    let split = Split::new();
    let a = split.open(&[packed]).unwrap().frame(0).unwrap().world_from_ego;
    assert_eq!(a, split.frames(&[unpacked]).unwrap().frame(0).unwrap().world_from_ego);
}

#[test]
fn labels_keep_length_and_width_and_turn_velocities_into_the_ego_frame() {
    let (sin, cos) = 0.5_f64.sin_cos();
    let moving = proto::Metadata { speed_x: Some(3.0 * cos), speed_y: Some(3.0 * sin), speed_z: None };
    let mut labelled = frame(MICROS);
    labelled.laser_labels = vec![label(Some(moving)), label(None)];
    let split = Split::new();
    let boxes = split.frames(&[labelled]).unwrap().frame(0).unwrap().boxes.unwrap();
    assert_eq!((boxes[0].box3d.center, boxes[0].box3d.size), (DVec3::new(1.0, 2.0, 3.0), DVec3::new(5.0, 4.0, 6.0)));
    assert_eq!((boxes[0].box3d.yaw, boxes[1].velocity, boxes[1].points), (0.25, None, None));
    // The car heads 0.5 rad off the world's x axis, and so does the object.
    let [x, y] = boxes[0].velocity.unwrap();
    assert!((x - 3.0).abs() < 1e-12 && y.abs() < 1e-12, "{x} {y}");
}

#[test]
fn a_counted_segment_without_labels_in_a_frame_is_annotated_there() {
    let split = Split::new();
    let mut counted = frame(MICROS);
    if let Some(stats) = counted.context.as_mut().and_then(|context| context.stats.as_mut()) {
        stats.laser_object_counts = vec![proto::ObjectCount {}];
    }
    assert_eq!(split.frames(&[counted]).unwrap().frame(0).unwrap().boxes, Some(Vec::new()));
    assert_eq!(split.frames(&[frame(MICROS)]).unwrap().frame(0).unwrap().boxes, None);
}

#[test]
fn a_drifted_pose_is_corrected_on_the_map_and_nowhere_else() {
    let point = |x: f64, y: f64| proto::Point { x: Some(x), y: Some(y), z: Some(3.0) };
    let line = proto::Line { polyline: vec![point(11.0, 20.0), point(12.0, 20.0)] };
    let map = proto::MapFrame {
        map_features: vec![proto::MapFeature { road_line: Some(line), ..proto::MapFeature::default() }],
    };
    let first = [frame(MICROS).encode_to_vec(), map.encode_to_vec()].concat();
    let offset = proto::Point { x: Some(1.0), y: None, z: None };
    let drifted = proto::Frame { map_pose_offset: Some(offset), ..frame(MICROS + 100_000) };
    let split = Split::new();
    let dataset = split.open(&[first, drifted.encode_to_vec()]).unwrap();
    for (index, ahead) in [(0, 1.0), (1, 0.0)] {
        let local = dataset.local_map(index, 30.0).unwrap();
        assert_eq!((local.lines.len(), local.lines[0].kind), (1, MapKind::Divider));
        let [x, y, z] = local.lines[0].points[0];
        // One metre along the world's x axis, which lies 0.5 rad to the right of the car.
        let want = DVec3::new(ahead * 0.5_f64.cos(), -ahead * 0.5_f64.sin(), 0.0);
        assert!(DVec3::new(x, y, z).distance(want) < 1e-12);
        assert_eq!(dataset.frame(index).unwrap().world_from_ego.translation.x, 10.0);
    }
}

#[test]
fn faults_name_file_and_row() {
    let split = Split::new();
    let fails = |change: &dyn Fn(&mut proto::Frame)| {
        let mut broken = frame(MICROS);
        change(&mut broken);
        let error = split.frames(&[broken]).and_then(|dataset| dataset.frame(0)).unwrap_err();
        let named = error.to_string().ends_with("segment-s_with_camera_labels.tfrecord");
        assert!(named || matches!(error, DataError::UnknownClass { .. }), "{error}");
        error
    };
    let cameras = |frame: &mut proto::Frame, change: &dyn Fn(&mut Vec<proto::CameraCalibration>)| {
        change(&mut frame.context.as_mut().unwrap().camera_calibrations);
    };
    assert!(matches!(fails(&|f| f.pose = None), DataError::Calibration { .. }));
    assert!(matches!(fails(&|f| f.timestamp_micros = None), DataError::Format { .. }));
    assert!(matches!(fails(&|f| f.context = None), DataError::Format { .. }));
    assert!(
        matches!(fails(&|f| f.images[0].pose = None), DataError::Calibration { row, .. } if row.ends_with("camera 1"))
    );
    assert!(matches!(fails(&|f| f.images[0].pose_timestamp = None), DataError::Format { .. }));
    assert!(matches!(fails(&|f| f.images[0].name = Some(2)), DataError::DuplicateToken { .. }));
    assert!(matches!(fails(&|f| f.images[0].name = Some(8)), DataError::Dangling { .. }));
    assert!(matches!(fails(&|f| cameras(f, &|all| all[0].name = Some(9))), DataError::Column { .. }));
    assert!(matches!(fails(&|f| cameras(f, &|all| all[0].name = Some(2))), DataError::DuplicateToken { .. }));
    assert!(matches!(fails(&|f| cameras(f, &|all| all[0].width = Some(-4))), DataError::Calibration { .. }));
    assert!(matches!(fails(&|f| cameras(f, &|all| all[0].intrinsic[0] = 0.0)), DataError::Calibration { .. }));
    let labelled = |change: fn(&mut proto::Label)| {
        fails(&|f| {
            let mut broken = label(None);
            change(&mut broken);
            f.laser_labels = vec![broken];
        })
    };
    assert!(matches!(labelled(|l| l.r#box = None), DataError::Annotation { .. }));
    assert!(matches!(labelled(|l| l.r#box.as_mut().unwrap().length = Some(-1.0)), DataError::Annotation { .. }));
    assert!(matches!(labelled(|l| l.r#type = Some(12)), DataError::UnknownClass { name, .. } if name == "12"));
    let backwards = split.frames(&[frame(MICROS), frame(MICROS - 1)]).unwrap_err();
    assert!(matches!(backwards, DataError::Format { why, .. } if why.contains("comes after")));
}

#[test]
fn mutated_payloads_with_right_checksums_never_panic() {
    let (mut rng, split) = (ChaCha8Rng::seed_from_u64(4), Split::new());
    let mut whole = frame(MICROS);
    whole.laser_labels = vec![label(None)];
    let sound = whole.encode_to_vec();
    let mut refused = 0;
    for _ in 0..1500 {
        let mut payload = sound.clone();
        for _ in 0..rng.random_range(1..5) {
            let at = rng.random_range(0..payload.len());
            match rng.random_range(0..5) {
                0 => payload.truncate(at.max(1)),
                1 => drop(payload.splice(at..at, (0..rng.random_range(1..9)).map(|_| rng.random::<u8>()))),
                _ => payload[at] = rng.random(),
            }
        }
        let frame = split.open(&[payload]).and_then(|dataset| {
            // These pictures are no pictures, and there is no map.
            assert!(dataset.local_map(0, 10.0).is_err());
            dataset.frame(0)
        });
        match frame {
            Ok(frame) => {
                let pictures = frame.views.iter().filter_map(|view| view.image.as_ref());
                assert!(pictures.map(ImageSource::decode).all(|picture| picture.is_err()));
            }
            Err(_) => refused += 1,
        }
    }
    // The rest of the changes hit numbers and texts that may have any value.
    assert!((500..1450).contains(&refused), "{refused}");
}
