//! The Waymo reader and writer: on the published files, on made ones against their goldens, on broken ones, and on what we write.

mod broken;
mod golden;
mod labels;
mod reading;
mod tables;
mod writing;

use std::path::{Path, PathBuf};

use data::waymo::{Waymo, WaymoConfig, WaymoRelease};
use data::{DataError, ImageSource, SceneDataset, SceneFrame};
use geometry::Rigid;
use serde_json::Value;

/// A folder below `RIGSCAPE_DATA`. Without the variable `None`, with a note; with it, a missing folder fails the test.
fn fixture(inside: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: RIGSCAPE_DATA is not set");
        return None;
    };
    let path = Path::new(&root).join(inside);
    assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
    Some(path)
}

fn config(root: &Path, release: WaymoRelease, split: &str) -> WaymoConfig {
    WaymoConfig { split: split.to_owned(), ..WaymoConfig::new(root, release) }
}

/// The made segment in both releases.
fn made() -> Option<[Waymo; 2]> {
    let root = fixture("waymo")?;
    let open = |folder: &str, release| Waymo::open(&config(&root.join(folder), release, "validation")).unwrap();
    Some([open("v1_made", WaymoRelease::V1), open("v2_made", WaymoRelease::V2)])
}

fn frames(dataset: &Waymo) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

fn json(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn floats<const N: usize>(value: &Value) -> [f64; N] {
    let list: Vec<f64> = value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect();
    list.try_into().unwrap()
}

/// Greatest difference between a pose and rows of a golden file.
fn pose_error(got: &Rigid, want: &Value) -> f64 {
    let rows = got.to_rows();
    let differences = rows.iter().zip(want.as_array().unwrap()).flat_map(|(row, want)| {
        let want: [f64; 4] = floats(want);
        std::array::from_fn::<f64, 4, _>(|i| (row[i] - want[i]).abs())
    });
    differences.fold(0.0, f64::max)
}

fn picture_bytes(image: Option<&ImageSource>) -> Vec<u8> {
    match image.unwrap() {
        ImageSource::Embedded { picture, .. } => picture.bytes().unwrap(),
        other => panic!("{other:?}"),
    }
}

/// Equal but for the rounding of poses.
fn assert_same(a: &SceneFrame, b: &SceneFrame, tolerance: f64) {
    let near = |a: &Rigid, b: &Rigid| {
        let difference = (a.translation - b.translation).length().max(a.angle_to(b));
        assert!(difference <= tolerance, "{difference}: {a:?} and {b:?}");
    };
    assert_eq!((&a.id.scene, &a.id.frame, a.timestamp_ns), (&b.id.scene, &b.id.frame, b.timestamp_ns));
    assert_eq!(a.scene_text, b.scene_text);
    near(&a.world_from_ego, &b.world_from_ego);
    assert_eq!(a.views.len(), b.views.len());
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!(
            (&a.channel, a.timestamp_ns, a.intrinsics, a.lens),
            (&b.channel, b.timestamp_ns, b.intrinsics, b.lens)
        );
        near(&a.world_from_ego, &b.world_from_ego);
        near(&a.ego_from_cam, &b.ego_from_cam);
        assert_eq!(picture_bytes(a.image.as_ref()), picture_bytes(b.image.as_ref()), "{}", a.channel);
    }
    assert_eq!(a.boxes.is_some(), b.boxes.is_some());
    let boxes = || a.boxes.iter().flatten().zip(b.boxes.iter().flatten());
    assert_eq!(a.boxes.iter().flatten().count(), b.boxes.iter().flatten().count());
    for (a, b) in boxes() {
        let velocity = |v: Option<[f64; 2]>| v.map(|v| v.map(|v| (v / tolerance.max(1e-9)).round()));
        assert_eq!((&a.track, a.class, &a.source_class, a.points), (&b.track, b.class, &b.source_class, b.points));
        assert_eq!((a.box3d, velocity(a.velocity)), (b.box3d, velocity(b.velocity)));
    }
}

fn variant(error: &DataError) -> &'static str {
    match error {
        DataError::Missing { .. } => "Missing",
        DataError::Format { format: "Parquet", .. } => "Parquet",
        DataError::Format { .. } => "Proto",
        DataError::Column { .. } => "Column",
        DataError::Checksum { .. } => "Crc",
        DataError::Truncated { .. } => "Truncated",
        DataError::Dangling { .. } => "Dangling",
        DataError::DuplicateToken { .. } => "DuplicateToken",
        DataError::Calibration { .. } => "Calibration",
        DataError::Annotation { .. } => "Annotation",
        DataError::Image { .. } => "Image",
        DataError::ImageSize { .. } => "ImageSize",
        DataError::UnknownClass { .. } => "UnknownClass",
        DataError::Empty { .. } => "Empty",
        DataError::Unsupported { .. } => "Unsupported",
        DataError::Config(_) => "Config",
        _ => "another",
    }
}
