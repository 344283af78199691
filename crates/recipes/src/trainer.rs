//! A generator with everything a reconstruction run owns beside it: discriminator, optimizers, averaged weights, frozen features.

use burn::module::Module;
use burn::tensor::Device;
use data::{ImageSize, SceneBatch};
use train::{
    CheckpointReader, CheckpointWriter, DeviceConfig, Ema, EmaConfig, GradientMean, Optimizer, StepContext, StepOutput,
    TrainError, in_lanes,
};
use vae::Discriminator;

use crate::adversary::AdversaryState;
use crate::bev_vae::{LossConfig, Optimizers, Perceptual, PixelRange};
use crate::reconstruction::{Losses, StepGradients};

/// How a [`Trainer`] is set up.
pub(crate) struct TrainerConfig<'a> {
    pub seed: u64,
    /// Where to compute, for the number of micro batches side by side.
    pub compute: DeviceConfig,
    pub loss: &'a LossConfig,
    pub optimizer: &'a Optimizers,
    pub ema: EmaConfig,
    /// Pictures that the discriminator sees.
    pub size: ImageSize,
    /// Its channels at full resolution unless the config says otherwise.
    pub discriminator_channels: usize,
    /// What the network's pictures hold.
    pub range: PixelRange,
}

/// What learns in a reconstruction run.
pub(crate) struct Trainer<M> {
    model: M,
    ema: Ema,
    optimizer: Optimizer,
    adversary: Option<AdversaryState>,
    perceptual: Option<Perceptual>,
    kl_weight: f64,
    lanes: usize,
    device: Device,
}

/// A micro batch and networks of its own to differentiate.
struct Micro<'a, M> {
    batch: &'a SceneBatch,
    model: M,
    discriminator: Option<Discriminator>,
}

impl<M: Module + Sync> Trainer<M> {
    /// Trains `model` from where it is; `device` carries the tape.
    ///
    /// # Errors
    /// Pictures that the discriminator cannot take, an unreadable weights file.
    pub fn new(model: M, config: &TrainerConfig, device: &Device) -> anyhow::Result<Self> {
        config.optimizer.generator.check(&model)?;
        let adversary = AdversaryState::open(
            &config.loss.adversarial,
            (config.size, config.discriminator_channels),
            &config.optimizer.discriminator,
            config.seed,
            device,
        )?;
        Ok(Self {
            ema: Ema::new(config.ema, &model),
            optimizer: Optimizer::new(&config.optimizer.generator),
            perceptual: Perceptual::open(&config.loss.perceptual, config.range, device)?,
            kl_weight: config.loss.kl_weight,
            lanes: config.compute.lanes(),
            device: device.clone(),
            model,
            adversary,
        })
    }

    /// The model with averaged weights, without a tape.
    pub fn averaged(&self) -> M {
        self.ema.apply(self.model.clone().valid())
    }

    /// The same weights as leaves of a graph of their own.
    fn fork<N: Module>(&self, network: &N) -> N {
        network.clone().fork(&self.device)
    }

    /// One step of all networks. `run` gives the gradients of the micro batch of this number.
    pub fn step(
        &mut self,
        batches: &[SceneBatch],
        ctx: &StepContext,
        run: impl Fn(&M, &Losses, &SceneBatch, u64) -> (StepGradients, StepOutput) + Sync,
    ) -> Result<StepOutput, TrainError> {
        let adversary = self.adversary.as_ref().filter(|state| state.learns(ctx));
        // Sequential forks, because parameter ids and tensors are shared with the module they come from.
        let fork = |batch| Micro {
            batch,
            model: self.fork(&self.model),
            discriminator: adversary.map(|state| self.fork(state.discriminator())),
        };
        let micros: Vec<Micro<M>> = batches.iter().map(fork).collect();
        let parts = in_lanes(&micros, self.lanes, |number, micro| {
            let losses = Losses {
                perceptual: self.perceptual.as_ref(),
                adversary: adversary.zip(micro.discriminator.as_ref()).map(|(state, copy)| state.part(copy, ctx)),
                kl_weight: self.kl_weight,
            };
            run(&micro.model, &losses, micro.batch, number as u64)
        });
        let mut output = StepOutput::new(0);
        let (mut generator, mut discriminator) = (GradientMean::default(), GradientMean::default());
        let mut scores = Vec::new();
        for (gradients, part) in parts {
            output.append(part);
            generator.add(&self.model, gradients.generator);
            scores.extend(gradients.scores);
            if let (Some(state), Some(gradients)) = (adversary, gradients.discriminator) {
                discriminator.add(state.discriminator(), gradients);
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
        if let Some(state) = self.adversary.as_mut().filter(|state| state.learns(ctx)) {
            let gradients = discriminator.take(state.discriminator());
            state.remember(&scores);
            state.update(gradients, ctx, &mut output)?;
        }
        Ok(output)
    }

    /// Stores everything the next steps depend on.
    pub fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module("model", &self.model)?;
        self.ema.save(writer, "ema")?;
        self.optimizer.save(writer, "optimizer_generator")?;
        self.adversary.as_ref().map_or(Ok(()), |state| state.save(writer))
    }

    /// Takes back what [`Trainer::save`] stored.
    pub fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.model = reader.module("model", self.model.clone())?;
        self.ema.load(reader, "ema", &self.model)?;
        self.optimizer.load(reader, "optimizer_generator", &self.model)?;
        self.adversary.as_mut().map_or(Ok(()), |state| state.load(reader))
    }
}
