//! One parameter update with everything around it: schedule, clipping, guard, AdamW.

use burn::module::Module;
use burn::optim::GradientsParams;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::checkpoint::{CheckpointReader, CheckpointWriter};
use crate::guard::{GuardVerdict, NonFiniteGuard};
use crate::norm::{clip_global_norm, global_norm};
use crate::optimizer::{AdamW, OptimizerConfig};
use crate::task::StepContext;

/// What happens to gradients before the update.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GradientClip {
    /// Nothing.
    Off,
    /// Scaled down so that their norm over all parameters together is at most this.
    GlobalNorm(f64),
}

impl Default for GradientClip {
    fn default() -> Self {
        Self::GlobalNorm(1.0) // [public code Czm369/bev-vae]
    }
}

/// What one update did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Update {
    /// Global gradient norm before clipping.
    pub gradient_norm: f64,
    /// Learning rate of this step.
    pub learning_rate: f64,
    /// Whether parameters and optimizer stayed as they were because a gradient was not finite. The moving average
    /// should then stay too.
    pub skipped: bool,
}

/// Optimizer of one module: AdamW under a schedule, with clipping and the non-finite guard.
#[derive(Clone, Debug)]
pub struct Optimizer {
    config: OptimizerConfig,
    adamw: AdamW,
    guard: NonFiniteGuard,
}

impl Optimizer {
    /// An optimizer without history.
    pub fn new(config: &OptimizerConfig) -> Self {
        Self { config: config.clone(), adamw: AdamW::new(config), guard: NonFiniteGuard::default() }
    }

    /// Learning rate in this step.
    pub fn learning_rate(&self, ctx: &StepContext) -> f64 {
        self.config.learning_rate * self.config.schedule.factor(ctx.step, ctx.total_steps)
    }

    /// The guard's counts.
    pub fn guard(&self) -> &NonFiniteGuard {
        &self.guard
    }

    /// Clips the gradients, judges them and updates `module` with them. One read-back from the device.
    ///
    /// # Errors
    /// [`TrainError::NonFinite`] after too many skipped updates in a row.
    pub fn update<M: Module>(
        &mut self,
        module: M,
        mut grads: GradientsParams,
        ctx: &StepContext,
    ) -> Result<(M, Update), TrainError> {
        let norm = match self.config.gradient_clip {
            GradientClip::Off => global_norm(&grads, &module),
            GradientClip::GlobalNorm(max_norm) => clip_global_norm(&mut grads, &module, max_norm),
        };
        let culprit = (!norm.value.is_finite()).then(|| describe(&norm.nonfinite));
        let verdict = self.guard.judge(ctx.step, culprit.as_deref(), ctx.stop_after_nonfinite)?;
        let learning_rate = self.learning_rate(ctx);
        let update = Update { gradient_norm: norm.value, learning_rate, skipped: verdict == GuardVerdict::Skip };
        let module = if update.skipped { module } else { self.adamw.step(module, &mut grads, learning_rate) };
        Ok((module, update))
    }

    /// Stores moments, update counts and guard counts under `name`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, writer: &mut CheckpointWriter, name: &str) -> Result<(), TrainError> {
        self.adamw.save(writer, name)?;
        writer.value(&format!("{name}.guard"), &self.guard)
    }

    /// Takes everything back that [`Optimizer::save`] stored, on the device of `module`.
    ///
    /// # Errors
    /// When the file is absent or belongs to another module.
    pub fn load<M: Module>(&mut self, reader: &CheckpointReader, name: &str, module: &M) -> Result<(), TrainError> {
        self.adamw.load(reader, name, module)?;
        self.guard = reader.value(&format!("{name}.guard"))?;
        Ok(())
    }
}

/// Names the first bad gradients; a model that has gone NaN has hundreds.
fn describe(paths: &[String]) -> String {
    match paths {
        [] => "the gradient norm".to_string(),
        [one] => format!("the gradient of {one}"),
        [first, ..] => format!("the gradient of {first} and of {} more parameters", paths.len() - 1),
    }
}
