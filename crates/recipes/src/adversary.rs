//! The discriminator of a reconstruction experiment with its optimizer, and its part in a step.

use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use data::ImageSize;
use nn::Init;
use train::{CheckpointReader, CheckpointWriter, Optimizer, OptimizerConfig, StepContext, StepOutput, TrainError};
use vae::Discriminator;

use crate::bev_vae::{Adversarial, HingeConfig, LecamConfig, Regulariser, SlopeConfig};

/// Key of the running means in a checkpoint.
const SCORE_MEANS: &str = "discriminator.score_means";

/// What a run keeps of its discriminator.
pub(crate) struct AdversaryState {
    config: HingeConfig,
    discriminator: Discriminator,
    optimizer: Optimizer,
    /// Running means of the scores of real and painted pictures, for LeCam; none before its first step.
    means: Option<[f64; 2]>,
}

/// What is added to the discriminator's loss in one step.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Smoothing {
    Nothing,
    /// `factor` times the mean squared slope.
    Slope {
        factor: f64,
        epsilon: f64,
    },
    Lecam {
        weight: f64,
        means: [f64; 2],
    },
}

/// Share of the adversarial term in one step: factor on λ·L_A and the views it looks at.
pub(crate) struct Adversary<'a> {
    pub discriminator: &'a Discriminator,
    /// 0.1·γ of the paper; 0 while the discriminator learns alone.
    pub weight: f64,
    /// Random views per step; 0 for all.
    pub views: usize,
    pub smoothing: Smoothing,
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
        let config = config.checked()?;
        let channels = if config.channels == 0 { channels } else { config.channels };
        // Another stream than the generator's, whose draws depend on its size.
        let mut init = Init::new(seed ^ 0xD15C_0000, device);
        let discriminator = Discriminator::new(size.height as usize, size.width as usize, channels, &mut init)?;
        optimizer.check(&discriminator)?;
        Ok(Some(Self { config: config.clone(), discriminator, optimizer: Optimizer::new(optimizer), means: None }))
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
        Adversary { discriminator: copy, weight, views: self.config.views, smoothing: self.smoothing(ctx) }
    }

    fn smoothing(&self, ctx: &StepContext) -> Smoothing {
        match (self.config.regulariser, self.means) {
            (Regulariser::R1FiniteDifference(SlopeConfig { gamma, epsilon, every }), _)
                if ctx.step.is_multiple_of(every) =>
            {
                Smoothing::Slope { factor: 0.5 * gamma * every as f64, epsilon }
            }
            (Regulariser::Lecam(LecamConfig { weight, .. }), Some(means)) => Smoothing::Lecam { weight, means },
            _ => Smoothing::Nothing,
        }
    }

    /// Takes the scores of a step's micro batches into the running means: those of real and of painted pictures.
    pub fn remember(&mut self, scores: &[[Tensor<1>; 2]]) {
        let Regulariser::Lecam(LecamConfig { decay, .. }) = self.config.regulariser else { return };
        if scores.is_empty() {
            return;
        }
        let mean = |side: usize| {
            let of = |scores: &[Tensor<1>; 2]| f64::from(scores[side].clone().into_scalar::<f32>());
            scores.iter().map(of).sum::<f64>() / scores.len() as f64
        };
        let now = [mean(0), mean(1)];
        let old = self.means.unwrap_or(now);
        self.means = Some([0, 1].map(|side| decay * old[side] + (1.0 - decay) * now[side]));
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
        if let Regulariser::Lecam(_) = self.config.regulariser {
            writer.value(SCORE_MEANS, &self.means)?;
        }
        writer.module("discriminator", &self.discriminator)?;
        self.optimizer.save(writer, "optimizer_discriminator")
    }

    pub fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError> {
        self.discriminator = reader.module("discriminator", self.discriminator.clone())?;
        if let Regulariser::Lecam(_) = self.config.regulariser {
            self.means = reader.value(SCORE_MEANS)?;
        }
        self.optimizer.load(reader, "optimizer_discriminator", &self.discriminator)
    }
}
