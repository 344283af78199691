//! The `Task` of BEV-VAE: what it owns, how a step changes it, and what goes into a checkpoint.

use std::path::Path;
use std::sync::Arc;

use burn::module::Module;
use burn::tensor::Device;
use data::{Loader, LoaderConfig, Mixture, SceneBatch};
use nn::Init;
use train::{
    BatchSource, CheckpointReader, CheckpointWriter, Ema, GradientMean, Optimizer, Scalars, StepContext, StepOutput,
    Task, TrainError, in_lanes,
};
use vae::{BevVae, Discriminator};

use super::step::{Adversary, Step};
use super::{Adversarial, Evaluator, Experiment, HingeConfig, Perceptual};

/// Model, discriminator, their optimizers and the averaged weights.
pub struct BevVaeTask {
    experiment: Experiment,
    device: Device,
    model: BevVae,
    ema: Ema,
    optimizer: Optimizer,
    adversary: Option<AdversaryState>,
    perceptual: Option<Perceptual>,
    evaluator: Evaluator,
}

struct AdversaryState {
    config: HingeConfig,
    discriminator: Discriminator,
    optimizer: Optimizer,
}

/// A micro batch and networks of its own to differentiate.
struct Micro<'a> {
    batch: &'a SceneBatch,
    model: BevVae,
    discriminator: Option<Discriminator>,
}

impl BevVaeTask {
    /// Fresh networks; `device` carries the tape.
    ///
    /// # Errors
    /// Sizes that the discriminator cannot take, an unreadable weights file.
    pub fn new(experiment: &Experiment, device: &Device, evaluator: Evaluator) -> anyhow::Result<Self> {
        let model = BevVae::new(&experiment.model.config, &mut Init::new(experiment.seed, device))
            .starting_from(evaluator.means().colour());
        experiment.optimizer.generator.check(&model)?;
        let adversary = match &experiment.loss.adversarial {
            Adversarial::Off => None,
            Adversarial::Hinge(config) => {
                let image = &experiment.model.config.image;
                let channels = match config.channels {
                    0 => experiment.model.preset.discriminator_channels(),
                    channels => channels,
                };
                // Another stream than the generator's, whose draws depend on its size.
                let mut init = Init::new(experiment.seed ^ 0xD15C_0000, device);
                let discriminator = Discriminator::new(image.height, image.width, channels, &mut init)?;
                experiment.optimizer.discriminator.check(&discriminator)?;
                let optimizer = Optimizer::new(&experiment.optimizer.discriminator);
                Some(AdversaryState { config: config.clone(), discriminator, optimizer })
            }
        };
        Ok(Self {
            ema: Ema::new(experiment.ema, &model),
            optimizer: Optimizer::new(&experiment.optimizer.generator),
            perceptual: Perceptual::open(&experiment.loss.perceptual, device)?,
            experiment: experiment.clone(),
            device: device.clone(),
            model,
            adversary,
            evaluator,
        })
    }

    /// The model with averaged weights, without a tape.
    pub fn averaged(&self) -> BevVae {
        self.ema.apply(self.model.clone().valid())
    }

    /// The same weights as leaves of a graph of their own.
    fn fork<M: Module>(&self, network: &M) -> M {
        network.clone().fork(&self.device)
    }

    /// What is measured.
    pub fn evaluator(&self) -> &Evaluator {
        &self.evaluator
    }
}

impl Task for BevVaeTask {
    type Batch = SceneBatch;

    fn train_step(&mut self, batches: Vec<SceneBatch>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
        let begun = |share: f64| ctx.step as f64 >= share * ctx.total_steps as f64;
        let adversary = self.adversary.as_ref().filter(|state| begun(state.config.discriminator_start));
        // Sequential forks, because parameter ids and tensors are shared with the module they come from.
        let fork = |batch| Micro {
            batch,
            model: self.fork(&self.model),
            discriminator: adversary.map(|state| self.fork(&state.discriminator)),
        };
        let micros: Vec<Micro> = batches.iter().map(fork).collect();
        let parts = in_lanes(&micros, self.experiment.device.lanes(), |number, micro| {
            let adversary = adversary.zip(micro.discriminator.as_ref()).map(|(state, discriminator)| Adversary {
                discriminator,
                weight: if begun(state.config.generator_start) { state.config.weight } else { 0.0 },
                views: state.config.views,
            });
            let step = Step {
                model: &micro.model,
                perceptual: self.perceptual.as_ref(),
                adversary,
                kl_weight: self.experiment.loss.kl_weight,
                device: &self.device,
            };
            step.run(micro.batch, number as u64, ctx)
        });
        let mut output = StepOutput::new(0);
        let (mut generator, mut discriminator) = (GradientMean::default(), GradientMean::default());
        for (gradients, part) in parts {
            output.append(part);
            generator.add(&self.model, gradients.generator);
            if let (Some(state), Some(gradients)) = (adversary, gradients.discriminator) {
                discriminator.add(&state.discriminator, gradients);
            }
        }
        let gradients = generator.take(&self.model);
        let (model, update) = self.optimizer.update(self.model.clone(), gradients, ctx)?;
        self.model = model;
        if !update.skipped {
            self.ema.update(&self.model);
        }
        output.push("gradient_norm", update.gradient_norm);
        output.push("learning_rate", update.learning_rate);
        if let Some(state) = self.adversary.as_mut().filter(|state| begun(state.config.discriminator_start)) {
            let gradients = discriminator.take(&state.discriminator);
            let (network, update) = state.optimizer.update(state.discriminator.clone(), gradients, ctx)?;
            state.discriminator = network;
            output.push("discriminator_gradient_norm", update.gradient_norm);
        }
        Ok(output)
    }

    fn validate(&mut self, _ctx: &StepContext) -> Result<Scalars, TrainError> {
        let frames = self.experiment.evaluation.frames;
        let scores = self.evaluator.reconstruction(&self.averaged(), frames).map_err(TrainError::task)?;
        Ok(vec![("psnr_db".to_owned(), scores.psnr_db)])
    }

    fn preview(&mut self, folder: &Path, _ctx: &StepContext) -> Result<(), TrainError> {
        self.evaluator.pictures(&self.averaged(), folder).map_err(TrainError::task)
    }

    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module("model", &self.model)?;
        self.ema.save(writer, "ema")?;
        self.optimizer.save(writer, "optimizer_generator")?;
        if let Some(state) = &self.adversary {
            writer.module("discriminator", &state.discriminator)?;
            state.optimizer.save(writer, "optimizer_discriminator")?;
        }
        Ok(())
    }

    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.model = reader.module("model", self.model.clone())?;
        self.ema.load(reader, "ema", &self.model)?;
        self.optimizer.load(reader, "optimizer_generator", &self.model)?;
        if let Some(state) = &mut self.adversary {
            state.discriminator = reader.module("discriminator", state.discriminator.clone())?;
            state.optimizer.load(reader, "optimizer_discriminator", &state.discriminator)?;
        }
        Ok(())
    }
}

/// The data loader as the loop's source.
#[derive(Debug)]
pub struct LoaderSource(Loader);

impl LoaderSource {
    /// Opens the training mixture at a position.
    ///
    /// # Errors
    /// Datasets that cannot be opened or mixed.
    pub fn open(mixture: Arc<Mixture>, config: LoaderConfig, position: u64) -> Result<Self, TrainError> {
        Loader::new(mixture, config, position).map(Self).map_err(TrainError::task)
    }
}

impl BatchSource for LoaderSource {
    type Batch = SceneBatch;

    fn next(&mut self) -> Result<SceneBatch, TrainError> {
        self.0.next_batch().map_err(TrainError::task)
    }

    fn position(&self) -> u64 {
        self.0.position()
    }
}
