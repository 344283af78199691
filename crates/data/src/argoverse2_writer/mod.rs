//! Writes frames of any dataset in the Argoverse 2 sensor layout: pictures, poses, calibration, boxes, lidar, map and ground, which the
//! official package loads.
//!
//! Layout and column types follow the release, see <https://argoverse.github.io/user-guide/datasets/sensor.html>. Frames, poses and
//! boxes are written as they are: the ego frame of the source is kept.

mod boxes;
mod config;
mod feather;
mod log;
mod source;
mod sweep;

use std::collections::BTreeMap;
use std::path::Path;

use sha2::{Digest, Sha256};

pub use config::{Argoverse2Manifest, Argoverse2WriterConfig, CategoryRule, ManifestLog};
pub use source::Argoverse2Log;

use crate::DataError;
use crate::manifest::{Contents, WriterManifest, hex};
use crate::staging::{self, Staging};
use log::LogWriter;

/// Writes these logs. `progress` is called with the numbers of pictures written and to write.
///
/// The folder appears at its place when it is complete; a failed or interrupted run leaves nothing there. Two runs with the same frames
/// and configuration give identical bytes, on any number of threads.
///
/// # Errors
/// [`DataError::Config`] for settings and frames that the layout cannot hold, and for an output that exists; whatever is wrong with a
/// source picture; [`DataError::Io`] naming the file.
pub fn write_argoverse2(
    config: &Argoverse2WriterConfig,
    logs: &[Argoverse2Log],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Argoverse2Manifest, DataError> {
    config.check()?;
    let writers: Vec<LogWriter<'_>> = logs.iter().map(|log| LogWriter::new(config, log)).collect::<Result<_, _>>()?;
    let mut names: Vec<&str> = writers.iter().map(|writer| writer.name.as_str()).collect();
    names.sort_unstable();
    if let Some([twice, _]) = names.windows(2).find(|pair| matches!(pair, [a, b] if a == b)) {
        return Err(DataError::Config(format!("two logs are called {twice}")));
    }
    let staging = Staging::new(&config.out, config.force)?;
    let mut sums = Sums { root: staging.folder(), sha256: BTreeMap::new() };
    let total = writers.iter().map(|writer| writer.picture_count()).sum();
    let mut done = 0;
    let mut scenes = Vec::new();
    for writer in &writers {
        let mut advance = |pictures: usize| {
            done += pictures;
            progress(done, total);
        };
        scenes.push(writer.write(&mut sums, &mut advance)?);
        tracing::debug!(log = writer.name, "log written");
    }
    let contents = Contents {
        format: "argoverse2",
        source: config.source.clone(),
        pictures: config.picture_text(),
        picture_count: total,
        sha256: sums.sha256,
    };
    let manifest = WriterManifest::write(contents, config, scenes, &sums.root)?;
    staging.publish()?;
    Ok(manifest)
}

/// Writes tables and remembers their sums.
struct Sums {
    root: std::path::PathBuf,
    sha256: BTreeMap<String, String>,
}

impl Sums {
    /// A file inside the dataset, with its folders.
    fn put(&mut self, name: &str, bytes: &[u8]) -> Result<(), DataError> {
        self.sha256.insert(name.to_owned(), hex(&Sha256::digest(bytes)));
        put(&self.root, name, bytes)
    }
}

/// Writes a file inside a folder, with the folders above it.
fn put(root: &Path, name: &str, bytes: &[u8]) -> Result<(), DataError> {
    let path = root.join(name);
    if let Some(parent) = path.parent() {
        staging::create_dir(parent)?;
    }
    staging::write(&path, bytes)
}
