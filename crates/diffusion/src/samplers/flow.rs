//! Euler's method on a rectified flow.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, Oracle};
use crate::NoiseSchedule;
use crate::flow::flow_sigmas;

/// First-order sampler of a flow, deterministic. The network gives noise − x0; the timestep it is told is σ·T.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlowEuler {
    /// Network evaluations.
    pub steps: usize,
    /// See [`flow_sigmas`].
    #[serde(default = "one")]
    pub shift: f64,
}

const fn one() -> f64 {
    1.0
}

impl FlowEuler {
    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let sigmas = flow_sigmas(self.steps, self.shift, schedule.len());
        let mut x = start;
        for (step, pair) in sigmas.windows(2).enumerate() {
            let velocity = (oracle.denoise)(x.clone(), pair[0] * schedule.len() as f64);
            x = x + velocity * (pair[1] - pair[0]);
            oracle.report(step + 1, self.steps, &x)?;
        }
        Ok(x)
    }
}
