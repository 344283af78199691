//! Latents of an autoencoder on disk, with what belongs to them: statistics, boxes, and the grid they were made over.
//!
//! A [`LatentFolder`] is the cache that `encode` writes: shards of moments, read at their place when asked for. An [`NpyTree`] is the
//! layout of the published latents, one file per instant. Both are datasets of frames without cameras, so that mixtures and samplers
//! work on them as on pictures. Shapes: C channels, h rows (y), w columns (x) of the latent.

mod folder;
mod manifest;
mod npy_file;
mod npy_tree;
mod npy_writer;
mod record;
mod shard;
mod statistics;
mod writer;

use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::{DataError, SceneDataset, staging};

pub use folder::LatentFolder;
pub use manifest::{LatentHead, MANIFEST};
pub use npy_file::NpyLayout;
pub use npy_tree::{NpyTree, NpyTreeConfig, TreeKind};
pub use npy_writer::NpyTreeWriter;
pub use statistics::{LatentScale, LatentStatistics, Posterior, STATISTICS, StatisticsCollector};
pub use writer::LatentWriter;

/// How numbers are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LatentType {
    /// Half precision: half the bytes, errors of 5e-4 of a value.
    #[default]
    F16,
    /// Single precision.
    F32,
}

/// The posterior of one sample.
#[derive(Debug, Clone, PartialEq)]
pub struct Latent {
    /// `[C, h, w]`
    pub mean: Vec<f32>,
    /// `[C, h, w]`; `None` where only one point of the posterior was kept.
    pub log_var: Option<Vec<f32>>,
}

impl Latent {
    /// Refuses lengths that are not those of `shape`, and numbers that are not finite.
    ///
    /// # Errors
    /// [`DataError::Format`] with the file.
    pub fn checked(self, shape: [usize; 3], path: &Path) -> Result<Self, DataError> {
        let refuse = |why: String| Err(DataError::Format { format: "latent", why, path: path.to_owned() });
        let count = shape.iter().product::<usize>();
        let parts = [Some(&self.mean), self.log_var.as_ref()];
        for values in parts.into_iter().flatten() {
            if values.len() != count {
                return refuse(format!("{} numbers are no latent of {shape:?}", values.len()));
            }
            if let Some(at) = values.iter().position(|value| !value.is_finite()) {
                return refuse(format!("number {at} is not finite"));
            }
        }
        Ok(self)
    }
}

/// Frames that come with their latent.
pub trait LatentDataset: SceneDataset {
    /// C, h, w.
    fn shape(&self) -> [usize; 3];

    /// The latent of a frame.
    ///
    /// # Errors
    /// Names the file that cannot be read or holds something else.
    fn latent(&self, index: usize) -> Result<Latent, DataError>;
}

fn json_error(path: &Path) -> impl Fn(serde_json::Error) -> DataError {
    move |error| DataError::Json { why: error.to_string(), path: path.to_owned() }
}

/// Writes a whole file beside its place, then renames it, so that no reader meets half of one.
fn write_whole(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    staging::write(&part, bytes)?;
    let synced = std::fs::File::open(&part).and_then(|file| file.sync_all());
    synced.map_err(staging::io("sync", &part))?;
    std::fs::rename(&part, path).map_err(staging::io("rename to", path))
}
