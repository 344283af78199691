//! Euler's method on Karras et al.'s probability-flow equation, noise level as time.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, Oracle};
use crate::{Level, NoiseSchedule, Spacing, Target};

/// First-order sampler in EDM space, deterministic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Euler {
    /// Network evaluations.
    pub steps: usize,
    /// Timesteps visited; with `linspace` they may lie between two training timesteps.
    #[serde(default = "leading")]
    pub spacing: Spacing,
}

const fn leading() -> Spacing {
    Spacing::Leading { offset: 1 }
}

impl Euler {
    /// Descending timesteps.
    pub fn timesteps(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        self.spacing.visits(self.steps, schedule.len())
    }

    /// Noise levels σ/α of the timesteps, and 0.
    pub fn sigmas(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        let levels = self.timesteps(schedule).into_iter().map(|t| schedule.edm_at(t));
        levels.chain(std::iter::once(0.0)).collect()
    }

    /// Factor on the starting noise: the first level; where the list does not start at pure noise, that of a sample of unit variance.
    pub fn start_scale(&self, schedule: &NoiseSchedule) -> f64 {
        let first = self.sigmas(schedule)[0];
        match self.spacing {
            Spacing::Linspace | Spacing::Rounded | Spacing::Trailing => first,
            Spacing::Leading { .. } | Spacing::FlooredLinspace => (first * first + 1.0).sqrt(),
        }
    }

    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let sigmas = self.sigmas(schedule);
        let mut x = start * self.start_scale(schedule);
        for (step, timestep) in self.timesteps(schedule).into_iter().enumerate() {
            let (sigma, next) = (sigmas[step], sigmas[step + 1]);
            let alpha = 1.0 / (sigma * sigma + 1.0).sqrt();
            let scaled = x.clone() * alpha;
            let output = (oracle.denoise)(scaled.clone(), timestep);
            let clean = target.clean(output, scaled, Level { alpha, sigma: sigma * alpha });
            x = x.clone() + (x - clean) * ((next - sigma) / sigma);
            oracle.report(step + 1, self.steps, &x)?;
        }
        Ok(x)
    }
}
