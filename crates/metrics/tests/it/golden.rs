//! Reading golden folders.

use std::path::{Path, PathBuf};

use safetensors::SafeTensors;
use serde_json::Value;

/// The folder of one topic. Without `RIGSCAPE_GOLDEN` an absent folder is none, with it a failure.
pub fn folder(topic: &str) -> Option<PathBuf> {
    let (root, required) = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => (PathBuf::from(root), true),
        None => (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"), false),
    };
    let folder = root.join(topic);
    if folder.is_dir() {
        return Some(folder);
    }
    assert!(!required, "RIGSCAPE_GOLDEN has no folder {topic}");
    eprintln!("golden folder {topic} is absent and RIGSCAPE_GOLDEN is not set: this test did not run");
    None
}

pub fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

/// An f32 tensor `[N, D]` with its D.
pub fn rows(file: &SafeTensors<'_>, name: &str) -> (usize, Vec<f32>) {
    let view = file.tensor(name).unwrap();
    let &[_, width] = view.shape() else { panic!("{name} has shape {:?}", view.shape()) };
    let values = view.data().chunks_exact(4).map(|bytes| f32::from_le_bytes(bytes.try_into().unwrap()));
    (width, values.collect())
}

pub fn doubles(file: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let view = file.tensor(name).unwrap();
    view.data().chunks_exact(8).map(|bytes| f64::from_le_bytes(bytes.try_into().unwrap())).collect()
}

pub fn assert_close(what: &str, actual: f64, expected: f64, tolerance: f64) {
    assert!((actual - expected).abs() <= tolerance, "{what}: {actual} against {expected}");
}
