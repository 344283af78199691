//! The `Task` of the second stage.

use std::path::Path;

use anyhow::Context;
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use data::latents::LatentStatistics;
use dit::{ConditionConfig, Dit, DitConfig, OutputConfig};
use nn::Init;
use train::{
    CheckpointReader, CheckpointWriter, Ema, GradientMean, Optimizer, Scalars, StepContext, StepOutput, Task,
    TrainError, in_lanes,
};

use super::loaded::Carried;
use super::sample::LatentSampler;
use super::step::{Frozen, PARTS, PartLosses};
use super::{DitEvaluator, DitExperiment, DitScores, EditScores, GeneratedScores, LatentBatch};
use crate::latents::FrozenVae;

/// Names of the logged losses by part of the noise process, from clean to noise.
const PART_NAMES: [&str; PARTS] =
    ["loss_t0", "loss_t1", "loss_t2", "loss_t3", "loss_t4", "loss_t5", "loss_t6", "loss_t7", "loss_t8", "loss_t9"];

/// The transformer, its optimizer and averaged weights, and what is frozen around it.
pub struct DitTask {
    experiment: DitExperiment,
    device: Device,
    network: Dit,
    ema: Ema,
    optimizer: Optimizer,
    frozen: Frozen,
    carried: Carried,
    evaluator: DitEvaluator,
    /// Losses since the last logged step; only for logs, so not in checkpoints.
    parts: Option<PartLosses>,
}

/// What the end of a run measures.
#[derive(Debug, Clone, Copy)]
pub struct DitMeasured {
    /// Errors of answers.
    pub held_out: DitScores,
    /// Sampled layouts.
    pub generated: Option<GeneratedScores>,
    /// Removed boxes.
    pub edits: Option<EditScores>,
}

impl DitExperiment {
    /// The network's sizes over the latents and the grid of an autoencoder.
    ///
    /// # Errors
    /// Sizes that do not divide each other, naming them.
    pub fn network(&self, vae: &FrozenVae) -> anyhow::Result<DitConfig> {
        let sizes = self.model.config;
        let [channels, rows, columns] = vae.latent_shape();
        let [slices, y, x] = vae.grid().cells;
        let tokens = [rows / sizes.patch, columns / sizes.patch];
        let patch = y / tokens[0].max(1);
        anyhow::ensure!(
            tokens[0] * patch == y && tokens[1] * patch == x,
            "model: {rows}x{columns} latents in patches of {} do not divide the grid of {y}x{x} cells",
            sizes.patch
        );
        let config = DitConfig {
            latent_channels: channels,
            latent_size: [rows, columns],
            patch: sizes.patch,
            width: sizes.width,
            depth: sizes.depth,
            heads: sizes.heads,
            output: OutputConfig::Target,
            condition: ConditionConfig::Layout { classes: self.condition.classes.classes().len(), slices, patch },
        };
        config.checked().context("model")
    }
}

impl DitTask {
    /// Fresh networks; `device` carries the tape.
    ///
    /// # Errors
    /// Latents of another autoencoder, sizes that do not fit.
    pub fn new(
        experiment: &DitExperiment,
        device: &Device,
        vae: FrozenVae,
        statistics: LatentStatistics,
        evaluator: DitEvaluator,
    ) -> anyhow::Result<Self> {
        let config = experiment.network(&vae)?;
        let frozen = Frozen::new(experiment, vae, statistics, device)?;
        let network = Dit::new(&config, &mut Init::new(experiment.seed, device));
        experiment.optimizer.check(&network)?;
        Ok(Self {
            ema: Ema::new(experiment.ema, &network),
            optimizer: Optimizer::new(&experiment.optimizer),
            carried: Carried {
                statistics: frozen.statistics.clone(),
                classes: frozen.conditioner.classes.clone(),
                network: config,
            },
            experiment: experiment.clone(),
            device: device.clone(),
            network,
            frozen,
            evaluator,
            parts: None,
        })
    }

    /// The averaged weights with what sampling needs, without a tape.
    fn with_sampler<T>(&self, run: impl FnOnce(&LatentSampler, &Frozen) -> T) -> T {
        let network = self.ema.apply(self.network.clone().valid());
        let frozen = &self.frozen;
        let sampler = LatentSampler {
            network: &network,
            noising: &frozen.noising,
            conditioner: &frozen.conditioner,
            scaling: &frozen.scaling,
            device: &frozen.device,
        };
        run(&sampler, frozen)
    }

    /// All measurements of the averaged weights at the end of a run.
    ///
    /// # Errors
    /// Whatever a held-out sample reports.
    pub fn measure(&self) -> anyhow::Result<DitMeasured> {
        let (experiment, evaluator) = (&self.experiment, &self.evaluator);
        let counts = &experiment.evaluation;
        self.with_sampler(|sampler, frozen| {
            let wanted = |count: usize| (count > 0).then_some(());
            Ok(DitMeasured {
                held_out: evaluator.scores(frozen, sampler.network, counts.final_samples)?,
                generated: wanted(counts.generated)
                    .map(|()| evaluator.generated(frozen, sampler, experiment))
                    .transpose()?,
                edits: match wanted(counts.edits) {
                    Some(()) => evaluator.edits(frozen, sampler, experiment)?,
                    None => None,
                },
            })
        })
    }

    /// Draws pages of held-out layouts into a folder.
    ///
    /// # Errors
    /// Whatever a held-out sample reports, or a file.
    pub fn draw(&self, folder: &Path) -> anyhow::Result<()> {
        self.with_sampler(|sampler, frozen| self.evaluator.pages(frozen, sampler, &self.experiment, folder))
    }

    /// SHA-256 of the autoencoder's averaged weights file.
    pub fn vae_hash(&self) -> &str {
        self.frozen.vae.hash()
    }

    /// Number of parameters that learn.
    pub fn parameters(&self) -> usize {
        train::count_parameters(&self.network)
    }

    fn collect_parts(&mut self, new: Vec<PartLosses>, log: bool, output: &mut StepOutput) {
        for part in new {
            self.parts = Some(match self.parts.take() {
                None => part,
                Some(mut old) => {
                    old.counts.iter_mut().zip(part.counts).for_each(|(a, b)| *a += b);
                    PartLosses { sums: old.sums + part.sums, counts: old.counts }
                }
            });
        }
        let Some(all) = self.parts.take_if(|_| log) else { return };
        for (at, (name, count)) in PART_NAMES.into_iter().zip(all.counts).enumerate().filter(|(_, part)| part.1 > 0) {
            let sum: Tensor<1> = all.sums.clone().narrow(0, at, 1).reshape([1]);
            output.push(name, sum / count as f64);
        }
    }
}

impl Task for DitTask {
    type Batch = LatentBatch;

    fn train_step(&mut self, batches: Vec<LatentBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        // Sequential forks, because parameter ids and tensors are shared with the module they come from.
        let fork = |batch| (batch, self.network.clone().fork(&self.device));
        let micros: Vec<(LatentBatch, Dit)> = batches.into_iter().map(fork).collect();
        let frozen = &self.frozen;
        let results =
            in_lanes(&micros, self.experiment.device.lanes(), |_, (batch, network)| frozen.step(network, batch, ctx));
        let (mut output, mut mean, mut parts) = (StepOutput::new(0), GradientMean::default(), Vec::new());
        for result in results {
            let (gradients, part, losses) = result.map_err(TrainError::task)?;
            output.append(part);
            mean.add(&self.network, gradients);
            parts.push(losses);
        }
        let gradients = mean.take(&self.network);
        let (network, update) = self.optimizer.update(self.network.clone(), gradients, ctx)?;
        self.network = network;
        if !update.skipped {
            self.ema.update(&self.network);
        }
        output.push("gradient_norm", update.gradient_norm);
        output.push("learning_rate", update.learning_rate);
        self.collect_parts(parts, ctx.log, &mut output);
        Ok(output)
    }

    fn validate(&mut self, _ctx: &StepContext) -> Result<Scalars, TrainError> {
        let samples = self.experiment.evaluation.samples;
        let scores = self.with_sampler(|sampler, frozen| self.evaluator.scores(frozen, sampler.network, samples));
        let scores = scores.map_err(TrainError::task)?;
        Ok(vec![
            ("held_out_loss".to_owned(), scores.loss),
            ("held_out_loss_no_layout".to_owned(), scores.loss_no_layout),
            ("held_out_loss_other_layout".to_owned(), scores.loss_other_layout),
        ])
    }

    fn preview(&mut self, folder: &Path, _ctx: &StepContext) -> Result<(), TrainError> {
        self.draw(folder).map_err(TrainError::task)
    }

    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module("model", &self.network)?;
        self.ema.save(writer, "ema")?;
        self.optimizer.save(writer, "optimizer")?;
        self.carried.write(writer)
    }

    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        let stored = Carried::read(reader).map_err(TrainError::task)?;
        self.carried.check_same(&stored).map_err(TrainError::task)?;
        self.network = reader.module("model", self.network.clone())?;
        self.ema.load(reader, "ema", &self.network)?;
        self.optimizer.load(reader, "optimizer", &self.network)
    }
}
