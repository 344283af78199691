//! From the gradient at the pictures to those of the parameters, stage by stage.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::Tensor;
use nn::RotaryBlock;
use nn::segments::{RunBlock, Segments};

use crate::BevVae;
use crate::state_coder::DiagonalGaussian;

/// Collects the parameters' gradients from the last piece to the first.
pub(super) struct WayBack<'a> {
    pub model: &'a BevVae,
    pub gradients: GradientsAccumulator<BevVae>,
}

impl WayBack<'_> {
    /// Runs a piece again on the tape; the gradient at its input.
    pub fn piece<const I: usize, const O: usize>(
        &mut self,
        input: Tensor<I>,
        upstream: Tensor<O>,
        run: impl Fn(&BevVae, Tensor<I>) -> Tensor<O>,
    ) -> Tensor<I> {
        let start = Tensor::from_inner(input).require_grad();
        let end = run(self.model, start.clone());
        let gradients = (end * Tensor::from_inner(upstream)).sum().backward();
        let below = start.grad(&gradients).unwrap_or_else(|| start.clone().inner().zeros_like());
        self.gradients.accumulate(self.model, GradientsParams::from_grads(gradients, self.model));
        below
    }

    /// A table of parameters that nothing comes before.
    pub fn table<const O: usize>(&mut self, upstream: Tensor<O>, run: impl Fn(&BevVae) -> Tensor<O>) {
        let gradients = (run(self.model) * Tensor::from_inner(upstream)).sum().backward();
        self.gradients.accumulate(self.model, GradientsParams::from_grads(gradients, self.model));
    }

    pub fn stack(
        &mut self,
        segments: Segments<3, 1>,
        blocks: &[RotaryBlock],
        upstream: Tensor<3>,
        run: RunBlock<RotaryBlock, 3, 1>,
    ) -> Tensor<3> {
        let found = segments.backward(blocks, upstream, run);
        self.gradients.accumulate(self.model, found.params);
        found.input
    }

    /// The gradients at the first state and at the values that every block looks at.
    pub fn conditioned<M: Module, const D: usize, const C: usize>(
        &mut self,
        segments: Segments<D, C>,
        blocks: &[M],
        upstream: Tensor<D>,
        run: RunBlock<M, D, C>,
    ) -> (Tensor<D>, Tensor<C>) {
        let values = segments.condition();
        let found = segments.backward(blocks, upstream, run);
        self.gradients.accumulate(self.model, found.params);
        (found.input, found.condition.unwrap_or_else(|| values.zeros_like()))
    }
}

/// Gradient of `weight` times the mean KL term at the moments.
pub(super) fn kl_gradient(moments: Tensor<3>, weight: f64) -> Tensor<3> {
    let leaf = Tensor::from_inner(moments).require_grad();
    let kl = DiagonalGaussian::from_moments(leaf.clone()).kl().mean() * weight;
    let gradients = kl.backward();
    leaf.grad(&gradients).unwrap_or_else(|| leaf.clone().inner().zeros_like())
}
