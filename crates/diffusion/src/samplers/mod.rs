//! Samplers: each one function from noise to a sample that calls a closure for the network's output.
//!
//! Equal start, equal noise and an equal network give equal samples. All arithmetic on tensors is differentiable. `start` is standard
//! normal noise; samplers in EDM space scale it themselves.

mod ddim;
mod ddpm;
mod dpm_solver;
mod euler;
mod flow;
mod unipc;

use std::ops::ControlFlow;

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

pub use ddim::Ddim;
pub use ddpm::{Ddpm, Variance};
pub use dpm_solver::DpmSolver;
pub use euler::Euler;
pub use flow::FlowEuler;
pub use unipc::{SolverVariant, UniPc};

use crate::{DiffusionError, Level, NoiseSchedule, Target};

/// What a sampler asks for while it runs.
pub struct Oracle<'a, const D: usize> {
    /// Network output at a noisy sample and a training timestep (fractional for [`Euler`] and [`FlowEuler`]), guidance included.
    pub denoise: &'a mut dyn FnMut(Tensor<D>, f64) -> Tensor<D>,
    /// Standard normal noise shaped like the sample, a fresh one at each call. Deterministic samplers never ask.
    pub noise: &'a mut dyn FnMut() -> Tensor<D>,
    /// Told after every step; a break cancels.
    pub watch: &'a mut dyn FnMut(StepReport<'_, D>) -> ControlFlow<()>,
}

/// Where a sampler stands.
pub struct StepReport<'a, const D: usize> {
    /// Steps done.
    pub done: usize,
    /// Steps in all.
    pub steps: usize,
    /// The sample after this step; in EDM space for [`Euler`].
    pub x: &'a Tensor<D>,
}

/// The watcher broke off.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("sampling was cancelled after {done} of {steps} steps")]
pub struct Cancelled {
    /// Steps done.
    pub done: usize,
    /// Steps in all.
    pub steps: usize,
}

impl<const D: usize> Oracle<'_, D> {
    fn report(&mut self, done: usize, steps: usize, x: &Tensor<D>) -> Result<(), Cancelled> {
        match (self.watch)(StepReport { done, steps, x }) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(Cancelled { done, steps }),
        }
    }
}

/// Noise level at which a multistep solver stops.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FinalLevel {
    /// No noise.
    #[default]
    Zero,
    /// The level of timestep 0, as older versions of diffusers and the public code of DualDiff have it.
    SigmaMin,
}

impl FinalLevel {
    fn level(self, schedule: &NoiseSchedule) -> Level {
        match self {
            Self::Zero => Level::CLEAN,
            Self::SigmaMin => schedule.level(0),
        }
    }
}

/// A sampler with its settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SamplerConfig {
    /// Ho et al., "Denoising Diffusion Probabilistic Models".
    Ddpm(Ddpm),
    /// Song et al., "Denoising Diffusion Implicit Models".
    Ddim(Ddim),
    /// Zhao et al., "UniPC".
    UniPc(UniPc),
    /// Lu et al., "DPM-Solver++", 2M.
    DpmSolver(DpmSolver),
    /// Karras et al., Euler's method in EDM space.
    Euler(Euler),
    /// Euler's method on a rectified flow.
    FlowEuler(FlowEuler),
}

impl SamplerConfig {
    /// Network evaluations of one sample.
    pub fn steps(&self) -> usize {
        match self {
            Self::Ddpm(sampler) => sampler.steps,
            Self::Ddim(sampler) => sampler.steps,
            Self::UniPc(sampler) => sampler.steps,
            Self::DpmSolver(sampler) => sampler.steps,
            Self::Euler(sampler) => sampler.steps,
            Self::FlowEuler(sampler) => sampler.steps,
        }
    }

    /// Checks the settings against a schedule.
    ///
    /// # Errors
    /// No steps or more than the schedule has timesteps, an order that does not exist, a first level that the network's target cannot leave.
    pub fn checked(&self, schedule: &NoiseSchedule, target: Target) -> Result<(), DiffusionError> {
        let (steps, most) = (self.steps(), schedule.len());
        let most = if matches!(self, Self::UniPc(_) | Self::DpmSolver(_)) { most - 1 } else { most };
        if steps == 0 || steps > most {
            return Err(DiffusionError(format!("a sampler takes 1 to {most} steps on this schedule, not {steps}")));
        }
        if let Self::UniPc(UniPc { order, .. }) = self
            && !(1..=3).contains(order)
        {
            return Err(DiffusionError(format!("UniPC has order 1, 2 or 3, not {order}")));
        }
        let without_signal = schedule.level(schedule.len() - 1).alpha == 0.0;
        let needs_signal =
            target == Target::Noise || matches!(self, Self::UniPc(_) | Self::DpmSolver(_) | Self::Euler(_));
        if without_signal && needs_signal && !matches!(self, Self::FlowEuler(_)) {
            let why = "a schedule that ends in pure noise needs a velocity or clean target and DDPM or DDIM";
            return Err(DiffusionError(why.to_owned()));
        }
        Ok(())
    }

    /// Runs the sampler; see the type of each.
    ///
    /// # Errors
    /// [`Cancelled`] when the watcher broke off.
    pub fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        match self {
            Self::Ddpm(sampler) => sampler.sample(schedule, target, start, oracle),
            Self::Ddim(sampler) => sampler.sample(schedule, target, start, oracle),
            Self::UniPc(sampler) => sampler.sample(schedule, target, start, oracle),
            Self::DpmSolver(sampler) => sampler.sample(schedule, target, start, oracle),
            Self::Euler(sampler) => sampler.sample(schedule, target, start, oracle),
            Self::FlowEuler(sampler) => sampler.sample(schedule, start, oracle),
        }
    }
}

/// Training timestep as an index; the lists of the samplers that use it hold whole numbers.
fn index(timestep: f64) -> usize {
    timestep.max(0.0) as usize
}
