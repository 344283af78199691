//! The `Task` of BEV-VAE: what it owns, how a step changes it, and what goes into a checkpoint.

use std::path::Path;

use burn::tensor::Device;
use data::SceneBatch;
use nn::Init;
use train::{CheckpointReader, CheckpointWriter, Scalars, StepContext, StepOutput, Task, TrainError};
use vae::BevVae;

use super::step::Step;
use super::{Evaluator, Experiment, PixelRange};
use crate::trainer::{Trainer, TrainerConfig};

/// The networks that learn, and what they are measured with.
pub struct BevVaeTask {
    frames: usize,
    device: Device,
    trainer: Trainer<BevVae>,
    evaluator: Evaluator,
}

impl BevVaeTask {
    /// Fresh networks; `device` carries the tape.
    ///
    /// # Errors
    /// Sizes that the discriminator cannot take, an unreadable weights file.
    pub fn new(experiment: &Experiment, device: &Device, evaluator: Evaluator) -> anyhow::Result<Self> {
        let model = BevVae::new(&experiment.model.config, &mut Init::new(experiment.seed, device))
            .starting_from(evaluator.means().colour());
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
        Ok(Self { frames: experiment.evaluation.frames, device: device.clone(), trainer, evaluator })
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

impl Task for BevVaeTask {
    type Batch = SceneBatch;

    fn train_step(&mut self, batches: Vec<SceneBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        let device = &self.device;
        self.trainer
            .step(&batches, ctx, |model, losses, batch, micro| Step { model, losses, device }.run(batch, micro, ctx))
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
