//! Softmax over the last axis.

use std::borrow::Cow;

use burn::tensor::{Tensor, activation};
use rayon::prelude::*;

use crate::fused::{
    Blank, Kernel, exp_difference, fused_1, largest, on_flex, sum, sum_of_products, vectorized, write_each, write_rows,
    written,
};

/// Softmax over the last axis: `exp(x - max) / Σ exp(x - max)`.
///
/// # Shapes
/// - x and output: `[.., D]`
#[must_use]
pub fn softmax<const R: usize>(x: Tensor<R>) -> Tensor<R> {
    if !on_flex(&x) {
        return activation::softmax(x, R - 1);
    }
    fused_1(Softmax { shape: x.dims().to_vec() }, x)
}

#[derive(Debug)]
struct Softmax {
    shape: Vec<usize>,
}

/// Elements per task, about.
const CHUNK: usize = 1 << 13;

impl Softmax {
    /// Width of a row and elements of a task, at least 1 so that empty tensors need no case of their own.
    fn sizes(&self) -> (usize, usize) {
        let width = self.shape.last().copied().unwrap_or(1).max(1);
        (width, width * CHUNK.div_ceil(width))
    }
}

impl Kernel<1> for Softmax {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    fn forward(&self, [x]: [&[f32]; 1]) -> Vec<f32> {
        let (width, chunk) = self.sizes();
        written(x.len(), chunk, |i, y| forward_rows(&x[i * chunk..][..y.len()], width, y))
    }

    fn backward(&self, [x]: [&[f32]; 1], upstream: Cow<'_, [f32]>, _wanted: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let (width, chunk) = self.sizes();
        let mut gradient = upstream.into_owned();
        let chunks = gradient.par_chunks_mut(chunk).zip(x.par_chunks(chunk));
        chunks.for_each(|(gradient, x)| backward_rows(x, width, gradient));
        [Some(gradient)]
    }
}

/// Writes the probabilities of one row.
#[inline(always)]
fn probabilities<'a>(x: &[f32], y: &'a mut Blank) -> &'a mut [f32] {
    let largest = largest(x);
    let y = write_each!(y, x in x => exp_difference(x - largest, 0.0));
    let scale = 1.0 / sum(y);
    for y in y.iter_mut() {
        *y *= scale;
    }
    y
}

vectorized! {
    fn forward_rows['a](x: &[f32], width: usize, y: &'a mut Blank) -> &'a mut [f32] {
        write_rows!(y, width, (i, y) => probabilities(&x[i * width..][..width], y))
    }
}

vectorized! {
    /// `y·(g - Σ g·y)` in the place of g, the probabilities y computed again rather than kept.
    fn backward_rows[](x: &[f32], width: usize, gradient: &mut [f32]) {
        let mut y = Box::<[f32]>::new_uninit_slice(width);
        for (gradient, x) in gradient.chunks_exact_mut(width).zip(x.chunks_exact(width)) {
            let y = probabilities(x, &mut y);
            let mean = sum_of_products(y, gradient);
            for (gradient, &y) in gradient.iter_mut().zip(y.iter()) {
                *gradient = y * (*gradient - mean);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::composed_only;

    #[test]
    fn kernel_equals_the_composition() {
        let device = Device::flex().autodiff();
        for width in [1, 9, 64, 100] {
            let random = || crate::noise::normal::<3>([3, 50, width], 0.0, 4.0, &device);
            let (x, upstream) = (random().require_grad(), random());
            let (fused, composed) = (softmax(x.clone()), composed_only(|| softmax(x.clone())));
            assert!(fused.clone().all_close(composed.clone(), Some(1e-6), Some(1e-6)));
            let fused = x.grad(&(fused * upstream.clone()).sum().backward()).unwrap();
            let composed = x.grad(&(composed * upstream).sum().backward()).unwrap();
            // Differences of upstream values up to 16, so that rounding alone comes to 16 · 1e-7 a term.
            assert!(fused.all_close(composed, Some(1e-5), Some(1e-5)));
        }
    }

    #[test]
    fn large_and_masked_scores() {
        let x = Tensor::<2>::from_floats([[1000.0, 1000.0, -1e30], [f32::NEG_INFINITY, 0.0, -200.0]], &Device::flex());
        let y = softmax(x).into_data().try_to_vec::<f32>().unwrap();
        assert_eq!(y, [0.5, 0.5, 0.0, 0.0, 1.0, 0.0]);
        let nan = Tensor::<2>::from_floats([[f32::NAN, 0.0]], &Device::flex());
        assert!(softmax(nan).into_data().try_to_vec::<f32>().unwrap().iter().all(|y| y.is_nan()));
    }
}
