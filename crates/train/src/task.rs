//! What an experiment kind provides to the loop, and what the loop tells it.

use std::path::Path;

use burn::tensor::Tensor;
use rand_chacha::ChaCha8Rng;

use crate::TrainError;
use crate::checkpoint::{CheckpointReader, CheckpointWriter};

/// Named values on the host, in the order in which they are shown.
pub type Scalars = Vec<(String, f64)>;

/// An experiment kind: it owns models, optimizers and moving averages, and does forward, backward and update itself.
/// The loop owns pacing, logs, validation, checkpoints and interruption.
pub trait Task {
    /// What the data source delivers.
    type Batch;

    /// One optimization step. `batches` holds as many micro batches as `accumulate` of the config says, at least one;
    /// their gradients are averaged, see [`crate::GradientMean`].
    ///
    /// # Errors
    /// Ends the run.
    fn train_step(&mut self, batches: Vec<Self::Batch>, ctx: &StepContext) -> Result<StepOutput, TrainError>;

    /// Values on held-out data, usually with averaged weights. Must not change what training computes.
    ///
    /// # Errors
    /// Ends the run.
    fn validate(&mut self, ctx: &StepContext) -> Result<Scalars, TrainError>;

    /// Writes pictures or samples into `folder`, which exists and is this step's own.
    ///
    /// # Errors
    /// Ends the run.
    fn preview(&mut self, folder: &Path, ctx: &StepContext) -> Result<(), TrainError>;

    /// Stores everything the next steps depend on.
    ///
    /// # Errors
    /// Ends the run; the unfinished checkpoint is not used.
    fn save(&self, writer: &mut CheckpointWriter) -> Result<(), TrainError>;

    /// Takes back what [`Task::save`] stored.
    ///
    /// # Errors
    /// When the checkpoint does not fit the task.
    fn load(&mut self, reader: &CheckpointReader) -> Result<(), TrainError>;
}

/// Delivers batches in an order that depends on the seed and the position only.
pub trait BatchSource {
    /// What is delivered.
    type Batch;

    /// The batch at the current position.
    ///
    /// # Errors
    /// Ends the run: a batch is never skipped silently.
    fn next(&mut self) -> Result<Self::Batch, TrainError>;

    /// Batches delivered since the start of the run, over all its parts.
    fn position(&self) -> u64;
}

/// Where the run is.
#[derive(Clone, Debug)]
pub struct StepContext {
    /// This step, counted from 0. In validation and previews: steps done.
    pub step: u64,
    /// Length of the whole run.
    pub total_steps: u64,
    /// Seed of the run.
    pub seed: u64,
    /// Whether this step's scalars will be read; work that only serves them can be left out otherwise.
    pub log: bool,
    /// How many updates in a row may be skipped for non-finite gradients before the run ends; 0 is without limit.
    pub stop_after_nonfinite: u32,
}

impl StepContext {
    /// Random numbers for one purpose in this step, see [`crate::stream`].
    pub fn stream(&self, purpose: &str) -> ChaCha8Rng {
        crate::stream(self.seed, purpose, self.step)
    }
}

/// A scalar that may still be on the device; it is read only in steps that are logged.
#[derive(Clone, Debug)]
pub enum ScalarValue {
    /// Already on the host.
    Host(f64),
    /// On the device, `[1]`.
    Device(Box<Tensor<1>>),
}

impl From<f64> for ScalarValue {
    fn from(value: f64) -> Self {
        Self::Host(value)
    }
}

impl From<Tensor<1>> for ScalarValue {
    fn from(value: Tensor<1>) -> Self {
        Self::Device(Box::new(value))
    }
}

/// What one step tells the loop.
#[derive(Clone, Debug, Default)]
pub struct StepOutput {
    /// Images this step trained on, for the images per second.
    pub images: usize,
    scalars: Vec<(&'static str, ScalarValue)>,
}

impl StepOutput {
    /// Output of a step over so many images, without scalars yet.
    pub fn new(images: usize) -> Self {
        Self { images, scalars: Vec::new() }
    }

    /// Adds a scalar; tensors must be `[1]`. The one called `loss` is shown on the progress bar.
    pub fn push(&mut self, name: &'static str, value: impl Into<ScalarValue>) {
        self.scalars.push((name, value.into()));
    }

    /// Adds the scalars of another part of the step behind these.
    pub fn append(&mut self, part: Self) {
        self.images += part.images;
        self.scalars.extend(part.scalars);
    }

    /// Reads all scalars; those on the device in one transfer. One name's values, of several micro batches, become their mean.
    pub(crate) fn read(self) -> Scalars {
        let on_device = self.scalars.iter().filter_map(|(_, value)| match value {
            ScalarValue::Device(tensor) => Some(Tensor::clone(tensor).inner()),
            ScalarValue::Host(_) => None,
        });
        let on_device: Vec<Tensor<1>> = on_device.collect();
        let fetched: Vec<f32> = if on_device.is_empty() {
            Vec::new()
        } else {
            Tensor::cat(on_device, 0).into_data().iter::<f32>().collect()
        };
        let mut fetched = fetched.into_iter();
        let mut read = |value: &ScalarValue| match value {
            ScalarValue::Host(value) => *value,
            ScalarValue::Device(_) => fetched.next().map_or(f64::NAN, f64::from),
        };
        let mut sums: Vec<(&'static str, f64, f64)> = Vec::new();
        for (name, value) in &self.scalars {
            let value = read(value);
            match sums.iter_mut().find(|(known, ..)| known == name) {
                Some((_, sum, count)) => (*sum, *count) = (*sum + value, *count + 1.0),
                None => sums.push((name, value, 1.0)),
            }
        }
        sums.into_iter().map(|(name, sum, count)| (name.to_string(), sum / count)).collect()
    }
}
