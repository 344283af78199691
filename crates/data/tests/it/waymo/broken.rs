//! Broken files: every fault is a typed error that names the file.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arrow_array::cast::AsArray;
use arrow_array::types::Int8Type;
use arrow_array::{Array, Float64Array, Int8Array, StringArray};
use data::waymo::{Waymo, WaymoRelease};
use data::{DataError, SceneDataset};
use parquet::basic::Compression;
use rand::{RngExt, SeedableRng};

use super::tables::{copy, rewrite, table};
use super::{config, fixture, variant};

/// Opens a split, reads every frame and decodes every picture; the first error.
fn read_everything(root: &Path, release: WaymoRelease) -> Result<Waymo, DataError> {
    let dataset = Waymo::open(&config(root, release, "."))?;
    for index in 0..dataset.len() {
        for view in dataset.frame(index)?.views {
            view.image.map(|image| image.decode()).transpose()?;
        }
    }
    Ok(dataset)
}

/// Name and expected behaviour of the fixture's cases, from its README.
fn cases(group: &str) -> Option<Vec<(String, String)>> {
    let readme = std::fs::read_to_string(fixture("malformed")?.join("README.md")).unwrap();
    let rows = readme.lines().filter_map(|line| {
        let mut cells = line.strip_prefix('|')?.trim_end().strip_suffix('|')?.split(" | ").map(str::trim);
        let case = cells.next()?.trim_matches('`').strip_prefix(group)?.to_owned();
        Some((case, cells.nth(1)?.to_owned()))
    });
    let rows: Vec<_> = rows.collect();
    let files = std::fs::read_dir(fixture("malformed")?.join(group)).unwrap().count();
    assert_eq!(rows.len(), files, "the README lists every case of {group}");
    Some(rows)
}

#[test]
fn the_record_cases_of_the_fixture_folder() {
    let Some(cases) = cases("tfrecord/") else { return };
    for (case, want) in cases {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("segment-seg_x_with_camera_labels.tfrecord");
        std::fs::copy(fixture("malformed/tfrecord").unwrap().join(&case), &path).unwrap();
        let start = Instant::now();
        let outcome = read_everything(folder.path(), WaymoRelease::V1);
        assert!(start.elapsed() < Duration::from_secs(2), "{case} took {:?}", start.elapsed());
        if want.starts_with("loads") {
            let dataset = outcome.unwrap_or_else(|error| panic!("{case}: {error}"));
            assert_eq!((dataset.len(), dataset.max_views()), (2, 1));
            let frame = dataset.frame(1).unwrap();
            assert_eq!((frame.id.scene.as_str(), frame.views[0].intrinsics.width), ("seg_x", 48));
            assert!(frame.boxes.is_none(), "a segment without labels is not annotated");
            continue;
        }
        let error = outcome.err().unwrap_or_else(|| panic!("{case} loads, but {want}"));
        let allowed: Vec<&str> = want.split(|c: char| !c.is_ascii_alphanumeric()).collect();
        assert!(allowed.contains(&variant(&error)), "{case} gave {error:?}, wanted {want}");
        let inside = if want.contains("Empty") { folder.path() } else { &path };
        let text = error.to_string();
        assert!(text.trim_end_matches('/').ends_with(inside.to_str().unwrap()), "{case}: {text}");
        match (case.as_str(), error) {
            ("bad_length_crc.tfrecord", DataError::Checksum { offset, .. }) => assert_eq!(offset, 0),
            ("bad_data_crc.tfrecord", DataError::Checksum { offset, .. }) => {
                assert_eq!(offset, 974 + 12);
                let dataset = Waymo::open(&config(folder.path(), WaymoRelease::V1, ".")).unwrap();
                dataset.frame(0).unwrap();
                assert_eq!(variant(&dataset.frame(1).unwrap_err()), "Crc");
            }
            ("truncated.tfrecord", DataError::Truncated { offset, .. }) => assert_eq!(offset, 1928),
            _ => {}
        }
    }
}

/// A sound split of the segment that the parquet cases belong to: one camera, one frame.
fn sound(folder: &Path) -> PathBuf {
    copy(&fixture("waymo/v2_made/validation").unwrap(), folder);
    for component in ["camera_image", "vehicle_pose", "lidar_box", "stats", "camera_calibration"] {
        let (old, new) = (table(folder, component), folder.join(component).join("seg_x.parquet"));
        std::fs::rename(old, &new).unwrap();
        rewrite(&new, Compression::SNAPPY, |name, array| match name {
            "key.segment_context_name" => Some(Arc::new(StringArray::from(vec!["seg_x"; array.len()]))),
            "key.camera_name" if component == "camera_image" => Some(Arc::new(Int8Array::from(vec![1; array.len()]))),
            _ => Some(array.clone()),
        });
    }
    folder.join("camera_calibration/seg_x.parquet")
}

#[test]
fn the_table_cases_of_the_fixture_folder() {
    let Some(cases) = cases("parquet/") else { return };
    for (case, want) in cases {
        let folder = tempfile::tempdir().unwrap();
        let path = sound(folder.path());
        std::fs::copy(fixture("malformed/parquet").unwrap().join(&case), &path).unwrap();
        let start = Instant::now();
        let outcome = Waymo::open(&config(folder.path(), WaymoRelease::V2, "."));
        assert!(start.elapsed() < Duration::from_secs(2), "{case} took {:?}", start.elapsed());
        if want.starts_with("loads") {
            assert_eq!(outcome.unwrap().max_views(), 1);
            continue;
        }
        let error = outcome.err().unwrap_or_else(|| panic!("{case} loads, but {want}"));
        let want = match case.as_str() {
            "missing_column.parquet" | "camera_name_unknown.parquet" => "Column",
            _ => "Parquet",
        };
        assert_eq!(variant(&error), want, "{case} gave {error:?}");
        let text = error.to_string();
        assert!(text.ends_with(path.to_str().unwrap()), "{text}");
        assert!(!case.starts_with("missing") || text.contains("intrinsic.c_v"), "{text}");
        assert!(!case.starts_with("camera_name") || text.contains("TOP"), "{text}");
    }
}

/// The made split with one change; the first error and whether its text ends with that component's table.
fn changed(
    component: &str,
    change: impl Fn(&str, &arrow_array::ArrayRef) -> Option<arrow_array::ArrayRef>,
) -> DataError {
    let folder = tempfile::tempdir().unwrap();
    copy(&fixture("waymo/v2_made/validation").unwrap(), folder.path());
    let path = table(folder.path(), component);
    rewrite(&path, Compression::SNAPPY, change);
    let error = read_everything(folder.path(), WaymoRelease::V2).expect_err("a broken table");
    let named = error.to_string().ends_with(path.to_str().unwrap()) || matches!(error, DataError::UnknownClass { .. });
    assert!(named, "{error}");
    error
}

#[test]
fn joins_and_numbers_are_checked() {
    if fixture("waymo").is_none() {
        return;
    }
    let set = |component: &str, column: &str, row: usize, value: f64| {
        changed(component, |name, array| {
            if !name.ends_with(column) {
                return Some(array.clone());
            }
            let numbers = array.as_primitive_opt::<arrow_array::types::Float64Type>();
            if let Some(numbers) = numbers {
                let values = numbers.iter().enumerate().map(|(at, old)| if at == row { Some(value) } else { old });
                return Some(Arc::new(values.collect::<Float64Array>()));
            }
            if let Some(numbers) = array.as_primitive_opt::<Int8Type>() {
                let values =
                    numbers.iter().enumerate().map(|(at, old)| if at == row { Some(value as i8) } else { old });
                return Some(Arc::new(values.collect::<Int8Array>()));
            }
            let numbers = array.as_primitive::<arrow_array::types::Int64Type>();
            let values = numbers.iter().enumerate().map(|(at, old)| if at == row { Some(value as i64) } else { old });
            Some(Arc::new(values.collect::<arrow_array::Int64Array>()))
        })
    };
    let cases = [
        ("lidar_box", "box.size.y", f64::NAN, "Annotation"),
        ("lidar_box", "box.size.x", 0.0, "Annotation"),
        ("lidar_box", "speed.x", f64::INFINITY, "Annotation"),
        ("lidar_box", "num_lidar_points_in_box", -1.0, "Annotation"),
        ("lidar_box", "Component].type", 9.0, "UnknownClass"),
        ("lidar_box", "frame_timestamp_micros", 5.0, "Dangling"),
        ("camera_image", "frame_timestamp_micros", 5.0, "Dangling"),
        ("camera_image", "camera_name", 7.0, "Dangling"),
        ("camera_image", "camera_name", 2.0, "DuplicateToken"),
        ("camera_image", "camera_name", 0.0, "Column"),
        ("camera_image", "pose_timestamp", f64::NAN, "Column"),
        ("camera_calibration", "camera_name", 2.0, "DuplicateToken"),
        ("camera_calibration", "intrinsic.f_u", 0.0, "Calibration"),
        ("camera_calibration", "intrinsic.k1", f64::NAN, "Calibration"),
        ("vehicle_pose", "frame_timestamp_micros", 1.6e15 + 1e5, "DuplicateToken"),
        ("vehicle_pose", "frame_timestamp_micros", 9e18, "Column"),
    ];
    for (component, column, value, want) in cases {
        let error = set(component, column, 0, value);
        assert_eq!(variant(&error), want, "{component} {column} = {value} gave {error:?}");
    }
}

#[test]
fn absent_values_columns_and_components_are_named() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let columns = [
        ("camera_image", "[CameraImageComponent].image"),
        ("camera_image", "[CameraImageComponent].pose.transform"),
        ("vehicle_pose", "[VehiclePoseComponent].world_from_vehicle.transform"),
        ("lidar_box", "key.laser_object_id"),
        ("lidar_box", "[LiDARBoxComponent].box.heading"),
        ("camera_calibration", "[CameraCalibrationComponent].width"),
    ];
    for (component, column) in columns {
        let dropped = changed(component, |name, array| (name != column).then(|| array.clone()));
        let empty = changed(component, |name, array| {
            let null = || arrow_array::new_null_array(array.data_type(), array.len());
            Some(if name == column { null() } else { array.clone() })
        });
        // Any text can be an object's name.
        let text = (!column.ends_with("object_id")).then(|| {
            changed(component, |name, array| {
                let text = || Arc::new(StringArray::from(vec!["x"; array.len()]));
                Some(if name == column { text() } else { array.clone() })
            })
        });
        for error in [Some(dropped), Some(empty), text].into_iter().flatten() {
            assert!(
                matches!(&error, DataError::Column { column: named, .. } if named == column),
                "{column}: {error:?}"
            );
        }
    }
    let foreign = changed("lidar_box", |name, array| {
        let is_context = name == "key.segment_context_name";
        Some(if is_context { Arc::new(StringArray::from(vec!["other"; array.len()])) } else { array.clone() })
    });
    assert!(matches!(&foreign, DataError::Column { why, .. } if why.contains("other")), "{foreign:?}");
    for component in ["camera_image", "vehicle_pose", "camera_calibration"] {
        let folder = tempfile::tempdir().unwrap();
        copy(&made, folder.path());
        std::fs::remove_file(table(folder.path(), component)).unwrap();
        let error = Waymo::open(&config(folder.path(), WaymoRelease::V2, ".")).unwrap_err();
        assert!(error.to_string().starts_with(&format!("missing {component}")), "{error}");
    }
    let folder = tempfile::tempdir().unwrap();
    copy(&made, folder.path());
    for component in ["lidar_box", "stats"] {
        std::fs::remove_dir_all(folder.path().join(component)).unwrap();
    }
    let dataset = read_everything(folder.path(), WaymoRelease::V2).unwrap();
    let frame = dataset.frame(0).unwrap();
    assert!(frame.boxes.is_none() && frame.scene_text.is_none() && !dataset.capabilities().boxes);
}

#[test]
fn broken_pictures_name_the_file_around_them() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let folder = tempfile::tempdir().unwrap();
    copy(&made, folder.path());
    let path = table(folder.path(), "camera_image");
    rewrite(&path, Compression::UNCOMPRESSED, |name, array| {
        Some(if name.ends_with(".image") {
            let cut = |bytes: Option<&[u8]>| bytes.map(|bytes| bytes[..bytes.len() / 2].to_vec());
            Arc::new(array.as_binary::<i32>().iter().map(cut).collect::<arrow_array::BinaryArray>())
        } else {
            array.clone()
        })
    });
    let dataset = Waymo::open(&config(folder.path(), WaymoRelease::V2, ".")).unwrap();
    for view in dataset.frame(0).unwrap().views {
        let image = view.image.unwrap();
        for error in [image.inspect().unwrap_err(), image.decode().unwrap_err()] {
            assert_eq!(variant(&error), "Image");
            assert!(error.to_string().ends_with(path.to_str().unwrap()), "{error}");
        }
    }
    std::fs::remove_file(&path).unwrap();
    let frame = dataset.frame(1).unwrap();
    assert_eq!(variant(&frame.views[0].image.as_ref().unwrap().decode().unwrap_err()), "Missing");
}

#[test]
fn mutated_tables_never_panic() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    let folder = tempfile::tempdir().unwrap();
    copy(&made, folder.path());
    let mut refused = 0;
    let rounds =
        [("vehicle_pose", 250), ("camera_calibration", 250), ("lidar_box", 250), ("stats", 250), ("camera_image", 60)];
    for (component, rounds) in rounds {
        let path = table(folder.path(), component);
        let sound = std::fs::read(&path).unwrap();
        for _ in 0..rounds {
            let mut bytes = sound.clone();
            for _ in 0..rng.random_range(1..4) {
                // Pictures fill the largest table; its end describes them.
                let from = bytes.len().saturating_sub(30_000);
                let at = rng.random_range(from..bytes.len());
                bytes[at] = rng.random();
            }
            if rng.random_range(0..8) == 0 {
                bytes.truncate(rng.random_range(0..bytes.len()));
            }
            std::fs::write(&path, &bytes).unwrap();
            let outcome = Waymo::open(&config(folder.path(), WaymoRelease::V2, ".")).and_then(|set| {
                let frame = set.frame(0)?;
                frame.views.iter().flat_map(|view| &view.image).try_for_each(|image| image.inspect())
            });
            if let Err(error) = outcome {
                refused += 1;
                let named = error.to_string().contains(folder.path().to_str().unwrap());
                assert!(named || matches!(error, DataError::UnknownClass { .. }), "{error}");
            }
        }
        std::fs::write(&path, &sound).unwrap();
    }
    assert!(refused > 200, "{refused}");
}
