//! Broken datasets: every fault is a typed error that names the file.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use data::nuscenes::{NuScenes, NuScenesConfig, check};
use data::{DataError, SceneDataset};
use geometry::ImageEdit;
use serde_json::{Value, json};

use super::made::{START_US, Tables};

fn variant(error: &DataError) -> &'static str {
    match error {
        DataError::Missing { .. } => "Missing",
        DataError::Json { .. } => "Json",
        DataError::Dangling { .. } => "Dangling",
        DataError::DuplicateToken { .. } => "DuplicateToken",
        DataError::Calibration { .. } => "Calibration",
        DataError::Annotation { .. } => "Annotation",
        DataError::Image { .. } => "Image",
        DataError::ImageSize { .. } => "ImageSize",
        DataError::UnsafePath { .. } => "UnsafePath",
        DataError::Empty { .. } => "Empty",
        DataError::UnknownClass { .. } => "UnknownClass",
        DataError::Config(_) => "Config",
        _ => "another",
    }
}

/// Opens the dataset and loads every picture of every frame; the first error.
fn read_everything(config: &NuScenesConfig) -> Result<NuScenes, DataError> {
    let dataset = NuScenes::open(config)?;
    for index in 0..dataset.len() {
        for view in dataset.frame(index)?.views {
            let edit = ImageEdit::identity(view.intrinsics.width, view.intrinsics.height);
            view.image.expect("these cases list every picture").load(&edit)?;
        }
    }
    Ok(dataset)
}

/// Case folder, what is wrong, what must happen: the rows of the README's table for one group.
fn cases(readme: &Path, group: &str) -> Vec<(String, String, String)> {
    let text = std::fs::read_to_string(readme).unwrap();
    let rows = text.lines().filter_map(|line| {
        let mut cells = line.strip_prefix('|')?.trim_end().strip_suffix('|')?.split(" | ").map(str::trim);
        let case = cells.next()?.trim_matches('`').strip_prefix(group)?.trim_matches('/').to_owned();
        Some((case, cells.next()?.to_owned(), cells.next()?.to_owned()))
    });
    rows.collect()
}

#[test]
fn the_cases_of_the_fixture_folder() {
    let Some(root) = super::folder("RIGSCAPE_DATA", "malformed") else { return };
    let cases = cases(&root.join("README.md"), "nuscenes/");
    let mut folders: Vec<PathBuf> =
        std::fs::read_dir(root.join("nuscenes")).unwrap().map(|entry| entry.unwrap().path()).collect();
    folders.sort();
    assert!(!folders.is_empty());
    for folder in folders {
        let name = folder.file_name().unwrap().to_str().unwrap();
        let (_, wrong, want) =
            cases.iter().find(|case| case.0 == name).unwrap_or_else(|| panic!("{name} is not listed"));
        run_case(&folder, name, wrong, want);
    }
    assert!(!Path::new("rigscape_pwned").exists());
}

fn run_case(folder: &Path, name: &str, wrong: &str, want: &str) {
    let version = std::fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .find(|entry| entry.starts_with("v1.0"))
        .unwrap_or_else(|| panic!("{name} has no tables"));
    let config = NuScenesConfig::new(folder, version);
    let start = Instant::now();
    let outcome = read_everything(&config);
    assert!(start.elapsed() < Duration::from_secs(2), "{name} took {:?}", start.elapsed());
    if want.starts_with("loads") {
        let dataset = outcome.unwrap_or_else(|error| panic!("{name}: {error}"));
        // "loads; 2 frames x 2 views, 1 box each"
        let numbers: Vec<usize> =
            want.split(|c: char| !c.is_ascii_digit()).filter_map(|text| text.parse().ok()).collect();
        assert_eq!(dataset.len(), numbers[0]);
        for frame in super::frames(&dataset) {
            assert_eq!(frame.views.len(), numbers[1]);
            assert_eq!(frame.boxes.unwrap().len(), numbers[2]);
        }
        return;
    }
    let error = if want.contains("Empty") {
        assert_eq!(outcome.unwrap().len(), 0, "{name}");
        NuScenes::open(&NuScenesConfig { split: "mini_train".to_owned(), ..config }).unwrap_err()
    } else {
        outcome.err().unwrap_or_else(|| panic!("{name} loads, but {want}"))
    };
    let allowed: Vec<&str> = want.split(|c: char| !c.is_ascii_alphanumeric()).collect();
    assert!(allowed.contains(&variant(&error)), "{name} gave {error:?}, wanted {want}");
    let text = error.to_string();
    assert!(text.contains(folder.to_str().unwrap()), "{name}: {text:?} does not name the file");
    let table = format!("{wrong} {want}");
    match table.split(' ').map(|word| word.trim_end_matches([',', ':', '.'])).find(|word| word.ends_with(".json")) {
        Some(table) => assert!(text.ends_with(table), "{name}: {text:?} does not end with {table}"),
        None => assert!(text.ends_with(".json") || text.ends_with(".jpg"), "{name}: {text:?}"),
    }
    if want.contains("both sizes") {
        assert!(text.contains("16x16") && text.contains("32x18"), "{text}");
    }
}

#[test]
fn a_check_lists_every_bad_picture_of_the_fixture_folder() {
    let Some(root) = super::folder("RIGSCAPE_DATA", "malformed/nuscenes") else { return };
    let found = |case: &str| check(&NuScenesConfig::new(root.join(case), "v1.0-mini"), 1).unwrap();
    assert!(found("base_ok").is_sound());
    assert_eq!((found("missing_jpg").missing(), found("missing_jpg").damaged()), (1, 0));
    for case in ["truncated_jpg", "wrong_size_jpg", "not_a_jpg", "jpg_header_65500"] {
        let report = found(case);
        assert_eq!((report.pictures, report.missing(), report.damaged()), (4, 0, 1), "{case}");
    }
}

/// Two samples, one object.
fn sound() -> Tables {
    let mut tables = Tables::new();
    tables.scene("scene-0001", &[START_US, START_US + 500_000]);
    tables.annotate("scene-0001", 0, "car", "vehicle.car", [110.0, 52.0, 0.8], 0.1);
    tables.annotate("scene-0001", 1, "car", "vehicle.car", [112.0, 52.0, 0.8], 0.2);
    tables
}

fn error_of(tables: &Tables) -> DataError {
    let folder = tempfile::tempdir().unwrap();
    let error = NuScenes::open(&tables.write(folder.path())).unwrap_err();
    assert!(error.to_string().ends_with(".json"), "{error}");
    error
}

#[test]
fn every_key_is_followed() {
    let keys = [
        ("calibrated_sensor", "sensor_token"),
        ("scene", "log_token"),
        ("scene", "first_sample_token"),
        ("scene", "last_sample_token"),
        ("sample", "scene_token"),
        ("sample_data", "sample_token"),
        ("sample_data", "ego_pose_token"),
        ("sample_data", "calibrated_sensor_token"),
        ("instance", "category_token"),
        ("sample_annotation", "sample_token"),
        ("sample_annotation", "instance_token"),
        ("sample_annotation", "visibility_token"),
        ("sample_annotation", "attribute_tokens"),
    ];
    for (name, key) in keys {
        let mut tables = sound();
        let row = &mut tables.0.get_mut(name).unwrap()[0];
        row[key] = if row[key].is_array() { json!(["nowhere"]) } else { json!("nowhere") };
        match error_of(&tables) {
            DataError::Dangling { table, field, token, .. } => {
                assert_eq!((table, field), (name, key));
                let own = tables.0[name][0]["token"].as_str().unwrap();
                assert!(token == own || name == "scene", "{token:?} instead of {own:?}");
            }
            other => panic!("{name}.{key} gave {other:?}"),
        }
    }
}

#[test]
fn repeated_tokens_are_found() {
    for name in
        ["sensor", "calibrated_sensor", "log", "scene", "sample", "sample_data", "ego_pose", "category", "instance"]
    {
        let mut tables = sound();
        let row = tables.0[name][0].clone();
        tables.0.get_mut(name).unwrap().push(row.clone());
        match error_of(&tables) {
            DataError::DuplicateToken { table, token, .. } => {
                assert_eq!(table, name);
                assert_eq!(token, row["token"].as_str().unwrap());
            }
            DataError::Json { why, .. } if name == "scene" => assert!(why.contains("same name"), "{why}"),
            other => panic!("{name} gave {other:?}"),
        }
    }
}

#[test]
fn bad_numbers_name_their_row() {
    let set = |table: &str, field: &str, value: Value| {
        let mut tables = sound();
        tables.0.get_mut(table).unwrap()[0][field] = value;
        error_of(&tables)
    };
    let bad = [
        ("calibrated_sensor", "rotation", json!([2.0, 0.0, 0.0, 0.0]), "Calibration"),
        ("calibrated_sensor", "rotation", json!([0.5, 0.5, 0.5]), "Json"),
        ("calibrated_sensor", "camera_intrinsic", json!([]), "Json"),
        ("calibrated_sensor", "camera_intrinsic", json!([[5.0, 1.0, 3.0], [0.0, 5.0, 3.0], [0.0, 0.0, 1.0]]), "Json"),
        (
            "calibrated_sensor",
            "camera_intrinsic",
            json!([[-5.0, 0.0, 3.0], [0.0, 5.0, 3.0], [0.0, 0.0, 1.0]]),
            "Calibration",
        ),
        ("ego_pose", "rotation", json!([0.0, 0.0, 0.0, 0.0]), "Calibration"),
        ("ego_pose", "translation", json!([0.0, null, 0.0]), "Json"),
        ("ego_pose", "timestamp", json!("now"), "Json"),
        ("sample_data", "width", json!(0), "Calibration"),
        ("sample_data", "width", json!(-3), "Json"),
        ("sample_data", "filename", json!("../outside.jpg"), "UnsafePath"),
        ("sample_data", "filename", json!("samples\\x.jpg"), "UnsafePath"),
        ("sample_annotation", "size", json!([0.0, 4.5, 1.6]), "Annotation"),
        ("sample_annotation", "rotation", json!([0.1, 0.0, 0.0, 0.0]), "Annotation"),
    ];
    for (table, field, value, want) in bad {
        let error = set(table, field, value.clone());
        assert_eq!(variant(&error), want, "{table}.{field} = {value} gave {error:?}");
        let token = sound().0[table][0]["token"].as_str().unwrap().to_owned();
        assert!(error.to_string().contains(&token) || want == "UnsafePath", "{error} does not name {token}");
    }
}

#[test]
fn a_second_key_picture_and_wrong_scene_ends_are_found() {
    let mut tables = sound();
    tables.picture("scene-0001", "CAM_FRONT", 0, START_US - 30_000, true);
    let error = error_of(&tables);
    assert!(matches!(&error, DataError::Json { why, .. } if why.contains("CAM_FRONT")), "{error:?}");
    let mut tables = sound();
    tables.0.get_mut("scene").unwrap()[0]["last_sample_token"] = json!("scene-0001-sample-0");
    assert!(matches!(error_of(&tables), DataError::Json { .. }));
}
