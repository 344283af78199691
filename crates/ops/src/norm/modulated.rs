//! Layer norm whose gain and bias belong to the sample: the modulation of adaLN.

use std::borrow::Cow;

use burn::tensor::Tensor;
use rayon::prelude::*;

use super::last_axis::{LastAxis, ROWS, backward_rows, forward_rows, in_order};
use super::layer_norm;
use crate::fused::{Kernel, fused_3, on_flex, written_in_parts};

/// `LN(x)·(1 + scale) + shift`, the norm without parameters of its own.
///
/// Source: Peebles & Xie, "Scalable Diffusion Models with Transformers", section 3.2.
///
/// # Shapes
/// - x and output: `[B, N, D]`
/// - shift, scale: `[B, 1, D]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn modulated_layer_norm(x: Tensor<3>, shift: Tensor<3>, scale: Tensor<3>, eps: f32) -> Tensor<3> {
    let [b, n, d] = x.dims();
    assert_eq!((shift.dims(), scale.dims()), ([b, 1, d], [b, 1, d]), "shift and scale [B, 1, D]");
    if on_flex(&x) {
        let norm = LastAxis { shape: vec![b, n, d], centred: true, eps };
        return fused_3(Modulated { norm, tokens: n, width: d }, x, shift, scale);
    }
    layer_norm(x, None, None, eps) * (scale + 1.0) + shift
}

/// Inputs: x, shift, scale.
#[derive(Debug)]
struct Modulated {
    norm: LastAxis,
    tokens: usize,
    width: usize,
}

impl Modulated {
    fn gain(&self, scale: &[f32], sample: usize) -> Vec<f32> {
        scale[sample * self.width..][..self.width].iter().map(|scale| 1.0 + scale).collect()
    }

    /// Numbers of one sample and of a task, at least 1 so that empty tensors need no case of their own.
    fn sizes(&self) -> [usize; 2] {
        [self.tokens * self.width, ROWS * self.width].map(|size| size.max(1))
    }
}

impl Kernel<3> for Modulated {
    fn output_shape(&self) -> Vec<usize> {
        self.norm.shape.clone()
    }

    fn forward(&self, [x, shift, scale]: [&[f32]; 3]) -> Vec<f32> {
        let [sample, task] = self.sizes();
        written_in_parts(x.len(), sample, task, |b, i, y| {
            let x = &x[b * sample + i * task..][..y.len()];
            let shift = &shift[b * self.width..][..self.width];
            forward_rows(&self.norm, x, Some(&self.gain(scale, b)), Some(shift), y)
        })
    }

    fn backward(
        &self,
        [x, _, scale]: [&[f32]; 3],
        upstream: Cow<'_, [f32]>,
        wanted: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let [sample, task] = self.sizes();
        let mut gradient = upstream.into_owned();
        let samples = gradient.par_chunks_mut(sample).zip(x.par_chunks(sample)).enumerate();
        let sums = samples.map(|(b, (gradient, x))| {
            let gain = self.gain(scale, b);
            let tasks = gradient.par_chunks_mut(task).zip(x.par_chunks(task));
            let parts = tasks.map(|(gradient, x)| backward_rows(&self.norm, x, Some(&gain), gradient));
            in_order(parts.collect(), 2 * self.width)
        });
        let mut sums: Vec<Vec<f32>> = sums.collect();
        // A sample without tokens.
        sums.resize(self.norm.shape[0], vec![0.0; 2 * self.width]);
        let of =
            |at: usize| sums.iter().flat_map(|sums| sums[at * self.width..][..self.width].iter().copied()).collect();
        [wanted[0].then_some(gradient), wanted[1].then(|| of(1)), wanted[2].then(|| of(0))]
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
        for [b, n, d] in [[1, 1, 24], [2, 70, 33], [3, 128, 16], [2, 0, 8]] {
            let random = |shape| crate::noise::normal::<3>(shape, 0.3, 1.5, &device);
            let inputs = [[b, n, d], [b, 1, d], [b, 1, d]].map(|shape| random(shape).require_grad());
            let upstream = random([b, n, d]);
            let run = || {
                let [x, shift, scale] = inputs.clone();
                let y = modulated_layer_norm(x, shift, scale, 1e-6);
                let gradients = (y.clone() * upstream.clone()).sum().backward();
                let mut all = vec![y.into_data()];
                all.extend(inputs.iter().map(|input| input.grad(&gradients).unwrap().into_data()));
                all
            };
            let fused = run();
            if n == 0 {
                let sizes = fused.iter().map(|data| data.try_to_vec::<f32>().unwrap());
                assert_eq!(sizes.collect::<Vec<_>>(), [vec![], vec![], vec![0.0; b * d], vec![0.0; b * d]]);
                continue;
            }
            for (i, (fused, composed)) in fused.into_iter().zip(composed_only(run)).enumerate() {
                assert_eq!(fused.shape(), composed.shape());
                let values = |data: burn::tensor::TensorData| data.try_to_vec::<f32>().unwrap();
                for (a, b) in values(fused).into_iter().zip(values(composed)) {
                    assert!((a - b).abs() <= 3e-5 * (1.0 + b.abs()), "{i}: {a} {b}");
                }
            }
        }
    }
}
