//! What a run of `train-dit` learns from and is measured on, from any source (section 2.2 of the specification).

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, ensure};
use burn::tensor::{Tensor, TensorData};
use data::latents::{
    Latent, LatentDataset, LatentFolder, LatentStatistics, NpyTree, NpyTreeConfig, Posterior, STATISTICS,
    StatisticsCollector,
};
use data::{DatasetConfig, PadViews, Sample, SceneDataset, assemble};

use super::{DitExperiment, HeldOut, LatentSource, StoredLatents, TrainingData, TreeLatents};
use crate::bev_vae::{pictures_of, spread};
use crate::latents::{EncodeOptions, FrozenVae, open_or_encode};

/// Everything the run learns from and is measured on.
pub(crate) struct Latents {
    /// Samples in the run's order.
    pub training: TrainingData,
    /// Samples for measurements.
    pub held_out: HeldOut,
    /// Of the training latents.
    pub statistics: LatentStatistics,
}

impl Latents {
    /// Opens, encodes or measures what the experiment asks for; `run` is the run's folder, where statistics measured now are kept.
    ///
    /// # Errors
    /// Names the folder, file or setting.
    pub fn open(experiment: &DitExperiment, vae: &FrozenVae, run: &Path) -> anyhow::Result<Self> {
        match &experiment.latents.source {
            LatentSource::Online { statistics_samples } => online(experiment, vae, *statistics_samples, run),
            LatentSource::Moments(stored) => shards(experiment, vae, stored),
            LatentSource::NpyTree(tree) => npy_tree(experiment, vae, tree, run),
        }
    }
}

fn shards(experiment: &DitExperiment, vae: &FrozenVae, stored: &StoredLatents) -> anyhow::Result<Latents> {
    let options = EncodeOptions {
        dtype: stored.dtype,
        shard_samples: stored.shard_samples,
        batch_size: experiment.latents.encode_batch,
        posterior: experiment.latents.posterior,
        ..EncodeOptions::default()
    };
    let open = |name: &str, configs: &[DatasetConfig]| -> anyhow::Result<LatentFolder> {
        open_or_encode(vae, configs, &stored.folder.join(name), &options).with_context(|| format!("latents of {name}"))
    };
    let (train, validation) =
        (open("train", &experiment.data.train)?, open("validation", &experiment.data.validation)?);
    let statistics = train.statistics().cloned().context("the training latents have no statistics")?;
    for folder in [&train, &validation] {
        let head = folder.head();
        statistics
            .check_origin(&head.vae_hash, &head.grid)
            .map_err(|why| anyhow::anyhow!("{why}: {}", folder.path().display()))?;
    }
    statistics
        .check_origin(vae.hash(), vae.grid())
        .map_err(|why| anyhow::anyhow!("{why}: {}", train.path().display()))?;
    let parts = |folder: LatentFolder| -> Vec<Arc<dyn LatentDataset>> {
        folder.parts().into_iter().map(|part| Arc::new(part) as Arc<dyn LatentDataset>).collect()
    };
    Ok(Latents { training: mixed(experiment, parts(train))?, held_out: HeldOut::Stored(parts(validation)), statistics })
}

fn npy_tree(experiment: &DitExperiment, vae: &FrozenVae, tree: &TreeLatents, run: &Path) -> anyhow::Result<Latents> {
    let open = |split: &str, configs: &[DatasetConfig]| -> anyhow::Result<Vec<NpyTree>> {
        let datasets = annotated(configs)?;
        let config =
            NpyTreeConfig { root: tree.root.clone(), split: split.to_owned(), kind: tree.kind, layout: tree.layout };
        datasets.into_iter().map(|dataset| Ok(NpyTree::open(config.clone(), vae.latent_shape(), dataset)?)).collect()
    };
    let (train, validation) = (
        open(&tree.train_split, &experiment.data.train).context("latents of data.train")?,
        open(&tree.validation_split, &experiment.data.validation).context("latents of data.validation")?,
    );
    if let Some(first) = train.first() {
        check_decoded(vae, first, tree.least_psnr_db)?;
    }
    let measured = run.join(STATISTICS);
    let stated = tree.root.join(tree.kind.folder()).join(&tree.train_split).join(STATISTICS);
    let statistics = if stated.is_file() {
        LatentStatistics::read(&stated)?
    } else if measured.is_file() {
        LatentStatistics::read(&measured)?
    } else {
        tracing::info!("measuring the latents");
        let all = train.iter().flat_map(|tree| (0..tree.len()).map(move |index| Ok(tree.latent(index)?)));
        let names: Vec<&str> = train.iter().map(SceneDataset::name).collect();
        measure(vae, &names.join("+"), experiment.latents.posterior, all)?
    };
    statistics.write(&measured)?;
    let arcs = |trees: Vec<NpyTree>| -> Vec<Arc<dyn LatentDataset>> {
        trees.into_iter().map(|tree| Arc::new(tree) as Arc<dyn LatentDataset>).collect()
    };
    Ok(Latents { training: mixed(experiment, arcs(train))?, held_out: HeldOut::Stored(arcs(validation)), statistics })
}

/// Whether the arrays are read as they were written: the first latent must decode into its own pictures (trap 11).
fn check_decoded(vae: &FrozenVae, tree: &NpyTree, least_db: f64) -> anyhow::Result<()> {
    let (latent, frame) = (tree.latent(0)?, tree.source_frame(0)?);
    let batch = assemble(vec![Sample::load(&frame, &vae.sample_options())?], PadViews::Largest)?;
    let [c, h, w] = vae.latent_shape();
    let latent = Tensor::from_data(TensorData::new(latent.mean, [1, c, h, w]), vae.device());
    let decoded = vae.decode(latent, &batch.target);
    let mut psnr = metrics::Psnr::default();
    for (view, picture) in pictures_of(&batch.target).enumerate().filter(|(view, _)| batch.target.mask[*view]) {
        psnr.update_where(&decoded[view], picture, batch.target.counted_pixels(view));
    }
    let reached = psnr.summary().mean_db.context("the first frame has no picture to compare its latent with")?;
    ensure!(
        reached >= least_db,
        "the latents do not decode into their pictures: {reached:.1} dB, latents.source.npy_tree.least_psnr_db is {least_db}; they were \
         made by another autoencoder, or their arrays have another `layout`: {}",
        tree.config().root.display()
    );
    Ok(())
}

fn online(experiment: &DitExperiment, vae: &FrozenVae, samples: usize, run: &Path) -> anyhow::Result<Latents> {
    let datasets = annotated(&experiment.data.train).context("data.train")?;
    let held_out = annotated(&experiment.data.validation).context("data.validation")?;
    let path = run.join(STATISTICS);
    let statistics = if path.is_file() {
        LatentStatistics::read(&path)?
    } else {
        tracing::info!("measuring the latents of {samples} frames");
        let total = datasets.iter().map(|dataset| dataset.len()).sum();
        let chosen = spread(total, samples).into_iter();
        let latent = |at: usize| -> anyhow::Result<Latent> {
            let mut index = at;
            for dataset in &datasets {
                if index < dataset.len() {
                    let sample = Sample::load(&dataset.frame(index)?, &vae.sample_options())?;
                    let made = vae.encode(&assemble(vec![sample], PadViews::Largest)?).latents().pop();
                    return made.context("the encoder gave nothing");
                }
                index -= dataset.len();
            }
            anyhow::bail!("there is no frame {at}")
        };
        let names: Vec<&str> = datasets.iter().map(|dataset| dataset.name()).collect();
        measure(vae, &names.join("+"), experiment.latents.posterior, chosen.map(latent))?
    };
    statistics.write(&path)?;
    let mut loader = experiment.loader_config();
    let options = vae.sample_options();
    (loader.size, loader.pose_mode) = (options.size, options.pose_mode);
    let classes = experiment.condition.classes.classes();
    let training = TrainingData::pictures(datasets, (&experiment.data.mixture, loader), &classes)?;
    Ok(Latents { training, held_out: HeldOut::Pictures(held_out), statistics })
}

fn measure(
    vae: &FrozenVae,
    names: &str,
    posterior: Posterior,
    latents: impl Iterator<Item = anyhow::Result<Latent>>,
) -> anyhow::Result<LatentStatistics> {
    let mut collector = StatisticsCollector::new(vae.latent_shape()[0], posterior);
    for latent in latents {
        collector.add(&latent?);
    }
    collector.finish(vae.hash(), names, vae.grid()).map_err(anyhow::Error::msg)
}

fn annotated(configs: &[DatasetConfig]) -> anyhow::Result<Vec<Arc<dyn SceneDataset>>> {
    ensure!(!configs.is_empty(), "at least one dataset is needed");
    Ok(configs.iter().map(data::open).collect::<Result<_, _>>()?)
}

fn mixed(experiment: &DitExperiment, parts: Vec<Arc<dyn LatentDataset>>) -> anyhow::Result<TrainingData> {
    let classes = experiment.condition.classes.classes();
    TrainingData::stored(parts, (&experiment.data.mixture, experiment.loader_config()), &classes)
}
