//! `train-dit`: trains the transformer over latents of a frozen BEV-VAE, and measures what its layouts do.

use std::sync::Arc;

use anyhow::{Context, ensure};
use clap::Parser;
use data::latents::{
    LatentDataset, LatentFolder, LatentStatistics, NpyTree, NpyTreeConfig, Posterior, STATISTICS, StatisticsCollector,
};
use data::{DatasetConfig, PadViews, Sample, SceneDataset, assemble};
use serde::Serialize;
use train::Outcome;

use super::common::{open_all, say};
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::bev_vae::spread;
use crate::dit::{
    DitEvaluator, DitExperiment, DitScores, DitTask, EditScores, GeneratedScores, HeldOut, LatentSource, StoredLatents,
    TrainingData, TreeLatents,
};
use crate::latents::{EncodeOptions, FrozenVae, open_or_encode};

/// Train a diffusion transformer: layouts of 3-D boxes to bird's-eye-view latents, which decode into any camera rig
#[derive(Debug, Parser)]
#[command(
    name = "train-dit",
    version,
    after_help = "Example:\n  train-vae --config configs/toy/vae.toml\n  train-dit --config configs/toy/dit.toml"
)]
pub struct TrainDitArgs {
    /// What every training command takes.
    #[command(flatten)]
    pub run: TrainArgs,
}

train_experiment!(DitExperiment, checked, false);

/// What `summary.json` holds.
#[derive(Debug, Serialize)]
struct Summary {
    held_out: DitScores,
    /// Figures of sampled layouts; `None` where `evaluation.generated` is 0.
    generated: Option<GeneratedScores>,
    /// What a removed box changes; `None` where `evaluation.edits` is 0 or no layout has a visible box.
    edits: Option<EditScores>,
    parameters: usize,
    vae_hash: String,
    #[serde(flatten)]
    figures: LoopFigures,
}

/// Everything the run learns from and is measured on.
struct Latents {
    training: TrainingData,
    held_out: HeldOut,
    statistics: LatentStatistics,
}

/// Runs the command.
///
/// # Errors
/// Anything that keeps the run from its end; checkpoints written so far stay usable.
pub fn train_dit(args: &TrainDitArgs) -> anyhow::Result<()> {
    if args.run.print_config {
        return print_config::<DitExperiment>(&args.run);
    }
    let mut run: Prepared<DitExperiment> = prepare(&args.run)?;
    let vae = FrozenVae::open(&run.experiment.autoencoder, &run.device)?;
    run.experiment.network(&vae)?;
    let latents = open_latents(&run, &vae)?;
    let rig = run.experiment.preview.rig.load().context("preview.rig")?;
    let evaluator = DitEvaluator::new(latents.held_out, rig, run.experiment.seed);
    let device = run.device.clone().autodiff();
    let mut task = DitTask::new(&run.experiment, &device, vae, latents.statistics, evaluator)?;
    let training = latents.training;
    let outcome = run.train_from(&mut task, |position| training.open(position), &args.run)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&mut run, &task, &outcome)
}

fn open_latents(run: &Prepared<DitExperiment>, vae: &FrozenVae) -> anyhow::Result<Latents> {
    match &run.experiment.latents.source {
        LatentSource::Online { statistics_samples } => online(run, vae, *statistics_samples),
        LatentSource::Moments(stored) => shards(run, vae, stored),
        LatentSource::NpyTree(tree) => npy_tree(run, vae, tree),
    }
}

fn shards(run: &Prepared<DitExperiment>, vae: &FrozenVae, stored: &StoredLatents) -> anyhow::Result<Latents> {
    let experiment = &run.experiment;
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

fn npy_tree(run: &Prepared<DitExperiment>, vae: &FrozenVae, tree: &TreeLatents) -> anyhow::Result<Latents> {
    let experiment = &run.experiment;
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
    let measured = run.run_dir.path().join(STATISTICS);
    let stated = tree.root.join(STATISTICS);
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
    let latent =
        burn::tensor::Tensor::from_data(burn::tensor::TensorData::new(latent.mean, [1, c, h, w]), vae.device());
    let decoded = vae.decode(latent, &batch.target);
    let mut psnr = metrics::Psnr::default();
    for (view, picture) in
        crate::bev_vae::pictures_of(&batch.target).enumerate().filter(|(view, _)| batch.target.mask[*view])
    {
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

fn online(run: &Prepared<DitExperiment>, vae: &FrozenVae, samples: usize) -> anyhow::Result<Latents> {
    let experiment = &run.experiment;
    let datasets = annotated(&experiment.data.train).context("data.train")?;
    let held_out = annotated(&experiment.data.validation).context("data.validation")?;
    let path = run.run_dir.path().join(STATISTICS);
    let statistics = if path.is_file() {
        LatentStatistics::read(&path)?
    } else {
        tracing::info!("measuring the latents of {samples} frames");
        let total = datasets.iter().map(|dataset| dataset.len()).sum();
        let chosen = spread(total, samples).into_iter();
        let latent = |at: usize| -> anyhow::Result<data::latents::Latent> {
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
    latents: impl Iterator<Item = anyhow::Result<data::latents::Latent>>,
) -> anyhow::Result<LatentStatistics> {
    let mut collector = StatisticsCollector::new(vae.latent_shape()[0], posterior);
    for latent in latents {
        collector.add(&latent?);
    }
    collector.finish(vae.hash(), names, vae.grid()).map_err(anyhow::Error::msg)
}

fn annotated(configs: &[DatasetConfig]) -> anyhow::Result<Vec<Arc<dyn SceneDataset>>> {
    ensure!(!configs.is_empty(), "at least one dataset is needed");
    open_all(configs)
}

fn mixed(experiment: &DitExperiment, parts: Vec<Arc<dyn LatentDataset>>) -> anyhow::Result<TrainingData> {
    let classes = experiment.condition.classes.classes();
    TrainingData::stored(parts, (&experiment.data.mixture, experiment.loader_config()), &classes)
}

/// Final measurements, pages, `summary.json` and the table.
fn finish(run: &mut Prepared<DitExperiment>, task: &DitTask, outcome: &Outcome) -> anyhow::Result<()> {
    let measured = task.measure().context("measuring held-out data")?;
    let folder = run.run_dir.path().join("pictures");
    task.draw(&folder)?;
    let summary = Summary {
        held_out: measured.held_out,
        generated: measured.generated,
        edits: measured.edits,
        parameters: task.parameters(),
        vae_hash: task.vae_hash().to_owned(),
        figures: LoopFigures::of(run, outcome),
    };
    write_summary(&run.run_dir, &summary)?;
    say(table(&summary, outcome))?;
    say(format_args!("pages of sampled layouts, summary.json and checkpoints: {}", run.run_dir.path().display()))
}

fn table(summary: &Summary, outcome: &Outcome) -> String {
    let DitScores { loss, loss_no_layout, loss_other_layout, loss_of_zero, samples } = summary.held_out;
    let mut lines = vec![format!(
        "\nheld-out error {loss:.4}; without layout {loss_no_layout:.4}, with another one {loss_other_layout:.4}, of the answer 0 \
         {loss_of_zero:.4}; {samples} samples"
    )];
    if let Some(made) = &summary.generated {
        lines.push(format!(
            "distance of {} sampled scenes: {:.4} without guidance, {:.4} at 1, {:.4} at {}; another layout changes pictures by {:.4} at 0, \
             {:.4} at {}",
            made.layouts,
            made.distance_unconditional,
            made.distance_conditional,
            made.distance_guided,
            made.guidance_scale,
            made.guidance_zero_difference,
            made.guided_difference,
            made.guidance_scale
        ));
    }
    if let Some(edits) = &summary.edits {
        lines.push(format!(
            "a removed box changes {:.1} % of the pixels where it stood and {:.1} % where boxes at random places would: {:.1} times as \
             many; {} boxes",
            edits.changed_in_box * 100.0,
            edits.changed_in_random_boxes * 100.0,
            edits.ratio,
            edits.edits
        ));
    }
    lines.push(loop_line(outcome));
    lines.join("\n")
}
