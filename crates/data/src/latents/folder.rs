//! A finished folder of latents, as a dataset.

use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::manifest::{LatentHead, MANIFEST, Manifest};
use super::shard::Shard;
use super::{Latent, LatentDataset, LatentStatistics, STATISTICS};
use crate::{Capabilities, DataError, SceneDataset, SceneFrame};

/// Shards of moments with their boxes.
#[derive(Debug, Clone)]
pub struct LatentFolder {
    content: Arc<Content>,
    name: String,
    /// Samples of the folder that belong to this dataset.
    range: Range<usize>,
}

#[derive(Debug)]
struct Content {
    path: PathBuf,
    head: LatentHead,
    shards: Vec<Shard>,
    /// First sample of each shard.
    starts: Vec<usize>,
    statistics: Option<LatentStatistics>,
    scenes: Vec<(String, Range<usize>)>,
}

impl LatentFolder {
    /// Opens a finished folder.
    ///
    /// # Errors
    /// [`DataError::Missing`] where there is none, [`DataError::Config`] for an unfinished one, and whatever is wrong with its files.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let Some(manifest) = Manifest::read(path)? else {
            let what = "latents; make them with `rigscape encode`".to_owned();
            return Err(DataError::Missing { what, path: path.join(MANIFEST) });
        };
        if !manifest.complete {
            return Err(DataError::Config(format!(
                "the latents are not finished; run the same command again to go on: {}",
                path.display()
            )));
        }
        let statistics = LatentStatistics::read(&path.join(STATISTICS))?;
        if let Err(why) = statistics.check_origin(&manifest.head.vae_hash, &manifest.head.grid) {
            return Err(DataError::Format { format: "latent statistics", why, path: path.join(STATISTICS) });
        }
        Self::of_manifest(path, manifest, Some(statistics))
    }

    /// Whether anything was written there before, finished or not.
    pub fn exists(path: &Path) -> bool {
        path.join(MANIFEST).is_file()
    }

    pub(super) fn of_manifest(
        path: &Path,
        manifest: Manifest,
        statistics: Option<LatentStatistics>,
    ) -> Result<Self, DataError> {
        let head = manifest.head;
        let (mut shards, mut starts, mut scenes) =
            (Vec::new(), Vec::new(), Vec::<(String, String, Range<usize>)>::new());
        let mut samples = 0;
        for entry in &manifest.shards {
            let file = path.join(&entry.file);
            let bytes = std::fs::metadata(&file).map_err(crate::staging::io("look at", &file))?.len();
            if bytes != entry.bytes {
                let why = format!("{bytes} bytes long, not {} as written", entry.bytes);
                return Err(DataError::Format { format: "latent shard", why, path: file });
            }
            shards.push(Shard::open(&file, entry.samples(), head.shape, head.dtype)?);
            starts.push(samples);
            for run in &entry.runs {
                let range = samples..samples + run.samples;
                samples = range.end;
                match scenes.last_mut() {
                    // A scene may go on in the next shard.
                    Some((dataset, scene, last)) if *dataset == run.dataset && *scene == run.scene => {
                        last.end = range.end
                    }
                    _ => scenes.push((run.dataset.clone(), run.scene.clone(), range)),
                }
            }
        }
        if samples == 0 {
            return Err(DataError::Empty { what: "the set of latents".to_owned(), path: path.to_owned() });
        }
        let name = head.datasets.join("+");
        let scenes = scenes.into_iter().map(|(dataset, _, range)| (dataset, range)).collect();
        let content = Content { path: path.to_owned(), head, shards, starts, statistics, scenes };
        Ok(Self { content: Arc::new(content), name, range: 0..samples })
    }

    /// What all latents have in common.
    pub fn head(&self) -> &LatentHead {
        &self.content.head
    }

    /// The statistics of the whole folder; none while it is being written.
    pub fn statistics(&self) -> Option<&LatentStatistics> {
        self.content.statistics.as_ref()
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.content.path
    }

    /// The datasets that were encoded, one by one, so that a mixture can weigh them.
    pub fn parts(&self) -> Vec<Self> {
        let mut parts: Vec<Self> = Vec::new();
        for (dataset, range) in &self.content.scenes {
            match parts.last_mut() {
                Some(part) if part.name == *dataset => part.range.end = range.end,
                _ => parts.push(Self { content: self.content.clone(), name: dataset.clone(), range: range.clone() }),
            }
        }
        parts
    }

    /// The shard and the place in it.
    fn place(&self, index: usize) -> Result<(&Shard, usize), DataError> {
        let at = self.range.start + index;
        let number = self.content.starts.partition_point(|start| *start <= at).saturating_sub(1);
        let found = self.content.shards.get(number).zip(self.content.starts.get(number));
        match found.filter(|_| index < self.range.len()) {
            Some((shard, start)) => Ok((shard, at - start)),
            None => Err(DataError::Config(format!("{} has no frame {index}, only {}", self.name, self.range.len()))),
        }
    }
}

impl LatentDataset for LatentFolder {
    fn shape(&self) -> [usize; 3] {
        self.content.head.shape
    }

    fn latent(&self, index: usize) -> Result<Latent, DataError> {
        let (shard, at) = self.place(index)?;
        shard.latent(at)
    }
}

impl SceneDataset for LatentFolder {
    fn len(&self) -> usize {
        self.range.len()
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let (shard, at) = self.place(index)?;
        Ok(shard.record(at)?.frame())
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let own = self
            .content
            .scenes
            .iter()
            .filter(|(_, scene)| scene.start >= self.range.start && scene.end <= self.range.end);
        own.map(|(_, scene)| scene.start - self.range.start..scene.end - self.range.start).collect()
    }

    fn name(&self) -> &str {
        &self.name
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { boxes: true, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        0
    }
}
