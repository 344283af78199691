//! `train-dit`: trains the transformer over latents of a frozen BEV-VAE, and measures what its layouts do.

use anyhow::Context;
use clap::Parser;
use serde::Serialize;
use train::Outcome;

use super::common::say;
use super::training::{
    LoopFigures, Prepared, TrainArgs, loop_line, prepare, print_config, train_experiment, write_summary,
};
use crate::dit::{DitEvaluator, DitExperiment, DitScores, DitTask, EditScores, GeneratedScores, Latents};
use crate::latents::FrozenVae;

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
    let latents = Latents::open(&run.experiment, &vae, run.run_dir.path())?;
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
            "a removed box changes {:.1} % of the pixels where it stood and {:.1} % where boxes at random places would stand; {} boxes",
            edits.changed_in_box * 100.0,
            edits.changed_in_random_boxes * 100.0,
            edits.edits
        ));
    }
    lines.push(loop_line(outcome));
    lines.join("\n")
}
