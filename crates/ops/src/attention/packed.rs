//! Self-attention straight from the joint projection, with normalised and rotated queries and keys.

use std::borrow::Cow;

use burn::tensor::Tensor;
use rayon::prelude::*;

use super::attention;
use super::core::{Head, attend, attend_backward};
use crate::fused::{Kernel, fused_3, on_flex, sum_of_squares, vectorized};
use crate::product::Matrix;
use crate::{rms_norm, rotary};

/// Multi-head self-attention from one projection of the tokens: queries and keys are RMS-normalised per head, rotated, and
/// [`attention`] follows.
///
/// Heads lie side by side in the channels. The same as [`rms_norm`], [`rotary`] and [`attention`] on rearranged tensors; the CPU kernel
/// reads the projection where it lies.
///
/// # Shapes
/// - qkv: `[B, N, 3·H·D]`, all heads of q, then of k, then of v
/// - query_gain, key_gain: `[D]`
/// - cos, sin: `[H, N, D/2]`, or `[1, N, D/2]` when all heads share them; constants without a gradient
/// - output: `[B, N, H·D]`
///
/// # Panics
/// If the shapes disagree or D is odd.
#[must_use]
pub fn rotary_attention(
    qkv: Tensor<3>,
    [query_gain, key_gain]: [Tensor<1>; 2],
    [cos, sin]: [Tensor<3>; 2],
    heads: usize,
    eps: f32,
) -> Tensor<3> {
    let [b, n, width] = qkv.dims();
    let d = query_gain.dims()[0];
    assert_eq!(width, 3 * heads * d, "the projection holds q, k and v of {heads} heads of width {d}");
    assert_eq!(key_gain.dims(), [d], "one gain per channel of a head");
    assert_eq!(d % 2, 0, "rotary pairs need an even width, got {d}");
    let tables = cos.dims()[0];
    assert!(tables == 1 || tables == heads, "rotary tables for {tables} heads, tokens have {heads}");
    assert_eq!((cos.dims(), sin.dims()), ([tables, n, d / 2], [tables, n, d / 2]), "rotary tables [H or 1, N, D/2]");
    if on_flex(&qkv) {
        let table = |x: Tensor<3>| x.into_data().try_to_vec::<f32>().expect("an f32 tensor");
        let kernel = PackedAttention { batch: b, tokens: n, heads, width: d, cos: table(cos), sin: table(sin), eps };
        return fused_3(kernel, qkv, query_gain, key_gain);
    }
    let qkv = qkv.reshape([b, n, 3, heads, d]).permute([2, 0, 3, 1, 4]);
    let part = |i: usize| qkv.clone().narrow(0, i, 1).reshape([b, heads, n, d]);
    let q = rotary(rms_norm(part(0), query_gain, eps), cos.clone(), sin.clone());
    let k = rotary(rms_norm(part(1), key_gain, eps), cos, sin);
    attention(q, k, part(2), None).swap_dims(1, 2).reshape([b, n, heads * d])
}

/// Inputs: qkv, query gain, key gain.
#[derive(Debug)]
struct PackedAttention {
    batch: usize,
    tokens: usize,
    heads: usize,
    /// Of one head.
    width: usize,
    cos: Vec<f32>,
    sin: Vec<f32>,
    eps: f32,
}

/// Gradients of one head, row-major, and of the gains.
struct Gradients {
    parts: [Vec<f32>; 3],
    gains: [Vec<f32>; 2],
}

impl PackedAttention {
    /// Rotary tables of a head.
    fn tables(&self, head: usize) -> [&[f32]; 2] {
        let length = self.tokens * self.width / 2;
        let at = if self.cos.len() > length { head * length } else { 0 };
        [&self.cos[at..][..length], &self.sin[at..][..length]]
    }

    /// Part 0 (q), 1 (k) or 2 (v) of a head, in place.
    fn part<'a>(&self, qkv: &'a [f32], at: usize, part: usize) -> Matrix<'a> {
        let (b, head) = (at / self.heads, at % self.heads);
        let row = 3 * self.heads * self.width;
        let start = b * self.tokens * row + (part * self.heads + head) * self.width;
        Matrix { data: &qkv[start..], rows: self.tokens, columns: self.width, row_stride: row, column_stride: 1 }
    }

    /// Normalised and rotated queries and keys of a head, `[N, D]` each.
    fn turned(&self, [qkv, query_gain, key_gain]: [&[f32]; 3], at: usize) -> [Vec<f32>; 2] {
        let [cos, sin] = self.tables(at % self.heads);
        [(0, query_gain), (1, key_gain)].map(|(part, gain)| {
            let mut out = vec![0.0; self.tokens * self.width];
            let x = self.part(qkv, at, part);
            normalise_and_rotate(x.data, x.row_stride, gain, cos, sin, self.eps, &mut out);
            out
        })
    }

    fn head<'a>(&self, qkv: &'a [f32], [q, k]: &'a [Vec<f32>; 2], at: usize) -> Head<'a> {
        let matrix = |x: &'a [f32]| Matrix::row_major(x, self.tokens, self.width);
        Head { q: matrix(q), k: matrix(k), v: self.part(qkv, at, 2) }
    }

    fn head_gradients(&self, inputs: [&[f32]; 3], upstream: &[f32], at: usize) -> Gradients {
        let (n, d) = (self.tokens, self.width);
        let turned = self.turned(inputs, at);
        let (b, head) = (at / self.heads, at % self.heads);
        let row = self.heads * d;
        let upstream = &upstream[b * n * row + head * d..];
        let upstream = Matrix { data: upstream, rows: n, columns: d, row_stride: row, column_stride: 1 };
        let through = attend_backward(self.head(inputs[0], &turned, at), &|_| None, 0, n, upstream);
        let [cos, sin] = self.tables(head);
        let back = |part: usize, mut gradient: Vec<f32>| {
            let (x, gain) = (self.part(inputs[0], at, part), inputs[1 + part]);
            let mut gain_gradient = vec![0.0; d];
            let tables = [cos, sin];
            normalise_and_rotate_backward(
                x.data,
                x.row_stride,
                gain,
                tables,
                self.eps,
                &mut gradient,
                &mut gain_gradient,
            );
            (gradient, gain_gradient)
        };
        let ((q, query_gain), (k, key_gain)) = (back(0, through.q), back(1, through.k));
        Gradients { parts: [q, k, through.v], gains: [query_gain, key_gain] }
    }

    /// Copies rows of heads, `[N, D]` each, to `[B, N, parts·H·D]`; `rows(at, part)` gives those of part `part` of head `at`.
    fn interleave<'a>(&self, parts: usize, rows: impl Fn(usize, usize) -> &'a [f32] + Sync) -> Vec<f32> {
        let (n, d) = (self.tokens, self.width);
        let row = parts * self.heads * d;
        let mut out = vec![0.0; self.batch * n * row];
        out.par_chunks_mut((n * row).max(1)).enumerate().for_each(|(b, out)| {
            for column in 0..parts * self.heads {
                let rows = rows(b * self.heads + column % self.heads, column / self.heads);
                for (out, from) in out.chunks_exact_mut(row).zip(rows.chunks_exact(d)) {
                    out[column * d..][..d].copy_from_slice(from);
                }
            }
        });
        out
    }
}

impl Kernel<3> for PackedAttention {
    fn output_shape(&self) -> Vec<usize> {
        vec![self.batch, self.tokens, self.heads * self.width]
    }

    fn forward(&self, inputs: [&[f32]; 3]) -> Vec<f32> {
        let n = self.tokens;
        let heads = (0..self.batch * self.heads).into_par_iter().map(|at| {
            let mut out = vec![0.0; n * self.width];
            attend(self.head(inputs[0], &self.turned(inputs, at), at), &|_| None, 0, n, &mut out);
            out
        });
        let heads: Vec<Vec<f32>> = heads.collect();
        self.interleave(1, |at, _| &heads[at])
    }

    fn backward(&self, inputs: [&[f32]; 3], upstream: Cow<'_, [f32]>, _wanted: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        let heads = 0..self.batch * self.heads;
        let heads: Vec<Gradients> =
            heads.into_par_iter().map(|at| self.head_gradients(inputs, &upstream, at)).collect();
        let gain = |i: usize| {
            let mut total = vec![0.0; self.width];
            for head in &heads {
                total.iter_mut().zip(&head.gains[i]).for_each(|(total, part)| *total += part);
            }
            total
        };
        let qkv = self.interleave(3, |at, part| &heads[at].parts[part]);
        [Some(qkv), Some(gain(0)), Some(gain(1))]
    }
}

vectorized! {
    /// Rows of `x`, `stride` apart, through RMS norm and rotation to the rows of `out`.
    fn normalise_and_rotate[](
        x: &[f32], stride: usize, gain: &[f32], cos: &[f32], sin: &[f32], eps: f32, out: &mut [f32],
    ) {
        let d = gain.len();
        let tables = cos.chunks_exact(d / 2).zip(sin.chunks_exact(d / 2));
        for ((i, out), (cos, sin)) in out.chunks_exact_mut(d).enumerate().zip(tables) {
            let x = &x[i * stride..][..d];
            let scale = 1.0 / (sum_of_squares(x, 0.0) / d as f32 + eps).sqrt();
            let pairs = out.as_chunks_mut::<2>().0.iter_mut().zip(x.as_chunks::<2>().0.iter().zip(gain.as_chunks::<2>().0));
            for ((out, (x, gain)), (&cos, &sin)) in pairs.zip(cos.iter().zip(sin)) {
                let [a, b] = [x[0] * scale * gain[0], x[1] * scale * gain[1]];
                *out = [a * cos - b * sin, a * sin + b * cos];
            }
        }
    }
}

vectorized! {
    /// Turns the gradient of the rotated rows, in place, into that of `x`, and adds to that of the gain.
    ///
    /// With r the scale and h = gain·(gradient turned back): `dx = r·h - x·r³/D·Σ x·h`.
    fn normalise_and_rotate_backward[](
        x: &[f32], stride: usize, gain: &[f32], tables: [&[f32]; 2], eps: f32, gradient: &mut [f32], gain_gradient: &mut [f32],
    ) {
        let d = gain.len();
        let tables = tables[0].chunks_exact(d / 2).zip(tables[1].chunks_exact(d / 2));
        for ((i, gradient), (cos, sin)) in gradient.chunks_exact_mut(d).enumerate().zip(tables) {
            let x = &x[i * stride..][..d];
            let scale = 1.0 / (sum_of_squares(x, 0.0) / d as f32 + eps).sqrt();
            for (pair, (&cos, &sin)) in gradient.as_chunks_mut::<2>().0.iter_mut().zip(cos.iter().zip(sin)) {
                *pair = [pair[0] * cos + pair[1] * sin, pair[1] * cos - pair[0] * sin];
            }
            let mut along = 0.0;
            for ((gradient, total), (&x, &gain)) in gradient.iter_mut().zip(gain_gradient.iter_mut()).zip(x.iter().zip(gain)) {
                *total += *gradient * x * scale;
                *gradient *= gain;
                along += *gradient * x;
            }
            let pull = along * scale * scale * scale / d as f32;
            for (gradient, &x) in gradient.iter_mut().zip(x) {
                *gradient = *gradient * scale - x * pull;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Int};

    use super::*;
    use crate::composed_only;

    fn wave<const R: usize>(shape: [usize; R], phase: f32, device: &Device) -> Tensor<R> {
        let count = shape.iter().product::<usize>() as i64;
        (Tensor::<1, Int>::arange(0..count, device).float() * 0.37 + phase).sin().reshape(shape)
    }

    #[test]
    fn kernel_equals_the_composition() {
        let device = Device::flex().autodiff();
        for (b, n, heads, d, tables) in [(1, 1, 1, 2, 1), (2, 5, 3, 8, 3), (2, 5, 3, 8, 1), (3, 130, 2, 32, 2)] {
            let qkv = wave([b, n, 3 * heads * d], 0.0, &device).require_grad();
            let gains = [1.0, 2.0].map(|phase| (wave([d], phase, &device) + 1.5).detach().require_grad());
            let angles = wave([tables, n, d / 2], 0.3, &device).detach() * 3.0;
            let run = || {
                let turn = [angles.clone().cos(), angles.clone().sin()];
                let y = rotary_attention(qkv.clone() * 2.0, gains.clone(), turn, heads, 1e-6);
                let gradients = (y.clone() * wave(y.dims(), 0.5, &device)).sum().backward();
                let mut all = vec![y.into_data(), qkv.grad(&gradients).unwrap().into_data()];
                all.extend(gains.iter().map(|gain| gain.grad(&gradients).unwrap().into_data()));
                all
            };
            for (fused, composed) in run().into_iter().zip(composed_only(run)) {
                assert_eq!(fused.shape(), composed.shape());
                let values = |data: burn::tensor::TensorData| data.try_to_vec::<f32>().unwrap();
                let (fused, composed) = (values(fused), values(composed));
                // Gradients of the gains are sums over all tokens, which cancel in part.
                let size = composed.iter().fold(1.0_f32, |size, x| size.max(x.abs()));
                for (a, b) in fused.into_iter().zip(composed) {
                    assert!((a - b).abs() <= 2e-5 * size, "{n} tokens: {a} {b}");
                }
            }
        }
    }
}
