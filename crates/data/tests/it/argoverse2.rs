//! The Argoverse 2 reader and writer: against the golden numbers, on broken logs, and against each other.

mod broken;
mod golden;
mod reading;
mod tables;
mod writing;

use std::path::{Path, PathBuf};

use data::argoverse2::{Argoverse2, Argoverse2Config};
use data::{ImageSource, SceneDataset, SceneFrame};

const LOG: &str = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede";

/// A folder of the fixtures. Without the variable `None`, with a note; with it, a missing folder fails the test.
fn fixture(inside: &str) -> Option<PathBuf> {
    match std::env::var_os("RIGSCAPE_DATA") {
        Some(root) => {
            let path = Path::new(&root).join(inside);
            assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
            Some(path)
        }
        None => {
            eprintln!("did not run: RIGSCAPE_DATA is not set");
            None
        }
    }
}

fn open(config: &Argoverse2Config) -> Argoverse2 {
    Argoverse2::open(config).unwrap()
}

fn frames(dataset: &dyn SceneDataset) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

fn image_path(source: Option<&ImageSource>) -> Option<&Path> {
    match source? {
        ImageSource::File { file, .. } => Some(file.path()),
        _ => None,
    }
}

/// A copy that may be changed, for the fixtures are read-only.
fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            std::fs::write(target, std::fs::read(&path).unwrap()).unwrap();
        }
    }
}
