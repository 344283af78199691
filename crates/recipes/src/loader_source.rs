//! The data loader as the training loop's source.

use std::sync::Arc;

use data::{Loader, LoaderConfig, Mixture, SceneBatch};
use train::{BatchSource, TrainError};

/// The data loader as the loop's source.
#[derive(Debug)]
pub struct LoaderSource(Loader);

impl LoaderSource {
    /// Opens the training mixture at a position.
    ///
    /// # Errors
    /// Datasets that cannot be opened or mixed.
    pub fn open(mixture: Arc<Mixture>, config: LoaderConfig, position: u64) -> Result<Self, TrainError> {
        Loader::new(mixture, config, position).map(Self).map_err(TrainError::task)
    }
}

impl BatchSource for LoaderSource {
    type Batch = SceneBatch;

    fn next(&mut self) -> Result<SceneBatch, TrainError> {
        self.0.next_batch().map_err(TrainError::task)
    }

    fn position(&self) -> u64 {
        self.0.position()
    }
}
