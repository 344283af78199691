//! DPM-Solver++ 2M: second order in λ, data prediction.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, FinalLevel, Oracle, index};
use crate::{NoiseSchedule, Spacing, Target};

/// Below so many steps the last one is first order, for stability.
const FEW_STEPS: usize = 15;

/// Multistep sampler, deterministic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DpmSolver {
    /// Network evaluations.
    pub steps: usize,
    /// Timesteps visited.
    #[serde(default = "linspace")]
    pub spacing: Spacing,
    /// Level after the last step.
    #[serde(default)]
    pub last: FinalLevel,
}

const fn linspace() -> Spacing {
    Spacing::Linspace
}

impl DpmSolver {
    /// Descending timesteps.
    pub fn timesteps(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        self.spacing.visits_before_end(self.steps, schedule.len())
    }

    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let timesteps = self.timesteps(schedule);
        let mut x = start;
        // Clean sample and λ of the step before.
        let mut before: Option<(Tensor<D>, f64)> = None;
        for (step, timestep) in timesteps.iter().enumerate() {
            let level = schedule.level(index(*timestep));
            let next = timesteps.get(step + 1).map_or(self.last.level(schedule), |t| schedule.level(index(*t)));
            let clean = target.clean((oracle.denoise)(x.clone(), *timestep), x.clone(), level);
            let h = next.lambda() - level.lambda();
            let last = step + 1 == timesteps.len();
            let first_order = last && (self.last == FinalLevel::Zero || timesteps.len() < FEW_STEPS);
            let lambda = level.lambda();
            let data = match before.take() {
                Some((old, old_lambda)) if !first_order => {
                    let half = 0.5 * h / (lambda - old_lambda);
                    clean.clone() * (1.0 + half) - old * half
                }
                _ => clean.clone(),
            };
            x = x * (next.sigma / level.sigma) - data * (next.alpha * (-h).exp_m1());
            before = Some((clean, lambda));
            oracle.report(step + 1, self.steps, &x)?;
        }
        Ok(x)
    }
}
