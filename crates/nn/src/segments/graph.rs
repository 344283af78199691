//! Segments of a network whose states branch and meet again, such as a UNet with its skips.

use std::ops::Range;

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::Tensor;

/// One value of a [`SegmentGraph`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Slot(usize);

/// Inputs, and whether they lie on a tape.
type Run<'a> = Box<dyn Fn(&[Tensor<4>], bool) -> Vec<Tensor<4>> + 'a>;

struct Segment<'a> {
    reads: Vec<Slot>,
    writes: Range<usize>,
    run: Run<'a>,
}

/// A forward pass without a tape that remembers how it was done, segment by segment.
///
/// Kept are the values between segments; everything inside is computed again, one segment at a time, when the backward pass needs
/// it. Values have four dimensions; whatever has another number is reshaped by its segments.
#[derive(Default)]
pub struct SegmentGraph<'a> {
    values: Vec<Tensor<4>>,
    segments: Vec<Segment<'a>>,
}

impl<'a> SegmentGraph<'a> {
    /// Puts in a value from outside, without a tape.
    pub fn input(&mut self, value: Tensor<4>) -> Slot {
        self.values.push(value);
        Slot(self.values.len() - 1)
    }

    /// A value, without a tape.
    ///
    /// # Panics
    /// For a slot of another graph that has more values.
    #[must_use]
    pub fn value(&self, slot: Slot) -> Tensor<4> {
        self.values[slot.0].clone()
    }

    /// Runs the next segment. `module` is given as it is trained; `run` sees it without a tape now and with one in the backward pass.
    pub fn segment<M: Module + 'a>(
        &mut self,
        module: M,
        reads: &[Slot],
        run: impl Fn(&M, &[Tensor<4>]) -> Vec<Tensor<4>> + 'a,
    ) -> Vec<Slot> {
        self.push(reads, move |inputs, on_tape| {
            let module = module.clone();
            run(&if on_tape { module } else { module.valid() }, inputs)
        })
    }

    /// The sum of two values.
    pub fn sum(&mut self, a: Slot, b: Slot) -> Slot {
        self.push(&[a, b], |inputs, _| vec![inputs[0].clone() + inputs[1].clone()])[0]
    }

    fn push(&mut self, reads: &[Slot], run: impl Fn(&[Tensor<4>], bool) -> Vec<Tensor<4>> + 'a) -> Vec<Slot> {
        let inputs: Vec<Tensor<4>> = reads.iter().map(|slot| self.value(*slot)).collect();
        let start = self.values.len();
        self.values.extend(run(&inputs, false));
        let writes = start..self.values.len();
        self.segments.push(Segment { reads: reads.to_vec(), writes: writes.clone(), run: Box::new(run) });
        writes.map(Slot).collect()
    }

    /// Gradients of a loss from its gradients at some values (without a tape): those of the `wanted` values, which must have been put in
    /// before the first segment, `None` where the loss does not depend on one; and those of the parameters of `network`, which holds
    /// every segment's module.
    ///
    /// # Panics
    /// When a wanted value is a segment's.
    #[must_use]
    pub fn backward<N: Module>(
        mut self,
        network: &N,
        upstream: Vec<(Slot, Tensor<4>)>,
        wanted: &[Slot],
    ) -> (Vec<Option<Tensor<4>>>, GradientsParams) {
        let mut gradients: Vec<Option<Tensor<4>>> = vec![None; self.values.len()];
        let add = |total: &mut Option<Tensor<4>>, part: Tensor<4>| {
            *total = Some(match total.take() {
                Some(sum) => sum + part,
                None => part,
            });
        };
        for (slot, part) in upstream {
            add(&mut gradients[slot.0], part);
        }
        let mut params = GradientsAccumulator::<N>::new();
        while let Some(Segment { reads, writes, run }) = self.segments.pop() {
            let above: Vec<Option<Tensor<4>>> = gradients.drain(writes.start..).take(writes.len()).collect();
            self.values.truncate(writes.start);
            if above.iter().all(Option::is_none) {
                continue;
            }
            let leaves: Vec<Tensor<4>> =
                reads.iter().map(|slot| Tensor::from_inner(self.value(*slot)).require_grad()).collect();
            let outputs = run(&leaves, true).into_iter().zip(above);
            let terms = outputs.filter_map(|(output, above)| Some((output * Tensor::from_inner(above?)).sum()));
            // A frozen segment that reads nothing has no gradient to give.
            let Some(product) = terms.filter(Tensor::is_tracked).reduce(|sum, term| sum + term) else { continue };
            let mut below = product.backward();
            for (slot, leaf) in reads.iter().zip(&leaves) {
                if let Some(part) = leaf.grad_remove(&mut below) {
                    add(&mut gradients[slot.0], part);
                }
            }
            params.accumulate(network, GradientsParams::from_grads(below, network));
        }
        (wanted.iter().map(|slot| gradients[slot.0].clone()).collect(), params.grads())
    }
}
