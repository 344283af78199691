//! The `Task` of BEV-VAE: what it owns, how a step changes it, and what goes into a checkpoint.

use std::path::Path;

use anyhow::{Context, bail};
use burn::tensor::Device;
use data::SceneBatch;
use nn::Init;
use train::{CheckpointReader, CheckpointWriter, Scalars, StepContext, StepOutput, Task, TrainError, find_checkpoint};
use vae::BevVae;

use super::step::Step;
use super::{Evaluator, Experiment, PixelRange};
use crate::trainer::{Trainer, TrainerConfig};
use crate::{config_file, differences};

/// The networks that learn, and what they are measured with.
pub struct BevVaeTask {
    frames: usize,
    checkpointing: bool,
    device: Device,
    trainer: Trainer<BevVae>,
    evaluator: Evaluator,
}

impl BevVaeTask {
    /// Fresh networks, or the averaged weights of another run's checkpoint `init_from`; `device` carries the tape.
    ///
    /// # Errors
    /// Sizes that the discriminator cannot take, an unreadable weights file, a checkpoint that is missing, damaged or of another
    /// network.
    pub fn new(
        experiment: &Experiment,
        device: &Device,
        evaluator: Evaluator,
        init_from: Option<&Path>,
    ) -> anyhow::Result<Self> {
        let fresh = BevVae::new(&experiment.model.config, &mut Init::new(experiment.seed, device));
        let model = match init_from {
            Some(path) => averaged_weights_of(path, fresh).context("in init_from")?,
            None => fresh.starting_from(evaluator.means().colour()),
        };
        let config = TrainerConfig {
            seed: experiment.seed,
            compute: experiment.device,
            loss: &experiment.loss,
            optimizer: &experiment.optimizer,
            ema: experiment.ema,
            size: experiment.image_size(),
            discriminator_channels: experiment.model.preset.discriminator_channels(),
            range: PixelRange::ImageNet,
        };
        let trainer = Trainer::new(model, &config, device)?;
        Ok(Self {
            frames: experiment.evaluation.frames,
            checkpointing: experiment.checkpointing,
            device: device.clone(),
            trainer,
            evaluator,
        })
    }

    /// The model with averaged weights, without a tape.
    pub fn averaged(&self) -> BevVae {
        self.trainer.averaged()
    }

    /// What is measured.
    pub fn evaluator(&self) -> &Evaluator {
        &self.evaluator
    }
}

/// `model` with the averaged weights of a checkpoint of the same network.
fn averaged_weights_of(path: &Path, model: BevVae) -> anyhow::Result<BevVae> {
    let reader = find_checkpoint(path)?;
    let folder = reader.folder().display().to_string();
    let theirs: Experiment = config_file::parse(&reader.config_text("ema")?, &[])
        .with_context(|| format!("in the config that the checkpoint carries: {folder}"))?;
    let lines = differences(&theirs.model.config, model.config())?;
    if !lines.is_empty() {
        bail!(
            "the checkpoint's network is another one; this experiment's model has\n  {}\n  in: {folder}",
            lines.join("\n  ")
        );
    }
    tracing::info!(checkpoint = %folder, step = reader.state().step, "starting from averaged weights");
    Ok(reader.module("ema", model)?)
}

impl Task for BevVaeTask {
    type Batch = SceneBatch;

    fn train_step(&mut self, batches: Vec<SceneBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        let (device, checkpointing) = (&self.device, self.checkpointing);
        self.trainer.step(&batches, ctx, |model, losses, batch, micro| {
            Step { model, losses, device, checkpointing }.run(batch, micro, ctx)
        })
    }

    fn validate(&mut self, _ctx: &StepContext) -> Result<Scalars, TrainError> {
        let scores = self.evaluator.reconstruction(&self.averaged(), self.frames).map_err(TrainError::task)?;
        Ok(vec![("psnr_db".to_owned(), scores.psnr_db)])
    }

    fn preview(&mut self, folder: &Path, _ctx: &StepContext) -> Result<(), TrainError> {
        self.evaluator.pictures(&self.averaged(), folder).map_err(TrainError::task)
    }

    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        self.trainer.save(writer)
    }

    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.trainer.load(reader)
    }
}
