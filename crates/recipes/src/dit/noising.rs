//! From clean latents to noisy ones, and what the network should say about them.

use burn::tensor::Tensor;
use diffusion::{NoiseSchedule, ScheduleConfig, Target, flow_velocity};
use rand::{Rng, RngExt};

use super::NoiseProcess;

/// A noise process with its table.
#[derive(Debug, Clone)]
pub(crate) struct Noising {
    process: NoiseProcess,
    schedule: NoiseSchedule,
}

/// Where between sample and noise: `x = alpha·x0 + sigma·noise`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Instant {
    /// What the network is told.
    pub timestep: f64,
    pub alpha: f64,
    pub sigma: f64,
    /// Factor on the squared error.
    pub weight: f64,
    /// Place in the process, 0 clean, below 1.
    pub share: f64,
}

impl Noising {
    /// # Errors
    /// A schedule that cannot be built.
    pub fn new(process: &NoiseProcess) -> anyhow::Result<Self> {
        let schedule = match process {
            NoiseProcess::Schedule(noise) => noise.schedule,
            // Only its length is used.
            NoiseProcess::RectifiedFlow(flow) => ScheduleConfig { timesteps: flow.timesteps, ..ScheduleConfig::DDPM },
        };
        Ok(Self { process: process.clone(), schedule: NoiseSchedule::new(&schedule)? })
    }

    /// The table that samplers need.
    pub fn schedule(&self) -> &NoiseSchedule {
        &self.schedule
    }

    /// What samplers take the network's output for; those of flows do not ask.
    pub fn target(&self) -> Target {
        match &self.process {
            NoiseProcess::Schedule(noise) => noise.target,
            NoiseProcess::RectifiedFlow(_) => Target::Velocity,
        }
    }

    /// A uniform instant.
    pub fn draw(&self, rng: &mut impl Rng) -> Instant {
        self.at(rng.random::<f64>())
    }

    /// The instant at a place in 0..1.
    pub fn at(&self, share: f64) -> Instant {
        let steps = self.schedule.len();
        match &self.process {
            NoiseProcess::Schedule(noise) => {
                let step = ((share * steps as f64) as usize).min(steps - 1);
                let level = self.schedule.level(step);
                let weight = noise.weight.factor(noise.target, level);
                let share = step as f64 / steps as f64;
                Instant { timestep: step as f64, alpha: level.alpha, sigma: level.sigma, weight, share }
            }
            NoiseProcess::RectifiedFlow(_) => {
                Instant { timestep: share * steps as f64, alpha: 1.0 - share, sigma: share, weight: 1.0, share }
            }
        }
    }

    /// What the network should say. `alpha` and `sigma` are `[B, 1, 1, 1]`.
    pub fn wanted(&self, x0: Tensor<4>, noise: Tensor<4>, alpha: Tensor<4>, sigma: Tensor<4>) -> Tensor<4> {
        match &self.process {
            NoiseProcess::Schedule(scheduled) => scheduled.target.of(x0, noise, alpha, sigma),
            NoiseProcess::RectifiedFlow(_) => flow_velocity(x0, noise),
        }
    }
}
