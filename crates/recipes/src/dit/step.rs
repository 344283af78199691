//! One training step: Ho et al., "Denoising Diffusion Probabilistic Models", algorithm 1, on latents, with layouts left out at random
//! (Ho & Salimans, "Classifier-Free Diffusion Guidance", algorithm 1).
//!
//! Every random number of a sample follows from the seed, its frame and its draw, so that neighbours in the batch do not matter.

use anyhow::{Context, ensure};
use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use data::latents::{Latent, LatentStatistics, Posterior};
use dit::{Condition, Dit};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use train::{StepContext, StepOutput};

use super::noising::{Instant, Noising};
use super::sample::Scaling;
use super::{Conditioner, DitExperiment, LatentBatch, LatentItem};
use crate::latents::FrozenVae;

/// Parts of the noise process whose losses are logged.
pub(crate) const PARTS: usize = 10;

/// What a step needs beside the weights that learn.
pub(crate) struct Frozen {
    pub vae: FrozenVae,
    pub statistics: LatentStatistics,
    pub scaling: Scaling,
    pub posterior: Posterior,
    pub conditioner: Conditioner,
    pub noising: Noising,
    pub dropout: f64,
    pub device: Device,
}

/// A batch as the network meets it, without a tape.
#[derive(Debug, Clone)]
pub(crate) struct Problem {
    /// `[B, C, h, w]`
    pub noisy: Tensor<4>,
    /// What the network should say, `[B, C, h, w]`.
    pub wanted: Tensor<4>,
    /// `[B, K, Z, Y, X]`
    pub occupancy: Tensor<5>,
    /// B instants.
    pub instants: Vec<Instant>,
    /// B, 1 with the layout and 0 without.
    pub strength: Vec<f64>,
}

/// Losses by part of the noise process, `[PARTS, 1]` each, on the device.
#[derive(Debug, Clone)]
pub(crate) struct PartLosses {
    pub sums: Tensor<2>,
    pub counts: [u64; PARTS],
}

impl Frozen {
    /// `device` may carry a tape; nothing here does.
    pub fn new(
        experiment: &DitExperiment,
        vae: FrozenVae,
        statistics: LatentStatistics,
        device: &Device,
    ) -> anyhow::Result<Self> {
        statistics.check_origin(vae.hash(), vae.grid()).map_err(anyhow::Error::msg)?;
        let channels = vae.latent_shape()[0];
        ensure!(
            statistics.mean.len() == channels,
            "the statistics are of {} channels, the autoencoder's latents have {channels}",
            statistics.mean.len()
        );
        let device = device.clone().without_autodiff();
        let condition = &experiment.condition;
        Ok(Self {
            conditioner: Conditioner {
                classes: condition.classes.classes(),
                grid: *vae.grid(),
                rule: condition.rasterise,
            },
            scaling: Scaling::new(&statistics, experiment.latents.scale, &device),
            posterior: experiment.latents.posterior,
            noising: Noising::new(&experiment.diffusion)?,
            dropout: condition.dropout,
            vae,
            statistics,
            device,
        })
    }

    /// Scaled clean latents of a batch, `[B, C, h, w]`.
    pub fn clean(&self, batch: &LatentBatch, seed: u64) -> anyhow::Result<Tensor<4>> {
        let made;
        let latents: Vec<&Latent> = match &batch.pictures {
            Some(pictures) => {
                made = self.vae.encode(pictures).latents();
                made.iter().collect()
            }
            None => batch.items.iter().filter_map(|item| item.latent.as_ref()).collect(),
        };
        ensure!(latents.len() == batch.items.len(), "{} latents of {} samples", latents.len(), batch.items.len());
        let drawn = |(item, latent): (&LatentItem, &&Latent)| match &latent.log_var {
            Some(log_var) if self.posterior == Posterior::Sample => {
                let mut rng = stream(seed, "posterior", item);
                let draw = |(mean, log_var): (&f32, &f32)| -> f32 {
                    let noise: f32 = StandardNormal.sample(&mut rng);
                    mean + (0.5 * log_var).exp() * noise
                };
                latent.mean.iter().zip(log_var).map(draw).collect()
            }
            _ => latent.mean.clone(),
        };
        let values: Vec<f32> = batch.items.iter().zip(&latents).flat_map(drawn).collect();
        let [c, h, w] = self.vae.latent_shape();
        ensure!(
            values.len() == latents.len() * c * h * w,
            "the latents are not of the autoencoder's shape [{c}, {h}, {w}]"
        );
        let latents = Tensor::from_data(TensorData::new(values, [latents.len(), c, h, w]), &self.device);
        Ok(self.scaling.scaled(latents))
    }

    /// Noises a batch at these instants, one per sample, with all layouts.
    pub fn problem(&self, batch: &LatentBatch, seed: u64, instants: Vec<Instant>) -> anyhow::Result<Problem> {
        let clean = self.clean(batch, seed)?;
        let shape = clean.dims();
        let count = shape[1] * shape[2] * shape[3];
        let noise: Vec<f32> = batch
            .items
            .iter()
            .flat_map(|item| {
                let mut rng = stream(seed, "noise", item);
                (0..count).map(move |_| StandardNormal.sample(&mut rng)).collect::<Vec<f32>>()
            })
            .collect();
        let noise = Tensor::from_data(TensorData::new(noise, shape), &self.device);
        let (alpha, sigma) = (self.column(&instants, |i| i.alpha), self.column(&instants, |i| i.sigma));
        let layouts: Vec<_> = batch.items.iter().map(|item| &item.layout).collect();
        let occupancy = self.conditioner.occupancy(&layouts, &self.device).with_context(|| {
            format!("among the frames {}", batch.items.iter().map(LatentItem::token).collect::<Vec<_>>().join(", "))
        })?;
        Ok(Problem {
            noisy: clean.clone() * alpha.clone() + noise.clone() * sigma.clone(),
            wanted: self.noising.wanted(clean, noise, alpha, sigma),
            occupancy,
            strength: vec![1.0; instants.len()],
            instants,
        })
    }

    /// `[B, 1, 1, 1]` of a number of each instant.
    fn column(&self, instants: &[Instant], of: impl Fn(&Instant) -> f64) -> Tensor<4> {
        let values: Vec<f32> = instants.iter().map(|instant| of(instant) as f32).collect();
        Tensor::from_data(TensorData::new(values, [instants.len(), 1, 1, 1]), &self.device)
    }

    /// The network's answer, `[B, C, h, w]`, on the tape where its weights are.
    pub fn answer(&self, network: &Dit, problem: &Problem) -> Tensor<4> {
        let on_tape = network.patch.weight.val().is_autodiff();
        let (noisy, occupancy) = (problem.noisy.clone(), problem.occupancy.clone());
        let (noisy, occupancy) =
            if on_tape { (Tensor::from_inner(noisy), Tensor::from_inner(occupancy)) } else { (noisy, occupancy) };
        let timesteps: Vec<f64> = problem.instants.iter().map(|instant| instant.timestep).collect();
        network.forward(noisy, &timesteps, &Condition::Layout { occupancy, strength: &problem.strength })
    }

    /// Squared errors of an answer without a tape, their mean over each sample, `[B, 1]`.
    pub fn errors(&self, answer: Tensor<4>, problem: &Problem) -> Tensor<2> {
        let [b, c, h, w] = answer.dims();
        let squares = (answer - problem.wanted.clone()).square().reshape([b, c * h * w]);
        squares.matmul(Tensor::full([c * h * w, 1], 1.0 / (c * h * w) as f64, &self.device))
    }

    /// Forward and backward of one micro batch; the caller applies the gradients.
    pub fn step(
        &self,
        network: &Dit,
        batch: &LatentBatch,
        ctx: &StepContext,
    ) -> anyhow::Result<(GradientsParams, StepOutput, PartLosses)> {
        let instants = batch.items.iter().map(|item| self.noising.draw(&mut stream(ctx.seed, "time", item))).collect();
        let mut problem = self.problem(batch, ctx.seed, instants)?;
        let kept = |item: &LatentItem| !stream(ctx.seed, "dropout", item).random_bool(self.dropout);
        problem.strength = batch.items.iter().map(|item| if kept(item) { 1.0 } else { 0.0 }).collect();
        let answer = self.answer(network, &problem);
        let parts = self.part_losses(answer.clone().inner(), &problem);
        let weight = Tensor::from_inner(self.column(&problem.instants, |instant| instant.weight));
        let numbers = answer.dims().iter().product::<usize>();
        let squares = (answer - Tensor::from_inner(problem.wanted.clone())).square() * weight;
        let loss = squares.sum() / numbers as f64;
        let mut output = StepOutput::new(batch.items.len());
        output.push("loss", loss.clone());
        if ctx.log {
            let share = network.clone().valid().layout_share(problem.noisy.clone(), problem.occupancy.clone());
            share.into_iter().for_each(|share| output.push("layout_share", share));
        }
        Ok((GradientsParams::from_grads(loss.backward(), network), output, parts))
    }

    /// Unweighted losses, summed by part of the noise process.
    fn part_losses(&self, answer: Tensor<4>, problem: &Problem) -> PartLosses {
        let part = |instant: &Instant| ((instant.share * PARTS as f64) as usize).min(PARTS - 1);
        let places: Vec<usize> = problem.instants.iter().map(part).collect();
        let mut counts = [0; PARTS];
        places.iter().for_each(|place| counts[*place] += 1);
        let chosen: Vec<f32> =
            (0..PARTS).flat_map(|row| places.iter().map(move |place| f32::from(u8::from(*place == row)))).collect();
        let chosen = Tensor::<2>::from_data(TensorData::new(chosen, [PARTS, places.len()]), &self.device);
        PartLosses { sums: chosen.matmul(self.errors(answer, problem)), counts }
    }
}

/// Random numbers of one sample for one purpose.
fn stream(seed: u64, purpose: &str, item: &LatentItem) -> ChaCha8Rng {
    train::stream(seed, &format!("{purpose}/{}", item.token()), item.draw)
}
