//! `train-unet`: trains caption-conditioned latent diffusion on a frozen autoencoder, and paints samples.

use anyhow::Context;
use clap::Parser;
use data::SampleOptions;
use serde::Serialize;
use train::Outcome;

use super::common::say;
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::latent_diffusion::{DiffusionEvaluator, DiffusionScores, UNetExperiment, UNetTask};

/// Train latent diffusion: captions to pictures of one camera, or of all cameras of a rig together
#[derive(Debug, Parser)]
#[command(
    name = "train-unet",
    version,
    after_help = "Example:\n  train-autoencoder --config configs/toy/autoencoder.toml\n  train-unet --config configs/toy/unet.toml"
)]
pub struct TrainUNetArgs {
    /// What every training command takes.
    #[command(flatten)]
    pub run: TrainArgs,
}

train_experiment!(UNetExperiment, checked);

/// What `summary.json` holds.
#[derive(Debug, Serialize)]
struct Summary {
    held_out: DiffusionScores,
    /// Of the sheet of samples, one pair of rows each.
    captions: Vec<String>,
    #[serde(flatten)]
    figures: LoopFigures,
}

/// Runs the command.
///
/// # Errors
/// Anything that keeps the run from its end; checkpoints written so far stay usable.
pub fn train_unet(args: &TrainUNetArgs) -> anyhow::Result<()> {
    if args.run.print_config {
        return print_config::<UNetExperiment>(&args.run);
    }
    let mut run: Prepared<UNetExperiment> = prepare(&args.run)?;
    let options = SampleOptions { size: run.experiment.image, pose_mode: run.experiment.data.loader.pose_mode };
    let evaluator = DiffusionEvaluator::new(run.validation.clone(), options, run.experiment.seed, &run.device);
    let mut task = UNetTask::new(&run.experiment, &run.device.clone().autodiff(), evaluator)?;
    let outcome = run.train(&mut task, &args.run)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&mut run, &task, &outcome)
}

/// Final measurements, samples, the folder for diffusers, `summary.json` and the table.
fn finish(run: &mut Prepared<UNetExperiment>, task: &UNetTask, outcome: &Outcome) -> anyhow::Result<()> {
    let held_out = task.scores(run.experiment.evaluation.final_frames).context("measuring held-out data")?;
    let samples = run.run_dir.path().join("pictures").join("samples.png");
    let captions = task.paint(&samples)?;
    let exported = task.export(run.run_dir.path())?;
    let summary = Summary { held_out, captions, figures: LoopFigures::of(run, outcome) };
    write_summary(&run.run_dir, &summary)?;
    let DiffusionScores { loss, loss_other_caption, loss_no_caption, loss_of_zero, frames } = held_out;
    say(format_args!(
        "\nheld-out error {loss:.4}; with another scene's caption {loss_other_caption:.4}, without caption {loss_no_caption:.4}, \
         of the answer 0 {loss_of_zero:.4}; {frames} frames\n{}\nsamples under their true pictures: {}\nfor diffusers: {}",
        loop_line(outcome),
        samples.display(),
        exported.display()
    ))
}
