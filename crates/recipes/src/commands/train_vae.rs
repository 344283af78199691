//! `train-vae`: trains BEV-VAE as its config says, measures it and writes everything into the run's folder.

use std::path::PathBuf;

use anyhow::{Context, bail};
use clap::Parser;
use serde::Serialize;
use train::{DeviceConfig, Outcome, find_checkpoint};

use super::common::say;
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::bev_vae::{
    BevVaeTask, Budget, Evaluation, Evaluator, Experiment, MeanPictures, Scores, Walk, duration, free_memory,
    operations_per_second, refusal,
};

/// Train BEV-VAE: pictures of any camera rig to one bird's-eye-view latent and back
#[derive(Debug, Parser)]
#[command(
    name = "train-vae",
    version,
    after_help = "Examples:\n  train-vae --config configs/toy/vae.toml --set train.steps=200\n  train-vae --config my_car.toml --init-from runs/toy-vae"
)]
pub struct TrainVaeArgs {
    /// What every training command takes.
    #[command(flatten)]
    pub run: TrainArgs,
    /// Start from the averaged weights of this run or checkpoint folder (of train-vae or of `rigscape import`), with fresh optimizers:
    /// fine-tuning, for example on a new rig. The networks must be equal
    #[arg(long, value_name = "DIR")]
    pub init_from: Option<PathBuf>,
    /// Start even if the run looks too large for this machine's memory
    #[arg(long)]
    pub ignore_memory: bool,
}

train_experiment!(Experiment);

/// What `summary.json` holds.
#[derive(Debug, Serialize)]
struct Summary {
    reconstruction: Scores,
    novel_view: Option<Scores>,
    novel_view_yaw_deg: Vec<f64>,
    #[serde(flatten)]
    figures: LoopFigures,
}

/// Runs the command.
///
/// # Errors
/// Anything that keeps the run from its end; checkpoints written so far stay usable.
pub fn train_vae(args: &TrainVaeArgs) -> anyhow::Result<()> {
    let mut options = args.run.clone();
    if let Some(path) = &args.init_from {
        // Through the config, so that the run's folder says where its weights come from.
        let path = toml::Value::String(path.to_string_lossy().into_owned());
        options.overrides.push(format!("init_from={path}"));
    }
    if options.print_config {
        return print_config::<Experiment>(&options);
    }
    let mut run: Prepared<Experiment> = prepare(&options)?;
    weigh(&run, args.ignore_memory)?;
    // A run that goes on has weights of its own.
    let goes_on = args.run.resume && find_checkpoint(run.run_dir.path()).is_ok();
    let init_from = run.experiment.init_from.as_deref().filter(|_| !goes_on);
    let mut task = BevVaeTask::new(&run.experiment, &run.device.clone().autodiff(), evaluator(&run)?, init_from)?;
    let outcome = run.train(&mut task, &args.run)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&mut run, &task, &outcome)
}

/// Says what the run will take, and refuses one that cannot fit.
fn weigh(run: &Prepared<Experiment>, anyway: bool) -> anyhow::Result<()> {
    let experiment = &run.experiment;
    let mut views = 0;
    for dataset in run.training.iter().filter(|dataset| !dataset.is_empty()) {
        views = views.max(dataset.frame(0)?.views.len());
    }
    let walk = Walk::of(experiment, views);
    let budget = Budget::of(experiment, walk);
    let time = duration(budget.operations, operations_per_second(&run.device));
    // Another device's memory is not ours to look into.
    let on_host = matches!(experiment.device, DeviceConfig::Flex | DeviceConfig::NdArray);
    let free = if on_host { free_memory() } else { None };
    let space = free.map_or_else(String::new, |free| format!("; {:.1} GB are free", free / 1e9));
    tracing::info!("estimate: {budget}{space}; {time} for {} steps if nothing else runs here", walk.steps);
    match free.and_then(|free| refusal(experiment, walk, free)) {
        Some(why) if !anyway => bail!(why),
        Some(why) => {
            tracing::warn!("{why}");
            Ok(())
        }
        None => Ok(()),
    }
}

fn evaluator(run: &Prepared<Experiment>) -> anyhow::Result<Evaluator> {
    let config = &run.experiment.evaluation;
    let (size, pose_mode) = (run.experiment.image_size(), run.experiment.data.loader.pose_mode);
    let means = MeanPictures::measure(&run.training, config.baseline_frames, size, pose_mode, &config.yaw_deg)
        .context("measuring the mean training pictures")?;
    Ok(Evaluator::new(run.validation.clone(), means, config.yaw_deg.clone(), size, pose_mode, &run.device))
}

/// Final measurements, pictures, `summary.json` and the table.
fn finish(run: &mut Prepared<Experiment>, task: &BevVaeTask, outcome: &Outcome) -> anyhow::Result<()> {
    let model = task.averaged();
    let frames = run.experiment.evaluation.final_frames;
    let evaluation = task.evaluator().evaluate(&model, frames).context("measuring held-out data")?;
    task.evaluator().pictures(&model, &run.run_dir.path().join("pictures"))?;
    let summary = Summary {
        reconstruction: evaluation.reconstruction,
        novel_view: evaluation.novel_view,
        novel_view_yaw_deg: evaluation.yaw_deg.clone(),
        figures: LoopFigures::of(run, outcome),
    };
    write_summary(&run.run_dir, &summary)?;
    say(table(&evaluation, outcome))?;
    say(format_args!("pictures, summary.json and checkpoints: {}", run.run_dir.path().display()))
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
    lines.push(loop_line(outcome));
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
