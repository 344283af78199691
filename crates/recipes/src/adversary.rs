//! The discriminator of a reconstruction experiment with its optimizer, and its part in a step.

use burn::optim::GradientsParams;
use burn::tensor::Device;
use data::ImageSize;
use nn::Init;
use train::{CheckpointReader, CheckpointWriter, Optimizer, OptimizerConfig, StepContext, StepOutput, TrainError};
use vae::Discriminator;

use crate::bev_vae::{Adversarial, HingeConfig};

/// What a run keeps of its discriminator.
pub(crate) struct AdversaryState {
    config: HingeConfig,
    discriminator: Discriminator,
    optimizer: Optimizer,
}

/// Share of the adversarial term in one step: factor on λ·L_A and the views it looks at.
pub(crate) struct Adversary<'a> {
    pub discriminator: &'a Discriminator,
    /// 0.1·γ of the paper; 0 while the discriminator learns alone.
    pub weight: f64,
    /// Random views per step; 0 for all.
    pub views: usize,
}

fn begun(share: f64, ctx: &StepContext) -> bool {
    ctx.step as f64 >= share * ctx.total_steps as f64
}

impl AdversaryState {
    /// A fresh discriminator, if the config asks for one; `channels` at full resolution unless the config says otherwise.
    pub fn open(
        config: &Adversarial,
        (size, channels): (ImageSize, usize),
        optimizer: &OptimizerConfig,
        seed: u64,
        device: &Device,
    ) -> anyhow::Result<Option<Self>> {
        let Adversarial::Hinge(config) = config else { return Ok(None) };
        let channels = if config.channels == 0 { channels } else { config.channels };
        // Another stream than the generator's, whose draws depend on its size.
        let mut init = Init::new(seed ^ 0xD15C_0000, device);
        let discriminator = Discriminator::new(size.height as usize, size.width as usize, channels, &mut init)?;
        optimizer.check(&discriminator)?;
        Ok(Some(Self { config: config.clone(), discriminator, optimizer: Optimizer::new(optimizer) }))
    }

    pub fn discriminator(&self) -> &Discriminator {
        &self.discriminator
    }

    /// Whether the discriminator learns in this step.
    pub fn learns(&self, ctx: &StepContext) -> bool {
        begun(self.config.discriminator_start, ctx)
    }

    /// The part in this step of a copy of the discriminator.
    pub fn part<'a>(&self, copy: &'a Discriminator, ctx: &StepContext) -> Adversary<'a> {
        let weight = if begun(self.config.generator_start, ctx) { self.config.weight } else { 0.0 };
        Adversary { discriminator: copy, weight, views: self.config.views }
    }

    pub fn update(
        &mut self,
        gradients: GradientsParams,
        ctx: &StepContext,
        output: &mut StepOutput,
    ) -> Result<(), TrainError> {
        let (network, update) = self.optimizer.update(self.discriminator.clone(), gradients, ctx)?;
        self.discriminator = network;
        output.push("discriminator_gradient_norm", update.gradient_norm);
        Ok(())
    }

    pub fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError> {
        writer.module("discriminator", &self.discriminator)?;
        self.optimizer.save(writer, "optimizer_discriminator")
    }

    pub fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.discriminator = reader.module("discriminator", self.discriminator.clone())?;
        self.optimizer.load(reader, "optimizer_discriminator", &self.discriminator)
    }
}
