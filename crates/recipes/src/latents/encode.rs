//! A frozen encoder over whole datasets.

use std::collections::HashSet;
use std::path::Path;
use std::sync::Arc;

use anyhow::ensure;
use data::latents::{
    LatentFolder, LatentHead, LatentStatistics, LatentType, LatentWriter, NpyLayout, NpyTreeConfig, NpyTreeWriter,
    Posterior, STATISTICS, StatisticsCollector,
};
use data::{DatasetConfig, FrameId, PadViews, Sample, SampleOptions, SceneDataset, SceneFrame, assemble};
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::FrozenVae;

/// How latents are made and stored.
#[derive(Debug, Clone)]
pub struct EncodeOptions {
    /// Half or single precision.
    pub dtype: LatentType,
    /// Samples of a shard.
    pub shard_samples: usize,
    /// Samples encoded at once.
    pub batch_size: usize,
    /// Leave out frames without a list of boxes.
    pub annotated_only: bool,
    /// What the statistics measure.
    pub posterior: Posterior,
}

impl Default for EncodeOptions {
    fn default() -> Self {
        Self {
            dtype: LatentType::F16,
            shard_samples: 1024,
            batch_size: 8,
            annotated_only: true,
            posterior: Posterior::Sample,
        }
    }
}

/// What an encoding left on the disk.
#[derive(Debug, Clone)]
pub struct Encoded {
    /// Samples in all.
    pub samples: usize,
    /// Of them, stored by an earlier run.
    pub earlier: usize,
    /// Frames left out because nobody annotated them.
    pub unannotated: usize,
    /// Their figures.
    pub statistics: LatentStatistics,
}

impl EncodeOptions {
    fn check(&self) -> anyhow::Result<()> {
        ensure!(self.batch_size > 0 && self.shard_samples > 0, "batches and shards need at least one sample");
        Ok(())
    }
}

/// Frames to encode, in order.
struct Frames {
    datasets: Vec<Arc<dyn SceneDataset>>,
    places: Vec<(usize, usize)>,
    unannotated: usize,
}

impl Frames {
    fn of(datasets: &[Arc<dyn SceneDataset>], annotated_only: bool) -> anyhow::Result<Self> {
        let (mut places, mut unannotated) = (Vec::new(), 0);
        for (number, dataset) in datasets.iter().enumerate() {
            for index in 0..dataset.len() {
                if annotated_only && !dataset.outline(index)?.annotated {
                    unannotated += 1;
                } else {
                    places.push((number, index));
                }
            }
        }
        ensure!(!places.is_empty(), "there is no frame to encode: {unannotated} frames are not annotated");
        Ok(Self { datasets: datasets.to_vec(), places, unannotated })
    }

    fn load(&self, place: (usize, usize), options: &SampleOptions) -> anyhow::Result<(SceneFrame, Sample)> {
        let (number, index) = place;
        let dataset = self.datasets.get(number).ok_or_else(|| anyhow::anyhow!("there is no dataset {number}"))?;
        let frame = dataset.frame(index)?;
        let sample = Sample::load(&frame, options)?;
        Ok((frame, sample))
    }

    fn names(&self) -> Vec<String> {
        self.datasets.iter().map(|dataset| dataset.name().to_owned()).collect()
    }
}

/// Encodes into a folder of shards, going on where an earlier run with the same settings stopped. `configs` are the settings of the
/// datasets, by which such a run is recognised.
///
/// # Errors
/// Whatever a frame reports; a folder that holds something else.
pub fn encode_folder(
    vae: &FrozenVae,
    (datasets, configs): (&[Arc<dyn SceneDataset>], &[DatasetConfig]),
    folder: &Path,
    options: &EncodeOptions,
) -> anyhow::Result<Encoded> {
    options.check()?;
    let frames = Frames::of(datasets, options.annotated_only)?;
    let head = LatentHead {
        vae_hash: vae.hash().to_owned(),
        source_sha256: source_hash(configs)?,
        datasets: frames.names(),
        shape: vae.latent_shape(),
        dtype: options.dtype,
        grid: *vae.grid(),
        shard_samples: options.shard_samples,
        annotated_only: options.annotated_only,
    };
    let mut writer = LatentWriter::open(folder, head)?;
    let earlier = writer.done();
    ensure!(
        earlier <= frames.places.len(),
        "the folder holds more latents than there are frames: {}",
        folder.display()
    );
    // Batches begin where shards do, so that a run that went on computes the same batches as one that did not stop.
    let mut told = earlier;
    for shard in frames.places[earlier..].chunks(options.shard_samples) {
        for batch in shard.chunks(options.batch_size) {
            for (frame, latent) in encode_batch(vae, &frames, batch)? {
                writer.add(&frame, latent)?;
                told += 1;
            }
        }
        tracing::info!("{told} of {} frames encoded", frames.places.len());
    }
    let statistics = writer.finish(options.posterior)?.statistics().cloned();
    let statistics = statistics.ok_or_else(|| anyhow::anyhow!("{} has no statistics", folder.display()))?;
    Ok(Encoded { samples: frames.places.len(), earlier, unannotated: frames.unannotated, statistics })
}

/// Encodes into the published layout, one file per instant; files that are there already are kept. The statistics file lies in the
/// split's folder.
///
/// # Errors
/// Whatever a frame reports; names that are no plain file names.
pub fn encode_tree(
    vae: &FrozenVae,
    datasets: &[Arc<dyn SceneDataset>],
    tree: &NpyTreeConfig,
    options: &EncodeOptions,
) -> anyhow::Result<Encoded> {
    options.check()?;
    let frames = Frames::of(datasets, options.annotated_only)?;
    let writer = NpyTreeWriter::new(tree.clone(), vae.latent_shape(), options.dtype)?;
    let has_moments = tree.layout == Some(NpyLayout::MomentsTokens);
    let posterior = if has_moments { options.posterior } else { Posterior::Mean };
    let mut collector = StatisticsCollector::new(vae.latent_shape()[0], posterior);
    let (mut earlier, mut seen) = (0, HashSet::new());
    for batch in frames.places.chunks(options.batch_size) {
        for (frame, latent) in encode_batch(vae, &frames, batch)? {
            let FrameId { dataset, scene, .. } = &frame.id;
            ensure!(
                seen.insert((scene.clone(), frame.timestamp_ns)),
                "{scene} of {dataset} at {} is in two datasets; a tree cannot hold both",
                frame.timestamp_ns
            );
            collector.add(&latent);
            if writer.has(&frame) {
                earlier += 1;
            } else {
                writer.add(&frame, &latent)?;
            }
        }
    }
    let statistics = collector.finish(vae.hash(), &frames.names().join("+"), vae.grid()).map_err(anyhow::Error::msg)?;
    statistics.write(&tree.folder().join(STATISTICS))?;
    Ok(Encoded { samples: frames.places.len(), earlier, unannotated: frames.unannotated, statistics })
}

fn encode_batch(
    vae: &FrozenVae,
    frames: &Frames,
    batch: &[(usize, usize)],
) -> anyhow::Result<Vec<(SceneFrame, data::latents::Latent)>> {
    let options = vae.sample_options();
    let loaded: Vec<(SceneFrame, Sample)> =
        batch.par_iter().map(|place| frames.load(*place, &options)).collect::<anyhow::Result<_>>()?;
    let (scenes, samples): (Vec<SceneFrame>, Vec<Sample>) = loaded.into_iter().unzip();
    let moments = vae.encode(&assemble(samples, PadViews::Largest)?);
    Ok(scenes.into_iter().zip(moments.latents()).collect())
}

fn source_hash(configs: &[DatasetConfig]) -> anyhow::Result<String> {
    let text = serde_json::to_vec(configs)?;
    Ok(Sha256::digest(&text).iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Finished latents of an experiment's datasets, made now where they are absent or were left unfinished. Without datasets they must be
/// there.
///
/// # Errors
/// As [`encode_folder`]; latents of other datasets.
pub(crate) fn open_or_encode(
    vae: &FrozenVae,
    configs: &[DatasetConfig],
    folder: &Path,
    options: &EncodeOptions,
) -> anyhow::Result<LatentFolder> {
    if configs.is_empty() {
        return Ok(LatentFolder::open(folder)?);
    }
    let finished = LatentFolder::exists(folder).then(|| LatentFolder::open(folder)).transpose();
    if let Ok(Some(found)) = finished {
        ensure!(
            found.head().source_sha256 == source_hash(configs)?,
            "the latents were made from datasets with other settings; choose another folder, remove it, or leave [data] out to use them \
             as they are: {}",
            folder.display()
        );
        return Ok(found);
    }
    tracing::info!(folder = %folder.display(), "encoding the pictures once; later runs read the latents");
    let datasets = configs.iter().map(|config| Ok(data::open(config)?)).collect::<anyhow::Result<Vec<_>>>()?;
    encode_folder(vae, (&datasets, configs), folder, options)?;
    Ok(LatentFolder::open(folder)?)
}
