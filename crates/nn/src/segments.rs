//! Segment checkpointing: a stack of blocks whose backward pass computes the inner values again instead of keeping them.
//!
//! Paper: Chen et al., "Training Deep Nets with Sublinear Memory Cost", section 4. The tape of burn keeps every product and
//! convolution; here the forward pass runs without a tape and keeps the input of each segment, and the backward pass differentiates
//! one segment after the other from the last. Memory is the segments' inputs and the inner values of one segment; time is one more
//! forward pass. The gradients are those of the whole stack. Shapes: whatever the blocks take.

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::Tensor;

mod graph;

pub use graph::{SegmentGraph, Slot};

/// How one block computes: block, state, condition to the next state.
pub type RunBlock<'a, M, const D: usize, const C: usize> = &'a dyn Fn(&M, Tensor<D>, Tensor<C>) -> Tensor<D>;

/// What the forward pass keeps.
#[derive(Debug, Clone)]
pub struct Segments<const D: usize, const C: usize> {
    /// State before each segment, without a tape.
    inputs: Vec<Tensor<D>>,
    /// What every block is told.
    condition: Tensor<C>,
    /// Blocks in each segment but the last, which may have fewer.
    length: usize,
    output: Tensor<D>,
}

/// Gradients of a stack.
pub struct SegmentGradients<const D: usize, const C: usize> {
    /// Of the state before the first block.
    pub input: Tensor<D>,
    /// Of the condition, over all blocks; `None` when no block looks at it.
    pub condition: Option<Tensor<C>>,
    /// Of the blocks' parameters.
    pub params: GradientsParams,
}

impl<const D: usize, const C: usize> Segments<D, C> {
    /// Runs the stack without a tape, keeping the state before every `length`-th block.
    ///
    /// State and condition come without a tape ([`Tensor::inner`]), the blocks as they are trained.
    ///
    /// # Panics
    /// For segments of no block.
    pub fn forward<M: Module>(
        blocks: &[M],
        length: usize,
        (state, condition): (Tensor<D>, Tensor<C>),
        run: RunBlock<M, D, C>,
    ) -> Self {
        assert!(length > 0, "a segment holds at least one block");
        let mut inputs = Vec::with_capacity(blocks.len().div_ceil(length));
        let output = blocks.chunks(length).fold(state, |state, segment| {
            inputs.push(state.clone());
            segment.iter().fold(state, |state, block| run(&block.clone().valid(), state, condition.clone()))
        });
        Self { inputs, condition, length, output }
    }

    /// State behind the last block, without a tape.
    #[must_use]
    pub fn output(&self) -> Tensor<D> {
        self.output.clone()
    }

    /// What every block is told, without a tape.
    #[must_use]
    pub fn condition(&self) -> Tensor<C> {
        self.condition.clone()
    }

    /// Gradients of a loss from its gradient at [`Segments::output`] (without a tape); `blocks` and `run` as in the forward pass.
    pub fn backward<M: Module>(
        self,
        blocks: &[M],
        upstream: Tensor<D>,
        run: RunBlock<M, D, C>,
    ) -> SegmentGradients<D, C> {
        let stack = blocks.to_vec();
        let mut params = GradientsAccumulator::<Vec<M>>::new();
        let mut total: Option<Tensor<C>> = None;
        let segments = blocks.chunks(self.length).zip(self.inputs).rev();
        let input = segments.fold(upstream, |upstream, (segment, input)| {
            let start = Tensor::from_inner(input).require_grad();
            let condition = Tensor::from_inner(self.condition.clone()).require_grad();
            let end = segment.iter().fold(start.clone(), |state, block| run(block, state, condition.clone()));
            let zero = upstream.zeros_like();
            let gradients = (end * Tensor::from_inner(upstream)).sum().backward();
            if let Some(part) = condition.grad(&gradients) {
                total = Some(match total.take() {
                    Some(sum) => sum + part,
                    None => part,
                });
            }
            // Only a segment that forgets its input gives none.
            let below = start.grad(&gradients).unwrap_or(zero);
            params.accumulate(&stack, GradientsParams::from_grads(gradients, &stack));
            below
        });
        SegmentGradients { input, condition: total, params: params.grads() }
    }
}
