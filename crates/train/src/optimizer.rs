//! AdamW over the parameters of a module, with state by parameter path.
//!
//! Paper: Loshchilov & Hutter, "Decoupled Weight Decay Regularization", algorithm 2. burn's own optimizer keys its state
//! by random ids, which a new process does not share, and decays every parameter alike; hence this one.
//! Parity: `tests/it/ema_adamw.rs`.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::checkpoint::{CheckpointReader, CheckpointWriter};
use crate::lanes::for_each_job;
use crate::params::{
    NamedTensor, NamedTensors, ParamInfo, inner_device, list_parameters, map_parameters, map_with_gradients,
};
use crate::schedule::Schedule;
use crate::update::GradientClip;
use crate::weights::WeightDiff;

/// Settings of one optimizer: AdamW, its learning rate over the steps and gradient clipping. Defaults are those of the
/// BEV-VAE paper, section "Implementation details", with the decay scope of our choice.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizerConfig {
    /// Base learning rate, multiplied by the schedule.
    pub learning_rate: f64,
    /// Decay of the first and second moment.
    pub betas: [f64; 2],
    /// Added to the root of the second moment.
    pub eps: f64,
    /// Decoupled weight decay, multiplied by the learning rate.
    pub weight_decay: f64,
    /// Which parameters decay.
    pub decay_scope: DecayScope,
    /// Clipping of the gradients before the update.
    pub gradient_clip: GradientClip,
    /// Learning rate over the steps.
    pub schedule: Schedule,
    /// Factors on the learning rate by the start of a parameter's path, such as `"encoder.scene" = 3.0`; the longest match wins, 1 without
    /// any. Narrow layers bear larger steps than wide ones.
    pub learning_rate_factors: BTreeMap<String, f64>,
}

impl OptimizerConfig {
    /// # Errors
    /// [`TrainError::Config`] for a factor that is no finite number from 0, or for a path that no parameter of `module` has.
    pub fn check<M: Module>(&self, module: &M) -> Result<(), TrainError> {
        let parameters = list_parameters(module);
        for (prefix, &factor) in &self.learning_rate_factors {
            let known = parameters.iter().any(|info| is_within(&info.path, prefix));
            if !known {
                let why = format!("learning_rate_factors: no parameter's path starts with {prefix:?}");
                return Err(TrainError::Config(why));
            }
            if !factor.is_finite() || factor < 0.0 {
                let why = format!("learning_rate_factors.{prefix:?} = {factor}: needs a finite number from 0");
                return Err(TrainError::Config(why));
            }
        }
        Ok(())
    }
}

/// Whether `path` is `prefix` or lies below it: `a.b.c` is within `a.b`, `a.bc` is not.
fn is_within(path: &str, prefix: &str) -> bool {
    path.strip_prefix(prefix).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 1e-4,
            betas: [0.9, 0.99],
            eps: 1e-8,
            weight_decay: 1e-4,
            decay_scope: DecayScope::default(),
            gradient_clip: GradientClip::default(),
            schedule: Schedule::default(),
            learning_rate_factors: BTreeMap::new(),
        }
    }
}

/// Which parameters feel weight decay.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum DecayScope {
    /// Tensors of rank 2 and more (matrices and convolutions, no gains or biases) whose last path part contains none
    /// of the `except` texts.
    Matrices {
        /// Parts of names that do not decay although they are tables, such as learned queries and place codes.
        except: Vec<String>,
    },
    /// Every parameter.
    All,
}

impl Default for DecayScope {
    fn default() -> Self {
        Self::Matrices { except: ["query", "queries", "embedding", "code"].map(String::from).to_vec() }
    }
}

impl DecayScope {
    /// Whether this parameter decays.
    pub fn covers(&self, info: &ParamInfo) -> bool {
        match self {
            Self::All => true,
            Self::Matrices { except } => {
                info.shape.len() >= 2 && !except.iter().any(|text| info.leaf().contains(text.as_str()))
            }
        }
    }
}

/// First and second moment of one parameter and how many updates it has had.
#[derive(Clone, Debug)]
struct Moments {
    shape: Vec<usize>,
    first: Tensor<1>,
    second: Tensor<1>,
    updates: u64,
}

/// AdamW with its state. One value per optimized module; a GAN has two.
#[derive(Clone, Debug)]
pub struct AdamW {
    betas: [f64; 2],
    eps: f64,
    weight_decay: f64,
    scope: DecayScope,
    learning_rate_factors: BTreeMap<String, f64>,
    state: BTreeMap<String, Moments>,
}

impl AdamW {
    /// An optimizer without history. Learning rate, clipping and schedule of `config` are not used here.
    pub fn new(config: &OptimizerConfig) -> Self {
        Self {
            betas: config.betas,
            eps: config.eps,
            weight_decay: config.weight_decay,
            scope: config.decay_scope.clone(),
            learning_rate_factors: config.learning_rate_factors.clone(),
            state: BTreeMap::new(),
        }
    }

    /// Updates every parameter that has a gradient and uses the gradients up. In the order of the formula:
    /// `p *= 1 - lr·wd`, `m = β₁m + (1-β₁)g`, `v = β₂v + (1-β₂)g²`, `p -= lr/(1-β₁ᵗ) · m / (√(v/(1-β₂ᵗ)) + eps)`, where t
    /// counts the updates of that parameter from 1.
    #[must_use]
    pub fn step<M: Module>(&mut self, module: M, grads: &mut GradientsParams, learning_rate: f64) -> M {
        let mut jobs = Vec::new();
        let module = map_with_gradients(module, grads, |info, values, grad| {
            jobs.push((info.clone(), values.clone(), grad, self.state.remove(&info.path)));
            values
        });
        let Some(device) = inner_device(&module) else { return module };
        let this = &*self;
        let updated = for_each_job(&device, jobs, |(info, values, grad, old)| {
            let (values, moments) = this.update(&info, values, grad, old, learning_rate * this.factor(&info.path));
            (info.path, values, moments)
        });
        let mut new_values = BTreeMap::new();
        for (path, values, moments) in updated {
            self.state.insert(path.clone(), moments);
            new_values.insert(path, values);
        }
        map_parameters(module, |info, values| new_values.remove(&info.path).unwrap_or(values))
    }

    /// Factor on the learning rate of the parameter at `path`.
    fn factor(&self, path: &str) -> f64 {
        let matching = self.learning_rate_factors.iter().filter(|(prefix, _)| is_within(path, prefix));
        matching.max_by_key(|(prefix, _)| prefix.len()).map_or(1.0, |(_, &factor)| factor)
    }

    fn update(
        &self,
        info: &ParamInfo,
        values: Tensor<1>,
        grad: Tensor<1>,
        old: Option<Moments>,
        learning_rate: f64,
    ) -> (Tensor<1>, Moments) {
        let [beta1, beta2] = self.betas;
        let fresh_first = grad.clone().mul_scalar(1.0 - beta1);
        let fresh_second = grad.clone().mul(grad).mul_scalar(1.0 - beta2);
        let (first, second, updates) = match old {
            Some(old) => {
                let first = old.first.mul_scalar(beta1).add(fresh_first);
                (first, old.second.mul_scalar(beta2).add(fresh_second), old.updates + 1)
            }
            None => (fresh_first, fresh_second, 1),
        };
        let correction = |beta: f64| 1.0 - beta.powf(updates as f64);
        let root = second.clone().div_scalar(correction(beta2)).sqrt().add_scalar(self.eps);
        let change = first.clone().mul_scalar(learning_rate / correction(beta1)).div(root);
        let decay = learning_rate * self.weight_decay;
        let values = if decay != 0.0 && self.scope.covers(info) { values.mul_scalar(1.0 - decay) } else { values };
        (values.sub(change), Moments { shape: info.shape.clone(), first, second, updates })
    }

    /// Moments by name: `first.<path>` and `second.<path>`.
    pub fn moments(&self) -> NamedTensors {
        let mut all = NamedTensors::new();
        for (path, moments) in &self.state {
            let named = |values: &Tensor<1>| NamedTensor { shape: moments.shape.clone(), values: values.clone() };
            all.insert(format!("first.{path}"), named(&moments.first));
            all.insert(format!("second.{path}"), named(&moments.second));
        }
        all
    }

    /// Stores the moments as `<name>.safetensors` and the update counts in the state file.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, writer: &mut CheckpointWriter, name: &str) -> Result<(), TrainError> {
        writer.tensors(name, &self.moments())?;
        writer.value(&format!("{name}.updates"), &self.update_counts())
    }

    /// Takes the state back from a checkpoint, on the device of `module`.
    ///
    /// # Errors
    /// When the file is absent, or holds moments of other parameters or shapes than `module` has.
    pub fn load<M: Module>(&mut self, reader: &CheckpointReader, name: &str, module: &M) -> Result<(), TrainError> {
        let counts: UpdateCounts = reader.value(&format!("{name}.updates"))?;
        let Some(device) = inner_device(module) else { return Ok(()) };
        let mut stored = reader.tensors(name, &device)?;
        let mut diff = WeightDiff::default();
        let mut state = BTreeMap::new();
        for info in list_parameters(module) {
            let mut take = |kind: &str| {
                let tensor = stored.remove(&format!("{kind}.{}", info.path))?;
                if tensor.shape != info.shape {
                    diff.wrong_shape.push((format!("{kind}.{}", info.path), info.shape.clone(), tensor.shape));
                    return None;
                }
                Some(tensor.values)
            };
            // A parameter that never had a gradient has no moments, which is no fault.
            if let (Some(first), Some(second)) = (take("first"), take("second")) {
                let updates = counts.of(&info.path);
                state.insert(info.path.clone(), Moments { shape: info.shape.clone(), first, second, updates });
            }
        }
        diff.unexpected.extend(stored.into_keys());
        diff.into_result(&reader.file(name))?;
        self.state = state;
        Ok(())
    }

    fn update_counts(&self) -> UpdateCounts {
        let all = self.state.values().map(|moments| moments.updates).max().unwrap_or(0);
        let late = self.state.iter().filter(|(_, moments)| moments.updates != all);
        UpdateCounts { all, late: late.map(|(path, moments)| (path.clone(), moments.updates)).collect() }
    }
}

/// Update counts in a short form: nearly all parameters share one.
#[derive(Serialize, Deserialize)]
struct UpdateCounts {
    all: u64,
    late: BTreeMap<String, u64>,
}

impl UpdateCounts {
    fn of(&self, path: &str) -> u64 {
        self.late.get(path).copied().unwrap_or(self.all)
    }
}

#[cfg(test)]
mod tests {
    use burn::module::ParamId;

    use super::*;

    #[test]
    fn only_matrices_decay_and_query_tables_do_not() {
        let scope = DecayScope::default();
        let covers = |path: &str, shape: &[usize]| {
            scope.covers(&ParamInfo { path: path.into(), shape: shape.to_vec(), id: ParamId::new() })
        };
        assert!(covers("blocks.0.attn.qkv.weight", &[4, 12]));
        assert!(covers("fpn.conv.weight", &[4, 4, 3, 3]));
        assert!(covers("query.weight", &[4, 4]));
        assert!(!covers("blocks.0.norm.gain", &[4]));
        assert!(!covers("scene.pillar_queries", &[16, 4]));
        assert!(!covers("layout.slice_code", &[4, 24]));
        let all = DecayScope::All;
        assert!(all.covers(&ParamInfo { path: "b".into(), shape: vec![3], id: ParamId::new() }));
    }
}
