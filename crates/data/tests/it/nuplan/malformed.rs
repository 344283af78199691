//! The broken inputs of the test data, with the behaviour that their table states.

use std::collections::BTreeSet;
use std::path::Path;
use std::time::{Duration, Instant};

use data::DataError;
use data::nuplan::{NuPlan, NuPlanConfig};
use pickle::{PickleError, Rules, decode};

use super::{frames, variant};
use crate::nuscenes::folder;

/// The names in a folder, so that a case without a test shows.
fn names(folder: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

/// These cases have their database and their pictures directly below the root.
fn config(root: &Path) -> NuPlanConfig {
    NuPlanConfig { databases: String::new(), sensor_blobs: "sensor_blobs".to_owned(), ..NuPlanConfig::new(root) }
}

#[test]
fn databases() {
    let Some(root) = folder("RIGSCAPE_DATA", "malformed/nuplan") else { return };
    let cases = [
        ("base_ok", "loads", ""),
        ("corrupt_header", "Format", "SQLite"),
        ("missing_image_table", "Format", "no table image"),
        ("path_traversal", "UnsafePath", "../../../../etc/passwd"),
        ("pickle_os_system", "Format", "global os.system is not allowed"),
    ];
    assert_eq!(names(&root), cases.iter().map(|case| case.0.to_owned()).collect());
    for (case, want, text) in cases {
        let started = Instant::now();
        let outcome = NuPlan::open(&config(&root.join(case)));
        assert!(started.elapsed() < Duration::from_secs(2), "{case} took {:?}", started.elapsed());
        match outcome {
            Ok(dataset) => {
                assert_eq!(want, "loads", "{case}");
                let all = frames(&dataset);
                assert_eq!((all.len(), all[0].views.len(), all[0].boxes.is_none()), (1, 1, true));
                all[0].views[0].image.as_ref().unwrap().decode().unwrap();
            }
            Err(error) => {
                assert_eq!(variant(&error), want, "{case}: {error}");
                let shown = error.to_string();
                assert!(shown.contains(text) && shown.ends_with("log_x.db"), "{case}: {shown}");
            }
        }
    }
    assert!(!Path::new("rigscape_pwned").exists());
}

#[test]
fn pickles() {
    let Some(root) = folder("RIGSCAPE_DATA", "malformed/pickle") else { return };
    let global = |module: &str, name: &str| PickleError::Global { module: module.into(), name: name.into() };
    let cases = [
        ("append_on_float.pkl", PickleError::Malformed { what: "an append to something that is no list", offset: 13 }),
        ("build_setstate.pkl", PickleError::Opcode { opcode: b'}', offset: 51 }),
        ("empty.pkl", PickleError::Truncated { offset: 0 }),
        (
            "frame_length_huge.pkl",
            PickleError::Malformed { what: "a frame longer than the rest of the pickle", offset: 2 },
        ),
        ("long1_255_bytes.pkl", PickleError::Truncated { offset: 6 }),
        ("memo_get_missing.pkl", PickleError::Malformed { what: "a memo entry that was never stored", offset: 2 }),
        ("reduce_os_system.pkl", global("os", "system")),
        ("stack_global_eval.pkl", global("builtins", "eval")),
    ];
    assert_eq!(names(&root), cases.iter().map(|case| case.0.to_owned()).collect());
    let rules = Rules::new(&[("nuplan.database.common.data_types", "Translation"), ("builtins", "list")]);
    for (case, want) in cases {
        let bytes = std::fs::read(root.join(case)).unwrap();
        assert_eq!(decode(&bytes, &rules).unwrap_err(), want, "{case}");
    }
    assert!(!Path::new("rigscape_pwned").exists());
}

#[test]
fn no_pictures_at_all_is_an_empty_dataset() {
    let Some(root) = folder("RIGSCAPE_DATA", "malformed/nuplan/base_ok") else { return };
    let elsewhere = NuPlanConfig { sensor_blobs: "nowhere".to_owned(), ..config(&root) };
    let error = NuPlan::open(&elsewhere).unwrap_err();
    assert!(matches!(&error, DataError::Empty { what, .. } if what.contains("1 logs")), "{error}");
}
