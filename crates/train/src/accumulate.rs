//! Gradient accumulation: the mean over micro batches. burn's accumulator gives the sum.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};

use crate::norm::scale_gradients;

/// Collects the gradients of several micro batches of one module.
pub struct GradientMean<M> {
    sum: GradientsAccumulator<M>,
    count: u32,
}

impl<M: Module> Default for GradientMean<M> {
    fn default() -> Self {
        Self { sum: GradientsAccumulator::new(), count: 0 }
    }
}

impl<M: Module> GradientMean<M> {
    /// Adds the gradients of one micro batch.
    pub fn add(&mut self, module: &M, grads: GradientsParams) {
        self.sum.accumulate(module, grads);
        self.count += 1;
    }

    /// The mean over all micro batches added since the last call; a parameter without gradient in some of them counts
    /// as zero there. Empty when nothing was added.
    pub fn take(&mut self, module: &M) -> GradientsParams {
        let mut grads = self.sum.grads();
        if self.count > 1 {
            scale_gradients(&mut grads, module, 1.0 / f64::from(self.count));
        }
        self.count = 0;
        grads
    }
}
