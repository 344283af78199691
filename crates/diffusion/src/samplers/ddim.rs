//! DDIM: from any level to any other along the predicted noise.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, FinalLevel, Oracle, index};
use crate::{Level, NoiseSchedule, Spacing, Target};

/// Implicit sampler, deterministic with `eta` 0.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ddim {
    /// Network evaluations.
    pub steps: usize,
    /// Noise put back, 0 none, 1 as much as DDPM.
    #[serde(default)]
    pub eta: f64,
    /// Timesteps visited.
    #[serde(default = "leading")]
    pub spacing: Spacing,
    /// Level after the last step.
    #[serde(default)]
    pub last: FinalLevel,
    /// Clamp the predicted clean sample to ±1; for pictures, not for latents.
    #[serde(default)]
    pub clip: bool,
}

const fn leading() -> Spacing {
    Spacing::Leading { offset: 1 }
}

impl Ddim {
    /// Descending timesteps.
    pub fn timesteps(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        self.spacing.visits(self.steps, schedule.len())
    }

    /// Each step goes ⌊T / steps⌋ timesteps down, which is not always the next one visited (diffusers).
    fn next(&self, schedule: &NoiseSchedule, timestep: f64) -> Level {
        let next = timestep - (schedule.len() / self.steps) as f64;
        if next < 0.0 { self.last.level(schedule) } else { schedule.level(index(next)) }
    }

    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let mut x = start;
        for (step, timestep) in self.timesteps(schedule).into_iter().enumerate() {
            let (level, next) = (schedule.level(index(timestep)), self.next(schedule, timestep));
            let output = (oracle.denoise)(x.clone(), timestep);
            let mut clean = target.clean(output.clone(), x.clone(), level);
            let noise = if self.clip {
                clean = clean.clamp(-1.0, 1.0);
                (x - clean.clone() * level.alpha) / level.sigma
            } else {
                target.noise(output, x, level)
            };
            let fresh =
                self.eta * next.sigma / level.sigma * (1.0 - level.cumulative() / next.cumulative()).max(0.0).sqrt();
            let along = (next.sigma.powi(2) - fresh.powi(2)).max(0.0).sqrt();
            x = clean * next.alpha + noise * along;
            if fresh > 0.0 {
                x = x + (oracle.noise)() * fresh;
            }
            oracle.report(step + 1, self.steps, &x)?;
        }
        Ok(x)
    }
}
