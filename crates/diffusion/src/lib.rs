//! Diffusion mathematics over closures: how much noise, what the network predicts, how a sample comes back out of noise.
//!
//! No network lives here. A sampler is one function that calls a closure for the network's output; it is made of plain tensor
//! arithmetic, so that a tape runs through it (reward-guided fine-tuning). Tables are f64 on the host.
//!
//! Letters as in Song et al., "Score-Based Generative Modeling through SDEs", and Lu et al., "DPM-Solver++": `x = α·x0 + σ·noise`,
//! λ = ln(α/σ).

mod bound;
mod flow;
mod guidance;
mod samplers;
mod schedule;
mod target;
mod timesteps;

pub use bound::variance_bound;
pub use flow::{flow_noised, flow_sigmas, flow_velocity};
pub use guidance::{guide, rescale_guidance};
pub use samplers::{
    Cancelled, Ddim, Ddpm, DpmSolver, Euler, FinalLevel, FlowEuler, Oracle, SamplerConfig, SolverVariant, StepReport,
    UniPc, Variance,
};
pub use schedule::{BetaSchedule, Level, NoiseSchedule, ScheduleConfig};
pub use target::{LossWeight, Target};
pub use timesteps::Spacing;

/// A setting that cannot be met.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("diffusion settings: {0}")]
pub struct DiffusionError(pub String);
