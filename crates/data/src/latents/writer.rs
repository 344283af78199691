//! Writing a folder of latents, shard by shard: a killed run leaves whole shards only and goes on behind them.

use std::path::{Path, PathBuf};

use super::folder::LatentFolder;
use super::manifest::{LatentHead, MANIFEST, Manifest, Run, ShardEntry, shard_name};
use super::record::Record;
use super::shard::ShardContent;
use super::{Latent, LatentDataset, Posterior, STATISTICS, StatisticsCollector};
use crate::{DataError, SceneFrame};

/// Takes samples in the order of the datasets.
#[derive(Debug)]
pub struct LatentWriter {
    folder: PathBuf,
    manifest: Manifest,
    content: ShardContent,
    runs: Vec<Run>,
}

impl LatentWriter {
    /// Starts a folder, or goes on with one that was left unfinished by the same settings.
    ///
    /// # Errors
    /// A folder that holds something else; names it.
    pub fn open(folder: &Path, head: LatentHead) -> Result<Self, DataError> {
        crate::staging::create_dir(folder)?;
        let manifest = match Manifest::read(folder)? {
            Some(found) if found.head == head => found,
            Some(found) => {
                return Err(DataError::Config(format!(
                    "the folder holds latents of {}; choose another folder or remove it: {}",
                    difference(&found.head, &head),
                    folder.display()
                )));
            }
            None => {
                let mut entries = std::fs::read_dir(folder).map_err(crate::staging::io("list", folder))?;
                // What a run that died before its first shard left behind is ours.
                let foreign = entries
                    .any(|entry| entry.is_ok_and(|entry| !entry.file_name().to_string_lossy().ends_with(".part")));
                if foreign {
                    return Err(DataError::Config(format!(
                        "the folder is not empty and holds no {MANIFEST}; choose another one: {}",
                        folder.display()
                    )));
                }
                Manifest::new(head)
            }
        };
        manifest.write(folder)?;
        Ok(Self { folder: folder.to_owned(), manifest, content: ShardContent::default(), runs: Vec::new() })
    }

    /// Samples that are stored already: those to leave out.
    pub fn done(&self) -> usize {
        self.manifest.samples()
    }

    /// Whether nothing is left to do.
    pub fn is_complete(&self) -> bool {
        self.manifest.complete
    }

    /// Adds the next sample.
    ///
    /// # Errors
    /// A latent that does not fit, or that half precision cannot hold; a file that cannot be written.
    pub fn add(&mut self, frame: &SceneFrame, latent: Latent) -> Result<(), DataError> {
        let head = &self.manifest.head;
        let path = self.folder.join(shard_name(self.manifest.shards.len()));
        let latent = latent.checked(head.shape, &path)?;
        let record = Record::of(frame);
        self.content.push(&latent, &record, head.dtype, &path)?;
        match self.runs.last_mut() {
            Some(run) if run.dataset == record.dataset && run.scene == record.scene => run.samples += 1,
            _ => self.runs.push(Run { dataset: record.dataset, scene: record.scene, samples: 1 }),
        }
        if self.content.samples() == head.shard_samples { self.close_shard() } else { Ok(()) }
    }

    fn close_shard(&mut self) -> Result<(), DataError> {
        let file = shard_name(self.manifest.shards.len());
        let (content, runs) = (std::mem::take(&mut self.content), std::mem::take(&mut self.runs));
        let bytes = content.write(&self.folder.join(&file), self.manifest.head.shape, self.manifest.head.dtype)?;
        self.manifest.shards.push(ShardEntry { file, bytes, runs });
        self.manifest.write(&self.folder)
    }

    /// Writes what is left, measures everything that is stored, and marks the folder as finished.
    ///
    /// # Errors
    /// No samples at all, constant latents, a file that cannot be written.
    pub fn finish(mut self, posterior: Posterior) -> Result<LatentFolder, DataError> {
        if self.content.samples() > 0 {
            self.close_shard()?;
        }
        if !self.manifest.complete {
            let stored = LatentFolder::of_manifest(&self.folder, self.manifest.clone(), None)?;
            let mut collector = StatisticsCollector::new(stored.shape()[0], posterior);
            for index in 0..self.manifest.samples() {
                collector.add(&stored.latent(index)?);
            }
            let head = &self.manifest.head;
            let statistics = collector
                .finish(&head.vae_hash, &head.datasets.join("+"), &head.grid)
                .map_err(|why| DataError::Format { format: "set of latents", why, path: self.folder.clone() })?;
            statistics.write(&self.folder.join(STATISTICS))?;
            self.manifest.complete = true;
            self.manifest.write(&self.folder)?;
        }
        LatentFolder::open(&self.folder)
    }
}

/// Both folders' settings where they differ.
fn difference(found: &LatentHead, asked: &LatentHead) -> String {
    let pairs = [
        ("autoencoder", found.vae_hash.clone(), asked.vae_hash.clone()),
        ("datasets", found.datasets.join("+"), asked.datasets.join("+")),
        ("settings of the datasets", found.source_sha256.clone(), asked.source_sha256.clone()),
        ("shape", format!("{:?}", found.shape), format!("{:?}", asked.shape)),
        ("numbers", format!("{:?}", found.dtype), format!("{:?}", asked.dtype)),
        ("samples of a shard", found.shard_samples.to_string(), asked.shard_samples.to_string()),
        ("annotated frames only", found.annotated_only.to_string(), asked.annotated_only.to_string()),
        ("grid", format!("{:?}", found.grid), format!("{:?}", asked.grid)),
    ];
    let differing = pairs.into_iter().find(|(_, found, asked)| found != asked);
    differing
        .map_or("other settings".to_owned(), |(name, found, asked)| format!("another {name} ({found}, not {asked})"))
}
