//! `train-vae`: trains BEV-VAE as its config says, measures it and writes everything into the run's folder.

use anyhow::Context;
use clap::Parser;
use serde::Serialize;
use train::Outcome;

use super::common::say;
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::bev_vae::{BevVaeTask, Evaluation, Evaluator, Experiment, MeanPictures, Scores};

/// Train BEV-VAE: pictures of any camera rig to one bird's-eye-view latent and back
#[derive(Debug, Parser)]
#[command(
    name = "train-vae",
    version,
    after_help = "Example:\n  train-vae --config configs/toy/vae.toml --set train.steps=200"
)]
pub struct TrainVaeArgs {
    /// What every training command takes.
    #[command(flatten)]
    pub run: TrainArgs,
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
    if args.run.print_config {
        return print_config::<Experiment>(&args.run);
    }
    let mut run: Prepared<Experiment> = prepare(&args.run)?;
    let mut task = BevVaeTask::new(&run.experiment, &run.device.clone().autodiff(), evaluator(&run)?)?;
    let outcome = run.train(&mut task, &args.run)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&mut run, &task, &outcome)
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
