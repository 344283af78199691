//! Weights before the first step: fresh ones, those of another run or of a published folder, and adapters on them.

use std::path::Path;

use anyhow::{Context, ensure};
use burn::module::Module;
use burn::tensor::Device;
use nn::Init;
use nn::lora;
use stable_diffusion::UNet2DCondition;
use stable_diffusion::layout::{CONFIG_FILE, CROSS_VIEW_MODULES, load_weights_beside, open_folder};
use train::{Keep, find_checkpoint};

use super::{Captioner, Denoiser, UNetExperiment};
use crate::config_file;

/// Name of the adapter that a run trains.
pub const ADAPTER: &str = "default";

/// Where a published folder keeps its UNet.
const UNET: &str = "unet";

/// Everything that computes, as it is before the first step; the seed gives what nothing else gives.
///
/// # Errors
/// Names the file or setting that does not fit.
pub fn first_weights(experiment: &UNetExperiment, captioner: &Captioner, device: &Device) -> anyhow::Result<Denoiser> {
    let fresh = captioner.denoiser(&experiment.text, &experiment.model.config, &mut Init::new(experiment.seed, device));
    let Some(path) = &experiment.init_from else { return Ok(fresh) };
    let published = path.join(UNET).join(CONFIG_FILE).is_file();
    let start = if published { from_folder(path, fresh) } else { from_run(path, experiment, fresh) };
    let start = start.with_context(|| format!("init_from = {path:?}"))?;
    let Some(adapter) = &experiment.adapter else { return Ok(start) };
    let unet = lora::attach(start.unet, ADAPTER, adapter, experiment.seed).context("[adapter]")?;
    Ok(Denoiser { unet, text: start.text.map(Module::no_grad) })
}

/// Which parameters learn, and so are averaged and kept in checkpoints.
pub fn learning(experiment: &UNetExperiment) -> Keep {
    if experiment.adapter.is_some() { lora::is_factor } else { |_| true }
}

/// The UNet of a folder in diffusers' layout; modules of cross-view attention that it lacks stay as they are.
fn from_folder(path: &Path, fresh: Denoiser) -> anyhow::Result<Denoiser> {
    let (config, file) = open_folder::<UNet2DCondition>(path.join(UNET))?;
    let (mut theirs, ours) = (config, fresh.unet.config());
    theirs.encoder.cross_view = ours.encoder.cross_view;
    ensure!(theirs == *ours, "[model] describes another UNet than {}", path.join(UNET).join(CONFIG_FILE).display());
    Ok(Denoiser { unet: load_weights_beside(fresh.unet, &file, &CROSS_VIEW_MODULES)?.0, text: fresh.text })
}

/// The averaged weights of a run of train-unet.
fn from_run(path: &Path, experiment: &UNetExperiment, fresh: Denoiser) -> anyhow::Result<Denoiser> {
    let reader = find_checkpoint(path)?;
    let theirs: UNetExperiment = config_file::parse(&reader.config_text("model")?, &[])
        .with_context(|| format!("in the config that the checkpoint carries: {}", reader.folder().display()))?;
    ensure!(theirs.adapter.is_none(), "holds adapters only; start from what they were trained on");
    let same = theirs.text == experiment.text && theirs.model.config == experiment.model.config;
    ensure!(same, "[model] or [text] differ from the run's: {}", reader.folder().display());
    Ok(reader.module("ema", fresh)?)
}
