//! `manifest.json` beside written data: what it is, where it comes from, and the sums of its tables.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

pub(crate) use crate::staging::hex;
use crate::{DataError, staging};

/// `manifest.json` beside the data: enough to make the same bytes again and to compare with what they show.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WriterManifest<Config, Scene> {
    /// Name and version of the tool.
    pub tool: String,
    /// Layout of the folder.
    pub format: String,
    /// Where the content comes from.
    pub source: String,
    /// Codec, quality and whether pictures were resampled.
    pub pictures: String,
    /// How many pictures there are.
    pub picture_count: usize,
    /// SHA-256 of `config` as compact JSON.
    pub config_sha256: String,
    /// All settings that shape the bytes.
    pub config: Config,
    /// The scenes in order.
    pub scenes: Vec<Scene>,
    /// SHA-256 of every table and map, by path inside the folder.
    pub sha256: BTreeMap<String, String>,
}

/// The parts of a manifest that are neither settings nor scenes.
pub(crate) struct Contents {
    pub(crate) format: &'static str,
    pub(crate) source: String,
    pub(crate) pictures: String,
    pub(crate) picture_count: usize,
    pub(crate) sha256: BTreeMap<String, String>,
}

impl<Config: Clone + Serialize, Scene: Serialize> WriterManifest<Config, Scene> {
    /// Writes the manifest into a finished folder.
    pub(crate) fn write(
        contents: Contents,
        config: &Config,
        scenes: Vec<Scene>,
        root: &Path,
    ) -> Result<Self, DataError> {
        let path = root.join(staging::MANIFEST);
        let json = |e: serde_json::Error| DataError::Json { why: e.to_string(), path: path.clone() };
        let manifest = Self {
            tool: concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned(),
            format: contents.format.to_owned(),
            source: contents.source,
            pictures: contents.pictures,
            picture_count: contents.picture_count,
            config_sha256: hex(&Sha256::digest(serde_json::to_vec(config).map_err(json)?)),
            config: config.clone(),
            scenes,
            sha256: contents.sha256,
        };
        staging::write(&path, &serde_json::to_vec_pretty(&manifest).map_err(json)?)?;
        Ok(manifest)
    }
}
