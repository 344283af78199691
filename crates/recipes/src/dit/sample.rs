//! From layouts to latents.

use std::ops::ControlFlow;

use anyhow::ensure;
use burn::tensor::{Device, Tensor, TensorData};
use data::latents::{LatentScale, LatentStatistics};
use data::layout::Layout;
use diffusion::{Oracle, SamplerConfig, guide};
use dit::{Condition, Dit};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use super::Conditioner;
use super::noising::Noising;

/// How a layout steers a sample (section 5 of the specification).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Guidance {
    /// `ε(∅) + s·(ε(layout) − ε(∅))` on all channels: 0 ignores the layout, 1 is plain conditioning. Two evaluations per step, one for 0
    /// and 1.
    TwoPass(f64),
    /// One evaluation with s times the layout's vectors: the paper's other sentence, far from training for large s.
    ScaledCondition(f64),
}

impl Guidance {
    /// s.
    pub const fn scale(self) -> f64 {
        match self {
            Self::TwoPass(scale) | Self::ScaledCondition(scale) => scale,
        }
    }

    /// The same way with another s.
    #[must_use]
    pub const fn with_scale(self, scale: f64) -> Self {
        match self {
            Self::TwoPass(_) => Self::TwoPass(scale),
            Self::ScaledCondition(_) => Self::ScaledCondition(scale),
        }
    }
}

/// What a sample's noise follows from: equal keys give equal noise on every machine, in every batch.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct NoiseKey {
    /// Seed.
    pub seed: u64,
    /// The frame it is made for.
    pub token: String,
    /// Number of the sample of this frame.
    pub draw: u64,
}

impl NoiseKey {
    /// Standard normal numbers; `call` counts the requests of one sample.
    pub(crate) fn noise(&self, count: usize, call: u64) -> Vec<f32> {
        let mut rng = train::stream(self.seed, &format!("sampling/{}/{call}", self.token), self.draw);
        (0..count).map(|_| StandardNormal.sample(&mut rng)).collect()
    }
}

/// Offset and factor of each channel as tensors `[1, C, 1, 1]`: `x0 = (z − offset)·factor`.
#[derive(Debug, Clone)]
pub(crate) struct Scaling {
    offset: Tensor<4>,
    factor: Tensor<4>,
}

impl Scaling {
    pub fn new(statistics: &LatentStatistics, scale: LatentScale, device: &Device) -> Self {
        let scaling = statistics.scaling(scale);
        let column = |of: &dyn Fn(&(f64, f64)) -> f64| {
            let values: Vec<f32> = scaling.iter().map(|pair| of(pair) as f32).collect();
            Tensor::from_data(TensorData::new(values, [1, scaling.len(), 1, 1]), device)
        };
        Self { offset: column(&|pair| pair.0), factor: column(&|pair| pair.1) }
    }

    pub fn scaled(&self, latent: Tensor<4>) -> Tensor<4> {
        (latent - self.offset.clone()) * self.factor.clone()
    }

    pub fn unscaled(&self, x0: Tensor<4>) -> Tensor<4> {
        x0 / self.factor.clone() + self.offset.clone()
    }
}

/// One set of weights, without a tape, and what belongs to it.
pub(crate) struct LatentSampler<'a> {
    pub network: &'a Dit,
    pub noising: &'a Noising,
    pub conditioner: &'a Conditioner,
    pub scaling: &'a Scaling,
    pub device: &'a Device,
}

impl LatentSampler<'_> {
    /// # Shapes
    /// - layouts, keys: B
    /// - output: `[B, C, h, w]`, as the decoder takes them
    ///
    /// # Errors
    /// A layout that cannot be rasterised; as many keys as layouts are needed.
    pub fn sample(
        &self,
        layouts: &[&Layout],
        keys: &[NoiseKey],
        sampler: &SamplerConfig,
        guidance: Guidance,
    ) -> anyhow::Result<Tensor<4>> {
        ensure!(layouts.len() == keys.len(), "{} layouts and {} noise keys", layouts.len(), keys.len());
        ensure!(!layouts.is_empty(), "there is no layout to sample");
        let occupancy = self.conditioner.occupancy(layouts, self.device)?;
        let config = self.network.config();
        let [h, w] = config.latent_size;
        let shape = [layouts.len(), config.latent_channels, h, w];
        let mut calls = 0;
        let mut noise = || {
            let values =
                keys.iter().flat_map(|key| key.noise(config.latent_channels * h * w, calls)).collect::<Vec<f32>>();
            calls += 1;
            Tensor::from_data(TensorData::new(values, shape), self.device)
        };
        let start = noise();
        let mut denoise = |x: Tensor<4>, timestep: f64| self.guided(x, timestep, &occupancy, guidance);
        let mut oracle = Oracle { denoise: &mut denoise, noise: &mut noise, watch: &mut |_| ControlFlow::Continue(()) };
        let x0 = sampler.sample(self.noising.schedule(), self.noising.target(), start, &mut oracle)?;
        Ok(self.scaling.unscaled(x0))
    }

    /// The network's output with guidance.
    pub fn guided(&self, x: Tensor<4>, timestep: f64, occupancy: &Tensor<5>, guidance: Guidance) -> Tensor<4> {
        let items = x.dims()[0];
        let run = |x: Tensor<4>, occupancy: Tensor<5>, strength: Vec<f64>| {
            let timesteps = vec![timestep; strength.len()];
            self.network.forward(x, &timesteps, &Condition::Layout { occupancy, strength: &strength })
        };
        let alone = |strength: f64| run(x.clone(), occupancy.clone(), vec![strength; items]);
        match guidance {
            Guidance::ScaledCondition(scale) => alone(scale),
            // The formula's own values, at half the cost.
            Guidance::TwoPass(scale) if scale == 0.0 || scale == 1.0 => alone(scale),
            Guidance::TwoPass(scale) => {
                let strength = [vec![0.0; items], vec![1.0; items]].concat();
                let both = run(x.clone().repeat_dim(0, 2), occupancy.clone().repeat_dim(0, 2), strength);
                guide(both.clone().narrow(0, 0, items), both.narrow(0, items, items), scale)
            }
        }
    }
}
