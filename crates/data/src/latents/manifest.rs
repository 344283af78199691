//! `latents.json`: what a folder of latents holds, and how far its writing has come.

use std::path::Path;

use geometry::BevGrid;
use serde::{Deserialize, Serialize};

use super::{LatentType, json_error, write_whole};
use crate::DataError;

/// The file's name.
pub const MANIFEST: &str = "latents.json";
const FORMAT: u32 = 1;

/// What all latents of a folder have in common.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LatentHead {
    /// SHA-256 of the autoencoder's averaged weights file.
    pub vae_hash: String,
    /// SHA-256 of the settings of the encoded datasets.
    pub source_sha256: String,
    /// Names of the datasets, in order.
    pub datasets: Vec<String>,
    /// C, h, w.
    pub shape: [usize; 3],
    /// How numbers are stored.
    pub dtype: LatentType,
    /// Grid of the autoencoder.
    pub grid: BevGrid,
    /// Samples of a full shard.
    pub shard_samples: usize,
    /// Whether frames without a list of boxes were left out.
    pub annotated_only: bool,
}

/// The whole file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Manifest {
    pub format: u32,
    pub tool: String,
    pub head: LatentHead,
    /// Whether every frame is encoded and the statistics are written.
    pub complete: bool,
    pub shards: Vec<ShardEntry>,
}

/// A shard that is whole.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct ShardEntry {
    pub file: String,
    pub bytes: u64,
    /// Samples that follow one another from one scene.
    pub runs: Vec<Run>,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Run {
    pub dataset: String,
    pub scene: String,
    pub samples: usize,
}

impl ShardEntry {
    pub fn samples(&self) -> usize {
        self.runs.iter().fold(0, |sum, run| sum.saturating_add(run.samples))
    }
}

/// Name of the shard with this number.
pub(super) fn shard_name(number: usize) -> String {
    format!("shard_{number:05}.safetensors")
}

impl Manifest {
    pub fn new(head: LatentHead) -> Self {
        let tool = concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned();
        Self { format: FORMAT, tool, head, complete: false, shards: Vec::new() }
    }

    /// `None` where there is no such file.
    pub fn read(folder: &Path) -> Result<Option<Self>, DataError> {
        let path = folder.join(MANIFEST);
        let text = match std::fs::read_to_string(&path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(source) => return Err(DataError::Io { action: "read", source, path }),
        };
        let manifest: Self = serde_json::from_str(&text).map_err(json_error(&path))?;
        let refuse = |why: String| Err(DataError::Format { format: "latent manifest", why, path: path.clone() });
        if manifest.format != FORMAT {
            return refuse(format!("format {} instead of {FORMAT}; encode again", manifest.format));
        }
        if manifest.head.shape.contains(&0) || manifest.head.shard_samples == 0 {
            return refuse("a size is 0".to_owned());
        }
        let named = |(number, entry): (usize, &ShardEntry)| entry.file == shard_name(number);
        if !manifest.shards.iter().enumerate().all(named) {
            return refuse(format!("shards must be called {}, ... in order", shard_name(0)));
        }
        Ok(Some(manifest))
    }

    pub fn write(&self, folder: &Path) -> Result<(), DataError> {
        let path = folder.join(MANIFEST);
        write_whole(&path, &serde_json::to_vec_pretty(self).map_err(json_error(&path))?)
    }

    pub fn samples(&self) -> usize {
        self.shards.iter().map(ShardEntry::samples).sum()
    }
}
