//! DDPM: ancestral sampling, also on a part of the timesteps.

use std::ops::Range;

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, Oracle, index};
use crate::{Level, NoiseSchedule, Spacing, Target};

/// Smallest posterior variance; its logarithm must exist.
const LEAST_VARIANCE: f64 = 1e-20;

/// Variance of a step back, β̃ = β·(1 − ᾱ')/(1 − ᾱ) with ᾱ' of the next timestep.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Variance {
    /// β̃.
    #[default]
    FixedSmall,
    /// β.
    FixedLarge,
    /// Between both, exponent given by a second half of the network's channels in [-1, 1] (Nichol & Dhariwal, eq. 15).
    LearnedRange,
}

/// Ancestral sampler. Fewer steps than timesteps: β is recomputed from the ᾱ that are visited.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ddpm {
    /// Network evaluations.
    pub steps: usize,
    /// Timesteps visited.
    #[serde(default = "leading")]
    pub spacing: Spacing,
    /// Variance of the noise put back.
    #[serde(default)]
    pub variance: Variance,
    /// Clamp the predicted clean sample to ±1; for pictures, not for latents.
    #[serde(default)]
    pub clip: bool,
}

const fn leading() -> Spacing {
    Spacing::Leading { offset: 0 }
}

impl Ddpm {
    /// Descending timesteps.
    pub fn timesteps(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        self.spacing.visits(self.steps, schedule.len())
    }

    /// From noise to sample. No noise is put back in the last step.
    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        self.sample_part(schedule, target, start, 0..self.steps, oracle)
    }

    /// Only some of the steps, from a sample at the level of the first of them: picture-to-picture editing, or work on pieces of a chain.
    ///
    /// # Errors
    /// [`Cancelled`] when the watcher broke off.
    pub fn sample_part<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        part: Range<usize>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let timesteps = self.timesteps(schedule);
        let mut x = start;
        let part = part.start..part.end.min(timesteps.len());
        for step in part.clone() {
            let timestep = timesteps[step];
            let next = timesteps.get(step + 1).map_or(Level::CLEAN, |t| schedule.level(index(*t)));
            let level = schedule.level(index(timestep));
            let (output, fraction) = self.split((oracle.denoise)(x.clone(), timestep));
            let mut clean = target.clean(output, x.clone(), level);
            if self.clip {
                clean = clean.clamp(-1.0, 1.0);
            }
            let posterior = Posterior::new(level, next);
            let mean = clean * posterior.clean + x * posterior.noisy;
            let last = step + 1 == timesteps.len();
            x = if last { mean } else { mean + posterior.scaled((oracle.noise)(), self.variance, fraction) };
            oracle.report(step + 1 - part.start, part.len(), &x)?;
        }
        Ok(x)
    }

    /// Separates the variance half of the channels, axis 1, and brings it to [0, 1].
    fn split<const D: usize>(&self, output: Tensor<D>) -> (Tensor<D>, Option<Tensor<D>>) {
        if self.variance != Variance::LearnedRange {
            return (output, None);
        }
        let channels = output.dims()[1] / 2;
        let fraction = (output.clone().narrow(1, channels, channels) + 1.0) * 0.5;
        (output.narrow(1, 0, channels), Some(fraction))
    }
}

/// q(x' | x, x0) from one visited level to the next: DDPM eq. 7.
struct Posterior {
    clean: f64,
    noisy: f64,
    beta: f64,
    variance: f64,
}

impl Posterior {
    fn new(level: Level, next: Level) -> Self {
        let (now, then) = (level.cumulative(), next.cumulative());
        let alpha = now / then;
        let (beta, left) = (1.0 - alpha, 1.0 - now);
        Self {
            clean: then.sqrt() * beta / left,
            noisy: alpha.sqrt() * (1.0 - then) / left,
            beta,
            variance: (beta * (1.0 - then) / left).max(LEAST_VARIANCE),
        }
    }

    /// Standard normal noise brought to the posterior's deviation.
    fn scaled<const D: usize>(&self, noise: Tensor<D>, variance: Variance, fraction: Option<Tensor<D>>) -> Tensor<D> {
        match (variance, fraction) {
            (Variance::LearnedRange, Some(fraction)) => {
                let (small, large) = (self.variance.ln(), self.beta.ln());
                noise * (fraction * (large - small) + small).mul_scalar(0.5).exp()
            }
            (Variance::FixedLarge, _) => noise * self.beta.sqrt(),
            _ => noise * self.variance.sqrt(),
        }
    }
}
