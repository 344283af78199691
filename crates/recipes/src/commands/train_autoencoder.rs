//! `train-autoencoder`: trains AutoencoderKL from nothing and writes it as a folder that `train-unet` and diffusers open.

use anyhow::Context;
use clap::Parser;
use serde::Serialize;
use stable_diffusion::layout::save_folder;
use train::Outcome;

use super::common::say;
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::autoencoder::{AutoencoderExperiment, AutoencoderTask, PictureEvaluator};
use crate::bev_vae::{MeanPictures, Scores};

/// Train the autoencoder of latent diffusion: single pictures to latents and back
#[derive(Debug, Parser)]
#[command(
    name = "train-autoencoder",
    version,
    after_help = "Example:\n  train-autoencoder --config configs/toy/autoencoder.toml --set train.steps=200"
)]
pub struct TrainAutoencoderArgs {
    /// What every training command takes.
    #[command(flatten)]
    pub run: TrainArgs,
}

train_experiment!(AutoencoderExperiment, checked);

/// What `summary.json` holds.
#[derive(Debug, Serialize)]
struct Summary {
    reconstruction: Scores,
    /// Standard deviation of unscaled latents of training pictures.
    latent_deviation: f64,
    /// What the saved folder multiplies latents with.
    scaling_factor: f64,
    #[serde(flatten)]
    figures: LoopFigures,
}

/// Runs the command.
///
/// # Errors
/// Anything that keeps the run from its end; checkpoints written so far stay usable.
pub fn train_autoencoder(args: &TrainAutoencoderArgs) -> anyhow::Result<()> {
    if args.run.print_config {
        return print_config::<AutoencoderExperiment>(&args.run);
    }
    let mut run: Prepared<AutoencoderExperiment> = prepare(&args.run)?;
    let mut task = AutoencoderTask::new(&run.experiment, &run.device.clone().autodiff(), evaluator(&run)?)?;
    let outcome = run.train(&mut task, &args.run)?;
    if outcome.interrupted {
        return Ok(());
    }
    finish(&mut run, &task, &outcome)
}

fn evaluator(run: &Prepared<AutoencoderExperiment>) -> anyhow::Result<PictureEvaluator> {
    let (size, pose_mode) = (run.experiment.image, run.experiment.data.loader.pose_mode);
    let frames = run.experiment.evaluation.baseline_frames;
    let means = MeanPictures::measure(&run.training, frames, size, pose_mode, &[])
        .context("measuring the mean training pictures")?;
    Ok(PictureEvaluator::new(run.validation.clone(), means, (size, pose_mode), &run.device))
}

/// Final measurements, the folder `vae`, pictures, `summary.json` and the table.
fn finish(run: &mut Prepared<AutoencoderExperiment>, task: &AutoencoderTask, outcome: &Outcome) -> anyhow::Result<()> {
    let (model, evaluator) = (task.averaged(), task.evaluator());
    let config = &run.experiment.evaluation;
    let reconstruction = evaluator.scores(&model, config.final_frames).context("measuring held-out data")?;
    let deviation =
        evaluator.latent_deviation(&model, &run.training, config.baseline_frames).context("measuring the latents")?;
    let folder = run.run_dir.path();
    evaluator.pictures(&model, &folder.join("pictures"))?;
    save_folder(&model.with_scaling_factor(1.0 / deviation)?, folder.join("vae"))?;
    let summary = Summary {
        reconstruction,
        latent_deviation: deviation,
        scaling_factor: 1.0 / deviation,
        figures: LoopFigures::of(run, outcome),
    };
    write_summary(&run.run_dir, &summary)?;
    let Scores { psnr_db, mean_image_db, pictures, .. } = reconstruction;
    say(format_args!(
        "\nheld-out reconstruction {psnr_db:.2} dB, mean image {mean_image_db:.2} dB, over {pictures} pictures; latent deviation \
         {deviation:.3}\n{}\nautoencoder: {}\npictures, summary.json and checkpoints: {}",
        loop_line(outcome),
        run.run_dir.path().join("vae").display(),
        run.run_dir.path().display()
    ))
}
