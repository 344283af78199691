//! The `Task` of the autoencoder.

use std::path::Path;

use burn::tensor::Device;
use data::SceneBatch;
use nn::Init;
use stable_diffusion::{AutoencoderKL, Preset};
use train::{CheckpointReader, CheckpointWriter, Scalars, StepContext, StepOutput, Task, TrainError};

use super::step::Step;
use super::{AutoencoderExperiment, PictureEvaluator};
use crate::bev_vae::PixelRange;
use crate::trainer::{Trainer, TrainerConfig};

/// The networks that learn, and what they are measured with.
pub struct AutoencoderTask {
    frames: usize,
    views: usize,
    device: Device,
    trainer: Trainer<AutoencoderKL>,
    evaluator: PictureEvaluator,
}

/// Channels of the discriminator at full resolution.
fn discriminator_channels(preset: Preset) -> usize {
    match preset {
        Preset::Debug => 4,
        Preset::Tiny => 8,
        Preset::Small | Preset::Sd15 | Preset::Sd21 => 64,
    }
}

impl AutoencoderTask {
    /// Fresh networks; `device` carries the tape.
    ///
    /// # Errors
    /// Sizes that the discriminator cannot take, an unreadable weights file.
    pub fn new(
        experiment: &AutoencoderExperiment,
        device: &Device,
        evaluator: PictureEvaluator,
    ) -> anyhow::Result<Self> {
        let model = AutoencoderKL::new(&experiment.model.config, &mut Init::new(experiment.seed, device));
        let config = TrainerConfig {
            seed: experiment.seed,
            compute: experiment.device,
            loss: &experiment.loss,
            optimizer: &experiment.optimizer,
            ema: experiment.ema,
            size: experiment.image,
            discriminator_channels: discriminator_channels(experiment.model.preset.0),
            range: PixelRange::Signed,
        };
        let trainer = Trainer::new(model, &config, device)?;
        let (frames, views) = (experiment.evaluation.frames, experiment.views);
        Ok(Self { frames, views, device: device.clone(), trainer, evaluator })
    }

    /// The model with averaged weights, without a tape.
    pub fn averaged(&self) -> AutoencoderKL {
        self.trainer.averaged()
    }

    /// What is measured.
    pub fn evaluator(&self) -> &PictureEvaluator {
        &self.evaluator
    }
}

impl Task for AutoencoderTask {
    type Batch = SceneBatch;

    fn train_step(&mut self, batches: Vec<SceneBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        let (device, views) = (&self.device, self.views);
        self.trainer.step(&batches, ctx, |model, losses, batch, micro| {
            Step { model, losses, views, device }.run(batch, micro, ctx)
        })
    }

    fn validate(&mut self, _ctx: &StepContext) -> Result<Scalars, TrainError> {
        let scores = self.evaluator.scores(&self.averaged(), self.frames).map_err(TrainError::task)?;
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
