//! The layout of the published latents: `<root>/bev-lidar/<split>/<log>/<timestamp_ns>.npy` for annotated frames, `<root>/bev/...` for
//! all frames (source: the dataset flags of the public code Czm369/bev-vae). How a file's array is laid out is nowhere documented, so it is
//! declared, or told by its shape where only one reading fits. Files hold no boxes: they are joined to a dataset on the exact instant.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::npy_file::parse;
use super::{Latent, LatentDataset, NpyLayout};
use crate::{Capabilities, DataError, FrameOutline, SceneDataset, SceneFrame};

/// Longest file; the largest latents have 256 KiB.
const MOST_BYTES: u64 = 1 << 26;

/// Which frames a tree holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TreeKind {
    /// `bev-lidar`: annotated frames, at the instants of the lidar.
    #[default]
    BevLidar,
    /// `bev`: every frame.
    Bev,
}

impl TreeKind {
    /// The folder's name.
    pub const fn folder(self) -> &'static str {
        match self {
            Self::BevLidar => "bev-lidar",
            Self::Bev => "bev",
        }
    }
}

/// Where a tree lies.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NpyTreeConfig {
    /// The folder that holds `bev-lidar` or `bev`.
    pub root: PathBuf,
    /// The folder below it: `train`, `val`.
    pub split: String,
    /// Which frames.
    #[serde(default)]
    pub kind: TreeKind,
    /// Layout of the arrays; needed only where their shape leaves a choice.
    #[serde(default)]
    pub layout: Option<NpyLayout>,
}

impl NpyTreeConfig {
    /// The split's folder, which holds the logs.
    pub fn folder(&self) -> PathBuf {
        self.root.join(self.kind.folder()).join(&self.split)
    }

    pub(super) fn file(&self, scene: &str, timestamp_ns: i64) -> PathBuf {
        self.scene(scene).join(format!("{timestamp_ns}.npy"))
    }

    pub(super) fn scene(&self, scene: &str) -> PathBuf {
        self.folder().join(scene)
    }
}

/// A tree with the dataset that its files belong to.
pub struct NpyTree {
    config: NpyTreeConfig,
    shape: [usize; 3],
    dataset: Arc<dyn SceneDataset>,
    /// Frames of the dataset that have a latent.
    frames: Vec<(usize, String, i64)>,
}

impl std::fmt::Debug for NpyTree {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("NpyTree").field("config", &self.config).field("frames", &self.frames.len()).finish()
    }
}

impl NpyTree {
    /// Joins the tree to a dataset: every annotated frame needs its file, and in `bev-lidar` every file of its logs needs its frame.
    ///
    /// # Errors
    /// [`DataError::Missing`] naming the partner that is not there; whatever is wrong with the first file.
    pub fn open(config: NpyTreeConfig, shape: [usize; 3], dataset: Arc<dyn SceneDataset>) -> Result<Self, DataError> {
        let mut frames = Vec::new();
        for scene in dataset.scene_ranges().into_iter().filter(|scene| !scene.is_empty()) {
            let name = dataset.frame(scene.start)?.id.scene;
            let mut files = listed(&config.scene(&name))?;
            for index in scene {
                let FrameOutline { timestamp_ns, annotated, .. } = dataset.outline(index)?;
                let found = files.remove(&timestamp_ns);
                if annotated && !found {
                    let what = format!("latent of the frame at {timestamp_ns} of {name} in {}", dataset.name());
                    return Err(DataError::Missing { what, path: config.file(&name, timestamp_ns) });
                }
                if annotated {
                    frames.push((index, name.clone(), timestamp_ns));
                }
            }
            if let (Some(extra), TreeKind::BevLidar) = (files.first(), config.kind) {
                let what =
                    format!("frame at exactly {extra} of {name} in {}, to which a latent belongs", dataset.name());
                return Err(DataError::Missing { what, path: config.file(&name, *extra) });
            }
        }
        if frames.is_empty() {
            let what = format!("the set of annotated frames of {}", dataset.name());
            return Err(DataError::Empty { what, path: config.folder() });
        }
        let tree = Self { config, shape, dataset, frames };
        tree.latent(0)?;
        Ok(tree)
    }

    /// The tree.
    pub fn config(&self) -> &NpyTreeConfig {
        &self.config
    }

    /// The frame of the dataset that a sample comes from, pictures included.
    ///
    /// # Errors
    /// As the dataset's.
    pub fn source_frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        self.dataset.frame(self.entry(index)?.0)
    }

    fn entry(&self, index: usize) -> Result<&(usize, String, i64), DataError> {
        self.frames.get(index).ok_or_else(|| {
            DataError::Config(format!("{} has no frame {index}, only {}", self.dataset.name(), self.frames.len()))
        })
    }
}

/// Instants of the files of a log.
fn listed(folder: &Path) -> Result<BTreeSet<i64>, DataError> {
    let entries = std::fs::read_dir(folder).map_err(|source| match source.kind() {
        std::io::ErrorKind::NotFound => {
            DataError::Missing { what: "folder of a log's latents".into(), path: folder.into() }
        }
        _ => DataError::Io { action: "list", source, path: folder.into() },
    })?;
    let mut found = BTreeSet::new();
    for entry in entries {
        let name = entry.map_err(crate::staging::io("list", folder))?.file_name();
        let name = name.to_string_lossy();
        let Some(stem) = name.strip_suffix(".npy") else { continue };
        let instant = stem.parse().map_err(|_| DataError::Format {
            format: "latent",
            why: "its name is no instant in nanoseconds".to_owned(),
            path: folder.join(&*name),
        })?;
        found.insert(instant);
    }
    Ok(found)
}

impl LatentDataset for NpyTree {
    fn shape(&self) -> [usize; 3] {
        self.shape
    }

    fn latent(&self, index: usize) -> Result<Latent, DataError> {
        let (_, scene, timestamp_ns) = self.entry(index)?;
        let path = self.config.file(scene, *timestamp_ns);
        let size = std::fs::metadata(&path).map_err(crate::staging::io("look at", &path))?.len();
        if size > MOST_BYTES {
            let why = format!("{size} bytes are more than any latent has");
            return Err(DataError::Format { format: "latent", why, path });
        }
        let bytes = std::fs::read(&path).map_err(crate::staging::io("read", &path))?;
        parse(&bytes, &path, self.shape, self.config.layout)
    }
}

impl SceneDataset for NpyTree {
    fn len(&self) -> usize {
        self.frames.len()
    }

    /// Without views: the latent stands for the pictures.
    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        Ok(SceneFrame { views: Vec::new(), ..self.source_frame(index)? })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let mut ranges: Vec<Range<usize>> = Vec::new();
        for (at, (_, scene, _)) in self.frames.iter().enumerate() {
            match ranges.last_mut() {
                Some(last) if self.frames.get(last.start).is_some_and(|(_, first, _)| first == scene) => {
                    last.end = at + 1
                }
                _ => ranges.push(at..at + 1),
            }
        }
        ranges
    }

    fn name(&self) -> &str {
        self.dataset.name()
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { boxes: true, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        0
    }
}
