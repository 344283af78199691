//! `train-vae`: trains BEV-VAE as its config says, measures it and writes everything into the run's folder.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use clap::Parser;
use data::{Mixture, SceneDataset};
use serde::Serialize;
use train::{DeviceConfig, Interrupt, OnExisting, Outcome, RunDir, RunSetup};

use super::common::{open_all, say};
use crate::bev_vae::{BevVaeTask, Evaluation, Evaluator, Experiment, LoaderSource, MeanPictures, Scores};
use crate::config_file;

/// Train BEV-VAE: pictures of any camera rig to one bird's-eye-view latent and back
#[derive(Debug, Parser)]
#[command(
    name = "train-vae",
    version,
    after_help = "Example:\n  train-vae --config configs/toy/vae.toml --set train.steps=200"
)]
pub struct TrainVaeArgs {
    /// Experiment file (TOML), for example configs/toy/vae.toml
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Change one setting, for example `--set optimizer.generator.learning_rate=1e-4`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Go on from the newest checkpoint of the run's folder
    #[arg(long)]
    pub resume: bool,
    /// Where to compute: flex, or a backend that was compiled in (ndarray, wgpu, vulkan, metal, cuda, rocm)
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
    /// Stop, saved and ready for --resume, after this many steps of the whole run
    #[arg(long, value_name = "STEPS")]
    pub stop_after: Option<u64>,
}

/// What `summary.json` holds.
#[derive(Debug, Serialize)]
struct Summary {
    reconstruction: Scores,
    novel_view: Option<Scores>,
    novel_view_yaw_deg: Vec<f64>,
    steps: u64,
    seconds: f64,
    images_per_second: f64,
    data_wait_fraction: f64,
    peak_rss_bytes: Option<u64>,
    device: String,
    seed: u64,
}

/// Runs the command.
///
/// # Errors
/// Anything that keeps the run from its end; checkpoints written so far stay usable.
pub fn train_vae(args: &TrainVaeArgs) -> anyhow::Result<()> {
    let mut experiment: Experiment = config_file::load(&args.config, &args.overrides)?;
    experiment.device = args.device.unwrap_or(experiment.device);
    if experiment.data.train.is_empty() || experiment.data.validation.is_empty() {
        bail!("data.train and data.validation need at least one dataset each: {}", args.config.display());
    }
    let interrupt = Interrupt::listen()?;
    let device = experiment.device.open()?;
    let training = open_all(&experiment.data.train).context("in data.train")?;
    let validation = open_all(&experiment.data.validation).context("in data.validation")?;
    let text = toml::to_string(&experiment).context("cannot write the resolved config")?;
    let run_dir = open_run(&experiment, args.resume)?;
    run_dir.write_config(&text, Path::new("."))?;

    let loader = experiment.loader_config();
    let mixture = Mixture::new(training.clone(), &experiment.data.mixture, loader.batch_size, experiment.seed)?;
    let mixture = Arc::new(mixture);
    let evaluator = evaluator(&experiment, &training, validation, &device)?;
    let mut task = BevVaeTask::new(&experiment, &device.autodiff(), evaluator)?;
    let setup = RunSetup {
        config: &experiment.train,
        run_dir: &run_dir,
        seed: experiment.seed,
        config_text: &text,
        resume: args.resume,
        interrupt,
        pause_after: args.stop_after,
    };
    let outcome = train::train(&mut task, |position| LoaderSource::open(mixture, loader, position), &setup)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&experiment, &task, &outcome, &run_dir)
}

fn open_run(experiment: &Experiment, resume: bool) -> anyhow::Result<RunDir> {
    let on_existing = if resume { OnExisting::Resume } else { OnExisting::NextFreeName };
    let run_dir = RunDir::create(&experiment.run.root, &experiment.run.name, on_existing)?;
    tracing::info!(folder = %run_dir.path().display(), "run");
    Ok(run_dir)
}

fn evaluator(
    experiment: &Experiment,
    training: &[Arc<dyn SceneDataset>],
    validation: Vec<Arc<dyn SceneDataset>>,
    device: &burn::tensor::Device,
) -> anyhow::Result<Evaluator> {
    let config = &experiment.evaluation;
    let (size, pose_mode) = (experiment.image_size(), experiment.data.loader.pose_mode);
    let means = MeanPictures::measure(training, config.baseline_frames, size, pose_mode, &config.yaw_deg)
        .context("measuring the mean training pictures")?;
    Ok(Evaluator::new(validation, means, config.yaw_deg.clone(), size, pose_mode, device))
}

/// Final measurements, pictures, `summary.json` and the table.
fn finish(experiment: &Experiment, task: &BevVaeTask, outcome: &Outcome, run_dir: &RunDir) -> anyhow::Result<()> {
    let model = task.averaged();
    let frames = experiment.evaluation.final_frames;
    let evaluation = task.evaluator().evaluate(&model, frames).context("measuring held-out data")?;
    task.evaluator().pictures(&model, &run_dir.path().join("pictures"))?;
    let summary = Summary {
        reconstruction: evaluation.reconstruction,
        novel_view: evaluation.novel_view,
        novel_view_yaw_deg: evaluation.yaw_deg.clone(),
        steps: outcome.steps,
        seconds: outcome.seconds,
        images_per_second: outcome.images_per_second,
        data_wait_fraction: outcome.data_wait_fraction,
        peak_rss_bytes: outcome.peak_rss_bytes,
        device: experiment.device.to_string(),
        seed: experiment.seed,
    };
    let path = run_dir.path().join("summary.json");
    let part = run_dir.path().join(".summary.json.part");
    std::fs::write(&part, serde_json::to_string_pretty(&summary)?)
        .and_then(|()| std::fs::rename(&part, &path))
        .with_context(|| format!("cannot write {}", path.display()))?;
    say(table(&evaluation, outcome))?;
    say(format_args!("pictures, summary.json and checkpoints: {}", run_dir.path().display()))
}

fn table(evaluation: &Evaluation, outcome: &Outcome) -> String {
    let mut lines = vec![
        String::new(),
        "held-out data            PSNR dB   baseline   gain   mean image   nearest view   pictures".to_owned(),
        row("reconstruction", &evaluation.reconstruction),
    ];
    if let Some(novel) = &evaluation.novel_view {
        let turns: Vec<String> = evaluation.yaw_deg.iter().map(|yaw| format!("{yaw:+}")).collect();
        lines.push(row(&format!("novel view {}°", turns.join(" ")), novel));
    }
    let memory = outcome.peak_rss_bytes.map_or_else(|| "unknown".to_owned(), |b| format!("{:.2} GB", b as f64 / 1e9));
    lines.push(format!(
        "{} steps, {:.0} s, {:.1} images/s, {:.1} % waiting for data, peak memory {memory}",
        outcome.steps,
        outcome.seconds,
        outcome.images_per_second,
        outcome.data_wait_fraction * 100.0
    ));
    lines.join("\n")
}

fn row(name: &str, scores: &Scores) -> String {
    let nearest = scores.nearest_view_db.map_or_else(|| "-".to_owned(), |db| format!("{db:.2}"));
    format!(
        "{name:<23}{:>9.2}{:>11.2}{:>+7.2}{:>13.2}{nearest:>15}{:>11}",
        scores.psnr_db,
        scores.baseline_db,
        scores.psnr_db - scores.baseline_db,
        scores.mean_image_db,
        scores.pictures
    )
}
