//! Exponential moving average of a module's parameters, with which validation and sampling run.
//!
//! Parity: `tests/it/ema_adamw.rs`.

use burn::module::Module;
use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::checkpoint::{CheckpointReader, CheckpointWriter};
use crate::lanes::for_each_job;
use crate::params::{NamedTensor, NamedTensors, inner_device, map_parameters, named_parameters};
use crate::weights::{ALL, Keep, WeightDiff};

/// Settings of an [`Ema`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EmaConfig {
    /// Share of the old average in each update.
    pub decay: f64,
    /// Starts with a smaller decay, `min(decay, (1 + k) / (10 + k))` in the k-th update from 0, so that short runs do
    /// not average over their random start.
    pub warmup: bool,
}

impl Default for EmaConfig {
    fn default() -> Self {
        Self { decay: 0.9999, warmup: false }
    }
}

/// Moving average `a = d·a + (1-d)·p` of float parameters of a module; starts as a copy of them.
#[derive(Clone, Debug)]
pub struct Ema {
    config: EmaConfig,
    updates: u64,
    average: NamedTensors,
    keep: Keep,
}

impl Ema {
    /// An average that equals `module` now.
    pub fn new<M: Module>(config: EmaConfig, module: &M) -> Self {
        Self::of_part(config, module, ALL)
    }

    /// An average of the parameters whose path `keep` accepts: where the others are frozen, they need none.
    pub fn of_part<M: Module>(config: EmaConfig, module: &M, keep: Keep) -> Self {
        let mut average = named_parameters(module);
        average.retain(|path, _| keep(path));
        Self { config, updates: 0, average, keep }
    }

    /// Decay of the next update.
    pub fn decay(&self) -> f64 {
        let updates = self.updates as f64;
        if self.config.warmup { self.config.decay.min((1.0 + updates) / (10.0 + updates)) } else { self.config.decay }
    }

    /// Moves the average towards `module`, which must have the parameters it was made from.
    pub fn update<M: Module>(&mut self, module: &M) {
        let decay = self.decay();
        if let Some(device) = inner_device(module) {
            let pairs = named_parameters(module).into_iter();
            let pairs = pairs.filter_map(|(path, new)| Some((self.average.remove(&path)?, path, new))).collect();
            self.average.extend(for_each_job(
                &device,
                pairs,
                |(old, path, new): (NamedTensor, String, NamedTensor)| {
                    let values = old.values.mul_scalar(decay).add(new.values.mul_scalar(1.0 - decay));
                    (path, NamedTensor { values, ..old })
                },
            ));
        }
        self.updates += 1;
    }

    /// `module` with the averaged values in place of its own; pass `model.valid()` for use without a tape.
    #[must_use]
    pub fn apply<M: Module>(&self, module: M) -> M {
        map_parameters(module, |info, own| match self.average.get(&info.path) {
            Some(average) => average.values.clone(),
            None => own,
        })
    }

    /// The averages by parameter path.
    pub fn average(&self) -> &NamedTensors {
        &self.average
    }

    /// Stores the averages as `<name>.safetensors`, readable as weights of the module, and the update count.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn save(&self, writer: &mut CheckpointWriter, name: &str) -> Result<(), TrainError> {
        writer.tensors(name, &self.average)?;
        writer.value(&format!("{name}.updates"), &self.updates)
    }

    /// Takes the averages back, on the device of `module`.
    ///
    /// # Errors
    /// When the file is absent or its tensors are not those of `module`.
    pub fn load<M: Module>(&mut self, reader: &CheckpointReader, name: &str, module: &M) -> Result<(), TrainError> {
        let Some(device) = inner_device(module) else { return Ok(()) };
        let stored = reader.tensors(name, &device)?;
        WeightDiff::between(module, &stored, self.keep).into_result(&reader.file(name))?;
        self.updates = reader.value(&format!("{name}.updates"))?;
        self.average = stored;
        Ok(())
    }
}
