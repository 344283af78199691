//! What to export and who painted it.

use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::nuscenes::NuScenes;

/// Layout of an export.
#[derive(Debug, Clone)]
pub enum ExportFormat<'a> {
    /// The tables of the source again, so that every token stays; only the pictures are new.
    NuScenesTables(&'a NuScenes),
    /// nuScenes tables made from the frames: tokens follow from the frames' names, boxes are those of the frames.
    NuScenes,
    /// Logs of the Argoverse 2 sensor dataset.
    Argoverse2,
}

impl ExportFormat<'_> {
    /// For manifests and messages.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::NuScenesTables(_) | Self::NuScenes => "nuscenes",
            Self::Argoverse2 => "argoverse2",
        }
    }
}

/// Settings of [`crate::export::export`].
#[derive(Debug, Clone)]
pub struct ExportConfig<'a> {
    /// Folder to make; unfinished work lies beside it under the same name with `.frames` behind.
    pub out: PathBuf,
    /// Replace a folder that this crate has written.
    pub force: bool,
    /// Layout.
    pub format: ExportFormat<'a>,
    /// Which frames this run paints.
    pub shard: Shard,
    /// Quality of the JPEG files, 1 to 100.
    pub jpeg_quality: u8,
    /// Who painted the pictures.
    pub generator: Generator,
}

impl<'a> ExportConfig<'a> {
    /// All frames in one run, JPEG quality 95.
    pub fn new(out: impl Into<PathBuf>, format: ExportFormat<'a>, generator: Generator) -> Self {
        Self { out: out.into(), force: false, format, shard: Shard::default(), jpeg_quality: 95, generator }
    }

    pub(super) fn check(&self) -> Result<(), DataError> {
        if (1..=100).contains(&self.jpeg_quality) {
            return Ok(());
        }
        Err(DataError::Config(format!("jpeg_quality must lie in 1..=100, but is {}", self.jpeg_quality)))
    }
}

/// What painted the pictures, for the manifest: enough to paint them again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Generator {
    /// Name of the model.
    pub model: String,
    /// Checkpoint by its hash, where there is one.
    pub checkpoint_sha256: Option<String>,
    /// The one seed; the noise of a frame follows from it and the frame's name.
    pub seed: u64,
    /// Sampler, its steps and its options.
    pub sampler: String,
    /// Guidance scale.
    pub guidance: Option<f64>,
    /// Where the conditions come from: a dataset and its split.
    pub condition: String,
    /// Changes made to the layout of every frame.
    pub edits: Vec<String>,
    /// The model's own settings.
    pub config: serde_json::Value,
}

/// A part of the frames: those whose number leaves this remainder, so that every part reaches over the whole dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shard {
    index: usize,
    count: usize,
}

impl Default for Shard {
    fn default() -> Self {
        Self { index: 0, count: 1 }
    }
}

impl Shard {
    /// Whether a frame belongs to this part.
    pub const fn holds(&self, frame: usize) -> bool {
        frame % self.count == self.index
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
        match parsed {
            Some((i, n)) if (1..=n).contains(&i) => Ok(Self { index: i - 1, count: n }),
            _ => Err("write part/parts, counted from 1: 1/4, 2/4, 3/4 and 4/4 make the whole".to_owned()),
        }
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.index + 1, self.count)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_of_any_split_make_the_whole() {
        for count in 1..=5usize {
            let shards: Vec<Shard> = (1..=count).map(|i| format!("{i}/{count}").parse().unwrap()).collect();
            for frame in 0..20 {
                assert_eq!(shards.iter().filter(|shard| shard.holds(frame)).count(), 1);
            }
            assert_eq!(shards[0].to_string(), format!("1/{count}"));
        }
        for bad in ["0/2", "3/2", "1", "a/b", "1/0", "1/2/3", "-1/2"] {
            assert!(bad.parse::<Shard>().unwrap_err().contains("1/4"), "{bad}");
        }
    }
}
