//! Broken logs: every fault is a typed error that names the file.

use std::path::Path;
use std::time::{Duration, Instant};

use data::argoverse2::{Argoverse2, Argoverse2Config};
use data::{ClassRule, DataError, SceneDataset};
use geometry::ImageEdit;

use super::{copy, fixture, frames, open};

/// Opens the log and loads every picture of every frame; the first error.
fn read_everything(config: &Argoverse2Config) -> Result<Argoverse2, DataError> {
    let dataset = Argoverse2::open(config)?;
    for index in 0..dataset.len() {
        for view in dataset.frame(index)?.views {
            let edit = ImageEdit::identity(view.intrinsics.width, view.intrinsics.height);
            view.image.expect("these cases hold every picture").load(&edit)?;
        }
    }
    Ok(dataset)
}

fn case(root: &Path, name: &str) -> Result<Argoverse2, DataError> {
    let start = Instant::now();
    let outcome = read_everything(&Argoverse2Config::new(root.join(name)));
    assert!(start.elapsed() < Duration::from_secs(2), "{name} took {:?}", start.elapsed());
    outcome
}

#[test]
fn every_case_of_the_fixture_folder_ends_as_its_table_says() {
    let Some(root) = fixture("malformed/argoverse2") else { return };
    let mut cases: Vec<String> =
        std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    cases.sort();
    assert_eq!(cases.len(), 9);
    for name in cases {
        let outcome = case(&root, &name);
        let error = match name.as_str() {
            "base_ok" | "empty_annotations" | "no_annotations_file" => {
                let dataset = outcome.unwrap_or_else(|error| panic!("{name}: {error}"));
                let all = frames(&dataset);
                assert_eq!((all.len(), all[0].views.len()), (1, 2), "{name}");
                let boxes = all[0].boxes.as_ref().map(Vec::len);
                let want = match name.as_str() {
                    "base_ok" => Some(1),
                    "empty_annotations" => Some(0),
                    _ => None,
                };
                assert_eq!(boxes, want, "{name}");
                assert_eq!(dataset.capabilities().boxes, want.is_some());
                continue;
            }
            _ => outcome.err().unwrap_or_else(|| panic!("{name} loads")),
        };
        let text = error.to_string();
        let file = match (name.as_str(), &error) {
            ("feather_truncated", DataError::Format { format: "Arrow", .. }) => "calibration/intrinsics.feather",
            ("feather_not_arrow", DataError::Format { format: "Arrow", .. }) => "annotations.feather",
            ("feather_missing_column", DataError::Column { column, .. }) if column == "qz" => {
                "city_SE3_egovehicle.feather"
            }
            ("feather_wrong_dtype", DataError::Column { column, .. }) if column == "fx_px" => {
                "calibration/intrinsics.feather"
            }
            ("image_without_pose", DataError::Calibration { .. }) => {
                assert!(text.contains("ring_front_center/315970060000000000.jpg"), "{text}");
                assert!(text.contains("poses cover 3159"), "{text}");
                "city_SE3_egovehicle.feather"
            }
            ("category_unknown", DataError::UnknownClass { name, .. }) if name == "HOVERBOARD" => continue,
            _ => panic!("{name} gave {error:?}"),
        };
        assert!(text.ends_with(file), "{name}: {text}");
    }
}

#[test]
fn a_rule_or_an_exclusion_lets_a_known_fault_pass() {
    let Some(root) = fixture("malformed/argoverse2") else { return };
    let mut config = Argoverse2Config::new(root.join("category_unknown"));
    config.classes.insert("HOVERBOARD".into(), ClassRule::Drop);
    assert_eq!(open(&config).frame(0).unwrap().boxes.unwrap().len(), 0);
    config.classes.insert("HOVERBOARD".into(), ClassRule::As(data::ObjectClass::Other));
    assert_eq!(open(&config).frame(0).unwrap().boxes.unwrap().len(), 1);
    let log = "00000000-0000-3000-8000-000000000004";
    let mut config = Argoverse2Config::new(root.join("image_without_pose"));
    config.exclude = vec![format!("{log}/ring_front_center/315970060000000000")];
    assert_eq!(open(&config).len(), 1);
    config.exclude.push(format!("{log}/315970000000000000"));
    assert_eq!(open(&config).len(), 0);
}

/// The sound tiny log with one thing changed.
fn changed(change: impl FnOnce(&Path)) -> Option<Result<Argoverse2, DataError>> {
    let base = fixture("malformed/argoverse2/base_ok")?;
    let folder = tempfile::tempdir().unwrap();
    copy(&base, folder.path());
    let log = std::fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
    change(&log);
    Some(read_everything(&Argoverse2Config::new(folder.path())))
}

#[test]
fn other_faults_are_errors_with_their_file() {
    let floats = |values: Vec<f64>| std::sync::Arc::new(arrow_array::Float64Array::from(values)) as _;
    let calibration = |log: &Path| log.join("calibration/intrinsics.feather");
    let Some(absent) = changed(|log| std::fs::remove_file(log.join("city_SE3_egovehicle.feather")).unwrap()) else {
        return;
    };
    assert!(matches!(absent, Err(DataError::Missing { .. })));
    let zero = changed(|log| super::tables::replace(&calibration(log), "fx_px", floats(vec![0.0; 2]))).unwrap();
    assert!(matches!(zero, Err(DataError::Calibration { .. })), "{zero:?}");
    let nan = changed(|log| super::tables::replace(&calibration(log), "cy_px", floats(vec![f64::NAN; 2]))).unwrap();
    assert!(matches!(nan, Err(DataError::Calibration { .. })), "{nan:?}");
    let norm =
        changed(|log| super::tables::replace(&log.join("annotations.feather"), "qw", floats(vec![2.0]))).unwrap();
    assert!(norm.unwrap_err().to_string().ends_with("annotations.feather"));
    let flat =
        changed(|log| super::tables::replace(&log.join("annotations.feather"), "height_m", floats(vec![0.0]))).unwrap();
    assert!(matches!(flat, Err(DataError::Annotation { .. })), "{flat:?}");
    let name = changed(|log| {
        let folder = log.join("sensors/cameras/ring_front_left");
        std::fs::rename(folder.join("315970000000000000.jpg"), folder.join("first.jpg")).unwrap();
    });
    assert!(name.unwrap().unwrap_err().to_string().ends_with("ring_front_left/first.jpg"));
    let picture = changed(|log| {
        std::fs::write(log.join("sensors/cameras/ring_front_left/315970000000000000.jpg"), "text").unwrap();
    });
    assert!(matches!(picture.unwrap(), Err(DataError::Image { .. })));
}

#[test]
fn flipped_bytes_never_panic() {
    let Some(base) = fixture("malformed/argoverse2/base_ok") else { return };
    let folder = tempfile::tempdir().unwrap();
    copy(&base, folder.path());
    let log = std::fs::read_dir(folder.path()).unwrap().next().unwrap().unwrap().path();
    let config = Argoverse2Config::new(folder.path());
    let mut refused = 0;
    for table in ["annotations", "city_SE3_egovehicle", "calibration/intrinsics", "calibration/egovehicle_SE3_sensor"] {
        let path = log.join(format!("{table}.feather"));
        let sound = std::fs::read(&path).unwrap();
        for at in (0..sound.len()).step_by(3) {
            let mut damaged = sound.clone();
            damaged[at] ^= [0xFF, 0x80, 0x01][at % 3];
            std::fs::write(&path, damaged).unwrap();
            refused += usize::from(Argoverse2::open(&config).is_err());
        }
        std::fs::write(&path, sound).unwrap();
    }
    assert!(refused > 200, "{refused}");
    assert_eq!(open(&config).len(), 1);
}

#[test]
fn logs_and_splits_that_are_not_there() {
    let folder = tempfile::tempdir().unwrap();
    assert!(matches!(Argoverse2::open(&Argoverse2Config::new(folder.path())), Err(DataError::Empty { .. })));
    assert!(matches!(
        Argoverse2::open(&Argoverse2Config::new(folder.path().join("x"))),
        Err(DataError::Missing { .. })
    ));
    let Some(root) = fixture("argoverse2") else { return };
    let mut config = Argoverse2Config::new(root);
    config.logs = vec!["00a6ffc1-6ce9-3bc3-a060-6006e9893a1a".into()];
    assert!(matches!(Argoverse2::open(&config), Err(DataError::Missing { .. })));
}
