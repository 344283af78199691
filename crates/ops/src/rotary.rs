//! Rotary position embedding on adjacent channel pairs.

use std::borrow::Cow;

use burn::tensor::Tensor;
use rayon::prelude::*;

use crate::fused::{Kernel, fused_1, on_flex, vectorized};

/// Rotates the channel pairs (2i, 2i + 1) of every token: `(a, b) → (a·cos - b·sin, a·sin + b·cos)`.
///
/// Source: Su et al., "RoFormer", section 3.4. The tables are constants and get no gradient.
///
/// # Shapes
/// - x and output: `[B, M, N, D]`
/// - cos, sin: `[M, N, D/2]`, or `[1, N, D/2]` when all heads share them
///
/// # Panics
/// If D is odd or the shapes disagree.
#[must_use]
pub fn rotary(x: Tensor<4>, cos: Tensor<3>, sin: Tensor<3>) -> Tensor<4> {
    let [b, m, n, d] = x.dims();
    assert_eq!(d % 2, 0, "rotary pairs need an even width, got {d}");
    let heads = cos.dims()[0];
    assert!(heads == 1 || heads == m, "rotary tables for {heads} heads, tokens have {m}");
    assert_eq!((cos.dims(), sin.dims()), ([heads, n, d / 2], [heads, n, d / 2]), "rotary tables [M or 1, N, D/2]");
    if on_flex(&x) {
        let table = |x: Tensor<3>| x.into_data().try_to_vec::<f32>().expect("an f32 tensor");
        return fused_1(Rotation { shape: [b, m, n, d], cos: table(cos), sin: table(sin) }, x);
    }
    let pairs = x.reshape([b, m, n * d / 2, 2]);
    let cos = cos.detach().reshape([1, heads, n * d / 2, 1]);
    let sin = sin.detach().reshape([1, heads, n * d / 2, 1]);
    let first = pairs.clone().narrow(3, 0, 1);
    let second = pairs.narrow(3, 1, 1);
    let rotated_first = first.clone() * cos.clone() - second.clone() * sin.clone();
    let rotated_second = first * sin + second * cos;
    Tensor::cat(vec![rotated_first, rotated_second], 3).reshape([b, m, n, d])
}

/// Rotates `[B, M, N, D]` by tables `[M or 1, N, D/2]`; going back, by the opposite angle.
#[derive(Debug)]
struct Rotation {
    shape: [usize; 4],
    cos: Vec<f32>,
    sin: Vec<f32>,
}

impl Kernel<1> for Rotation {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.to_vec()
    }

    fn forward(&self, [x]: [&[f32]; 1]) -> Vec<f32> {
        self.rotate(x, 1.0)
    }

    fn backward(&self, _inputs: [&[f32]; 1], upstream: Cow<'_, [f32]>, _wanted: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        [Some(self.rotate(&upstream, -1.0))]
    }
}

impl Rotation {
    fn rotate(&self, x: &[f32], direction: f32) -> Vec<f32> {
        let [_, m, n, d] = self.shape;
        let heads = self.cos.len() / (n * d / 2).max(1);
        let mut y = vec![0.0; x.len()];
        let slices = y.par_chunks_mut((n * d).max(1)).zip(x.par_chunks((n * d).max(1))).enumerate();
        slices.for_each(|(slice, (y, x))| {
            let at = slice % m % heads * (n * d / 2);
            rotate_pairs(x, &self.cos[at..][..n * d / 2], &self.sin[at..][..n * d / 2], direction, y);
        });
        y
    }
}

vectorized! {
    fn rotate_pairs[](x: &[f32], cos: &[f32], sin: &[f32], direction: f32, y: &mut [f32]) {
        let pairs = y.as_chunks_mut::<2>().0.iter_mut().zip(x.as_chunks::<2>().0);
        for ((y, x), (&cos, &sin)) in pairs.zip(cos.iter().zip(sin)) {
            let sin = sin * direction;
            *y = [x[0] * cos - x[1] * sin, x[0] * sin + x[1] * cos];
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Tensor};

    use super::rotary;
    use crate::composed_only;

    fn ramp<const R: usize>(shape: [usize; R], device: &Device) -> Tensor<R> {
        Tensor::<1, burn::tensor::Int>::arange(0..shape.iter().product::<usize>() as i64, device)
            .float()
            .reshape(shape)
            .sin()
    }

    #[test]
    fn kernel_equals_the_composition_with_shared_and_own_tables() {
        let device = Device::flex().autodiff();
        for heads in [1, 3] {
            let x = ramp([2, 3, 5, 8], &device).require_grad();
            let angles = ramp([heads, 5, 4], &device) * 3.0;
            let turn = |x: Tensor<4>| rotary(x, angles.clone().cos(), angles.clone().sin());
            let (fused, composed) = (turn(x.clone()), composed_only(|| turn(x.clone())));
            assert!(fused.clone().all_close(composed.clone(), Some(0.0), Some(1e-6)));
            let upstream = ramp([2, 3, 5, 8], &device).cos();
            let fused = x.grad(&(fused * upstream.clone()).sum().backward()).unwrap();
            let composed = x.grad(&(composed * upstream).sum().backward()).unwrap();
            assert!(fused.all_close(composed, Some(0.0), Some(1e-6)));
        }
    }

    #[test]
    fn quarter_turn() {
        let device = Device::flex();
        let x = Tensor::<1>::from_floats([1.0, 2.0, 3.0, 4.0], &device).reshape([1, 1, 1, 4]);
        let (cos, sin) = (Tensor::zeros([1, 1, 2], &device), Tensor::ones([1, 1, 2], &device));
        let turned = rotary(x, cos, sin).into_data().try_to_vec::<f32>().unwrap();
        assert_eq!(turned, [-2.0, 1.0, -4.0, 3.0]);
    }
}
