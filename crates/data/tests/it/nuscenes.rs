//! The nuScenes reader: on tables made here, on the fixtures, on broken tables and against the devkit's numbers.

mod broken;
mod can_bus;
mod fixture;
mod golden;
pub mod made;
mod map;
mod occupancy;
mod reading;

use std::path::{Path, PathBuf};

use data::nuscenes::{NuScenes, NuScenesConfig};
use data::{ImageSource, SceneDataset, SceneFrame};
use serde_json::Value;

/// A folder named by an environment variable. Without the variable `None`, with a note; with it, a missing folder fails the test.
pub fn folder(variable: &str, inside: &str) -> Option<PathBuf> {
    match std::env::var_os(variable) {
        Some(root) => {
            let path = Path::new(&root).join(inside);
            assert!(path.exists(), "{variable} is set, but {} does not exist", path.display());
            Some(path)
        }
        None => {
            eprintln!("did not run: {variable} is not set");
            None
        }
    }
}

/// A golden folder: `RIGSCAPE_GOLDEN`, else the project's own `tests/golden`.
fn golden_folder(inside: &str) -> Option<PathBuf> {
    if std::env::var_os("RIGSCAPE_GOLDEN").is_some() {
        return folder("RIGSCAPE_GOLDEN", inside);
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(inside);
    if !path.exists() {
        eprintln!("did not run: {inside} is not in tests/golden and RIGSCAPE_GOLDEN is not set");
        return None;
    }
    Some(path)
}

pub fn json(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

pub fn floats<const N: usize>(value: &Value) -> [f64; N] {
    let list: Vec<f64> = value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect();
    list.try_into().unwrap()
}

fn frames(dataset: &NuScenes) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

fn open(config: &NuScenesConfig) -> NuScenes {
    NuScenes::open(config).unwrap()
}

pub fn image_path(source: Option<&ImageSource>) -> Option<&Path> {
    match source? {
        ImageSource::File { file, .. } => Some(file.path()),
        _ => None,
    }
}
