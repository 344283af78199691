//! What was trained as a folder in diffusers' layout.

use std::path::Path;

use anyhow::Context;
use diffusion::{BetaSchedule, Target};
use serde_json::{Value, json};
use stable_diffusion::layout::save_folder;

use super::{Denoiser, DiffusionConfig, LatentCoder};

/// Writes `unet`, `vae` and `scheduler`. A small text encoder has no place in that layout; it stays in the checkpoint.
///
/// # Errors
/// Names the file that cannot be written.
pub fn save_pipeline(
    root: &Path,
    denoiser: &Denoiser,
    coder: &LatentCoder,
    config: &DiffusionConfig,
) -> anyhow::Result<()> {
    save_folder(&denoiser.unet, root.join("unet"))?;
    save_folder(coder.autoencoder(), root.join("vae"))?;
    let folder = root.join("scheduler");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make the folder {}", folder.display()))?;
    let path = folder.join("scheduler_config.json");
    let part = folder.join(".scheduler_config.json.part");
    std::fs::write(&part, format!("{:#}\n", scheduler(config)))
        .and_then(|()| std::fs::rename(&part, &path))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// The schedule as diffusers' DDIM scheduler reads it.
fn scheduler(config: &DiffusionConfig) -> Value {
    let (kind, [start, end]) = match config.schedule.beta {
        BetaSchedule::Linear { start, end } => ("linear", [start, end]),
        BetaSchedule::ScaledLinear { start, end } => ("scaled_linear", [start, end]),
        // diffusers' own defaults; the cosine schedule does not look at them.
        BetaSchedule::Cosine => ("squaredcos_cap_v2", [0.0001, 0.02]),
    };
    let prediction = match config.target {
        Target::Noise => "epsilon",
        Target::Velocity => "v_prediction",
        Target::Clean => "sample",
    };
    json!({
        "_class_name": "DDIMScheduler",
        "beta_end": end,
        "beta_schedule": kind,
        "beta_start": start,
        "clip_sample": false,
        "num_train_timesteps": config.schedule.timesteps,
        "prediction_type": prediction,
        "rescale_betas_zero_snr": config.schedule.zero_terminal_snr,
        "set_alpha_to_one": false,
        "steps_offset": 1,
    })
}
