//! The `Task` of latent diffusion.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use burn::module::Module;
use burn::tensor::Device;
use data::SceneBatch;
use nn::lora::{self, LoraLayout};
use train::{
    CheckpointReader, CheckpointWriter, Ema, GradientMean, Optimizer, Scalars, StepContext, StepOutput, Task,
    TrainError, in_lanes,
};

use super::start::{ADAPTER, first_weights, learning};
use super::step::Frozen;
use super::{Denoiser, DiffusionEvaluator, DiffusionScores, UNetExperiment, save_pipeline};

/// UNet and text encoder, their optimizer and averaged weights, and the frozen networks around them.
pub struct UNetTask {
    experiment: UNetExperiment,
    device: Device,
    denoiser: Denoiser,
    ema: Ema,
    optimizer: Optimizer,
    frozen: Frozen,
    evaluator: DiffusionEvaluator,
}

impl UNetTask {
    /// Fresh networks; `device` carries the tape.
    ///
    /// # Errors
    /// A missing or unfitting autoencoder or text encoder.
    pub fn new(experiment: &UNetExperiment, device: &Device, evaluator: DiffusionEvaluator) -> anyhow::Result<Self> {
        let frozen = Frozen::open(experiment, device)?;
        let denoiser = first_weights(experiment, &frozen.captioner, device)?;
        experiment.optimizer.check(&denoiser)?;
        Ok(Self {
            ema: Ema::of_part(experiment.ema, &denoiser, learning(experiment)),
            optimizer: Optimizer::new(&experiment.optimizer),
            experiment: experiment.clone(),
            device: device.clone(),
            denoiser,
            frozen,
            evaluator,
        })
    }

    /// The weights that learn, averaged, without a tape.
    fn averaged(&self) -> Denoiser {
        self.ema.apply(self.denoiser.clone().valid())
    }

    /// Held-out errors of the averaged weights on `frames` frames of each dataset (0 for all).
    ///
    /// # Errors
    /// Whatever a frame's pictures report.
    pub fn scores(&self, frames: usize) -> anyhow::Result<DiffusionScores> {
        self.evaluator.scores(&self.frozen, &self.averaged(), frames)
    }

    /// Samples of the averaged weights; returns their captions.
    ///
    /// # Errors
    /// Whatever a frame's pictures report, or the file.
    pub fn paint(&self, path: &Path) -> anyhow::Result<Vec<String>> {
        self.evaluator.pictures(&self.frozen, &self.averaged(), &self.experiment.sampling, path)
    }

    /// Writes the averaged weights in diffusers' layout into a folder of the run, which it returns: `pipeline`, or for adapters `lora`,
    /// whose file diffusers adds to the pipeline it was trained on.
    ///
    /// # Errors
    /// Names the file that cannot be written.
    pub fn export(&self, run: &Path) -> anyhow::Result<PathBuf> {
        let averaged = self.averaged();
        if self.experiment.adapter.is_none() {
            let root = run.join("pipeline");
            save_pipeline(&root, &averaged, &self.frozen.coder, &self.experiment.diffusion)?;
            return Ok(root);
        }
        let root = run.join("lora");
        std::fs::create_dir_all(&root).with_context(|| format!("cannot make the folder {}", root.display()))?;
        let path = root.join("pytorch_lora_weights.safetensors");
        lora::save(&averaged.unet, ADAPTER, &path, ("unet", LoraLayout::Peft), &BTreeMap::new())?;
        Ok(root)
    }
}

impl Task for UNetTask {
    type Batch = SceneBatch;

    fn train_step(&mut self, batches: Vec<SceneBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        // Sequential forks, because parameter ids and tensors are shared with the module they come from.
        let fork = |batch| (batch, self.denoiser.clone().fork(&self.device));
        let micros: Vec<(SceneBatch, Denoiser)> = batches.into_iter().map(fork).collect();
        let frozen = &self.frozen;
        let parts = in_lanes(&micros, self.experiment.device.lanes(), |number, (batch, denoiser)| {
            frozen.step(denoiser, (batch, number as u64), ctx)
        });
        let (mut output, mut mean) = (StepOutput::new(0), GradientMean::default());
        for part in parts {
            let (gradients, part) = part.map_err(TrainError::task)?;
            output.append(part);
            mean.add(&self.denoiser, gradients);
        }
        let gradients = mean.take(&self.denoiser);
        let (denoiser, update) = self.optimizer.update(self.denoiser.clone(), gradients, ctx)?;
        self.denoiser = denoiser;
        if !update.skipped {
            self.ema.update(&self.denoiser);
        }
        output.push("gradient_norm", update.gradient_norm);
        output.push("learning_rate", update.learning_rate);
        Ok(output)
    }

    fn validate(&mut self, _ctx: &StepContext) -> Result<Scalars, TrainError> {
        let scores = self.scores(self.experiment.evaluation.frames).map_err(TrainError::task)?;
        Ok(vec![
            ("held_out_loss".to_owned(), scores.loss),
            ("held_out_loss_other_caption".to_owned(), scores.loss_other_caption),
        ])
    }

    fn preview(&mut self, folder: &Path, _ctx: &StepContext) -> Result<(), TrainError> {
        self.paint(&folder.join("samples.png")).map(drop).map_err(TrainError::task)
    }

    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module_part("model", &self.denoiser, learning(&self.experiment))?;
        self.ema.save(writer, "ema")?;
        self.optimizer.save(writer, "optimizer")
    }

    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.denoiser = reader.module_part("model", self.denoiser.clone(), learning(&self.experiment))?;
        self.ema.load(reader, "ema", &self.denoiser)?;
        self.optimizer.load(reader, "optimizer", &self.denoiser)
    }
}
