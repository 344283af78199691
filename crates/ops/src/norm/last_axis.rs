//! Layer norm and RMS norm over the last axis.

use std::borrow::Cow;

use burn::tensor::Tensor;
use rayon::prelude::*;

use super::moments;
use crate::fused::{
    Blank, Kernel, fused_1, fused_2, fused_3, on_flex, sum, sum_of_products, vectorized, write_each, write_rows,
    written,
};
use crate::mean_dim;

/// Layer norm over the last axis: `(x - mean) / √(variance + eps) · gain + bias`, variance without Bessel's correction.
///
/// # Shapes
/// - x and output: `[.., D]`
/// - gain, bias: `[D]`; absent means 1 and 0
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn layer_norm<const R: usize>(
    x: Tensor<R>,
    gain: Option<Tensor<1>>,
    bias: Option<Tensor<1>>,
    eps: f32,
) -> Tensor<R> {
    check_width(&x, gain.as_ref());
    check_width(&x, bias.as_ref());
    if on_flex(&x) {
        let kernel = LastAxis { shape: x.dims().to_vec(), centred: true, eps };
        return match (gain, bias) {
            (None, None) => fused_1(kernel, x),
            (Some(gain), None) => fused_2(kernel, x, gain),
            (Some(gain), Some(bias)) => fused_3(kernel, x, gain, bias),
            (None, Some(bias)) => fused_1::<R, R>(kernel, x) + bias.unsqueeze(),
        };
    }
    let centred = x.clone() - mean_dim(x, R - 1);
    let variance = mean_dim(centred.clone().square(), R - 1);
    let normed = centred / (variance + eps).sqrt();
    let scaled = match gain {
        Some(gain) => normed * gain.unsqueeze(),
        None => normed,
    };
    match bias {
        Some(bias) => scaled + bias.unsqueeze(),
        None => scaled,
    }
}

/// RMS norm over the last axis: `x / √(mean(x²) + eps) · gain`.
///
/// # Shapes
/// - x and output: `[.., D]`
/// - gain: `[D]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn rms_norm<const R: usize>(x: Tensor<R>, gain: Tensor<1>, eps: f32) -> Tensor<R> {
    check_width(&x, Some(&gain));
    if on_flex(&x) {
        return fused_2(LastAxis { shape: x.dims().to_vec(), centred: false, eps }, x, gain);
    }
    let square = mean_dim(x.clone().square(), R - 1);
    x / (square + eps).sqrt() * gain.unsqueeze()
}

fn check_width<const R: usize>(x: &Tensor<R>, parameter: Option<&Tensor<1>>) {
    if let Some(parameter) = parameter {
        assert_eq!(parameter.dims()[0], x.dims()[R - 1], "one parameter per channel of the last axis");
    }
}

/// Inputs: x, then gain, then bias, as many as the operation has.
#[derive(Debug)]
pub(super) struct LastAxis {
    pub shape: Vec<usize>,
    /// Whether the mean is subtracted.
    pub centred: bool,
    pub eps: f32,
}

/// Rows per task. Fixed, because the gradients of gain and bias are summed per task.
pub(super) const ROWS: usize = 64;

impl LastAxis {
    /// Width of a row, at least 1 so that empty tensors need no case of their own.
    fn width(&self) -> usize {
        self.shape.last().copied().unwrap_or(1).max(1)
    }
}

impl<const N: usize> Kernel<N> for LastAxis {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    fn forward(&self, inputs: [&[f32]; N]) -> Vec<f32> {
        let chunk = ROWS * self.width();
        let (gain, bias) = (inputs.get(1).copied(), inputs.get(2).copied());
        written(inputs[0].len(), chunk, |i, y| forward_rows(self, &inputs[0][i * chunk..][..y.len()], gain, bias, y))
    }

    fn backward(&self, inputs: [&[f32]; N], upstream: Cow<'_, [f32]>, wanted: [bool; N]) -> [Option<Vec<f32>>; N] {
        let width = self.width();
        let gain = inputs.get(1).copied();
        let mut dx = upstream.into_owned();
        let chunks = dx.par_chunks_mut(ROWS * width).zip(inputs[0].par_chunks(ROWS * width));
        let parts: Vec<_> = chunks.map(|(dx, x)| backward_rows(self, x, gain, dx)).collect();
        let mut gradients = [const { None }; N];
        let totals = in_order(parts, 2 * width);
        for (i, (gradient, wanted)) in gradients.iter_mut().zip(wanted).enumerate() {
            *gradient = match i {
                _ if !wanted => None,
                0 => Some(std::mem::take(&mut dx)),
                i => Some(totals[(i - 1) * width..][..width].to_vec()),
            };
        }
        gradients
    }
}

/// The sum of vectors of `length` numbers, one after another.
pub(super) fn in_order(parts: Vec<Vec<f32>>, length: usize) -> Vec<f32> {
    let sum = parts.into_iter().reduce(|mut total, part| {
        total.iter_mut().zip(part).for_each(|(total, part)| *total += part);
        total
    });
    sum.unwrap_or_else(|| vec![0.0; length])
}

vectorized! {
    pub(super) fn forward_rows['a](
        kernel: &LastAxis,
        x: &[f32],
        gain: Option<&[f32]>,
        bias: Option<&[f32]>,
        y: &'a mut Blank,
    ) -> &'a mut [f32] {
        let width = kernel.width();
        write_rows!(y, width, (i, y) => {
            let x = &x[i * width..][..width];
            let (mean, variance) = moments(x, kernel.centred);
            let scale = 1.0 / (variance + kernel.eps).sqrt();
            match (gain, bias) {
                (Some(gain), Some(bias)) => {
                    write_each!(y, x in x, gain in gain, bias in bias => (x - mean) * scale * gain + bias)
                }
                (Some(gain), None) => write_each!(y, x in x, gain in gain => (x - mean) * scale * gain),
                (None, _) => write_each!(y, x in x => (x - mean) * scale),
            }
        })
    }
}

vectorized! {
    /// Turns the upstream gradient into that of x, in place, and returns the sums over these rows of the gradients of gain and bias, one after
    /// the other.
    pub(super) fn backward_rows[](kernel: &LastAxis, x: &[f32], gain: Option<&[f32]>, gradient: &mut [f32]) -> Vec<f32> {
        let width = kernel.width();
        let mut parameters = vec![0.0; 2 * width];
        let (gain_sum, bias_sum) = parameters.split_at_mut(width);
        let mut normed = vec![0.0; width];
        for (gradient, x) in gradient.chunks_exact_mut(width).zip(x.chunks_exact(width)) {
            let (mean, variance) = moments(x, kernel.centred);
            let scale = 1.0 / (variance + kernel.eps).sqrt();
            for (normed, &x) in normed.iter_mut().zip(x) {
                *normed = (x - mean) * scale;
            }
            if let Some(gain) = gain {
                let sums = gain_sum.iter_mut().zip(bias_sum.iter_mut());
                for (((gradient, &normed), &gain), sums) in gradient.iter_mut().zip(&normed).zip(gain).zip(sums) {
                    *sums.0 += *gradient * normed;
                    *sums.1 += *gradient;
                    *gradient *= gain;
                }
            }
            let along = sum_of_products(gradient, &normed) / width as f32;
            let shift = if kernel.centred { sum(gradient) / width as f32 } else { 0.0 };
            for (gradient, &normed) in gradient.iter_mut().zip(&normed) {
                *gradient = (*gradient - shift - normed * along) * scale;
            }
        }
        parameters
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::composed_only;

    fn random<const R: usize>(shape: [usize; R], device: &Device) -> Tensor<R> {
        crate::noise::normal(shape, 0.3, 1.5, device)
    }

    /// Both sides sum some hundred products in f32.
    fn assert_equal<const R: usize>(a: Tensor<R>, b: Tensor<R>) {
        assert!(a.clone().all_close(b.clone(), Some(1e-5), Some(2e-5)), "{a} against {b}");
    }

    #[test]
    fn kernels_equal_the_composition() {
        let device = Device::flex().autodiff();
        for (rows, width) in [(3, 1), (5, 24), (150, 33), (130, 128)] {
            let x = random([rows, 2, width], &device).require_grad();
            let gain = random([width], &device).require_grad();
            let bias = random([width], &device).require_grad();
            let upstream = random([rows, 2, width], &device);
            for case in 0..5 {
                let (g, b) = (gain.clone(), bias.clone());
                let norm = |x: Tensor<3>| match case {
                    0 => layer_norm(x, None, None, 1e-6),
                    1 => layer_norm(x, Some(g.clone()), None, 1e-6),
                    2 => layer_norm(x, Some(g.clone()), Some(b.clone()), 1e-5),
                    3 => layer_norm(x, None, Some(b.clone()), 1e-5),
                    _ => rms_norm(x, g.clone(), 1e-6),
                };
                let (fused, composed) = (norm(x.clone()), composed_only(|| norm(x.clone())));
                assert_equal(fused.clone(), composed.clone());
                let fused = (fused * upstream.clone()).sum().backward();
                let composed = (composed * upstream.clone()).sum().backward();
                // A row of one channel has variance 0: its gradient is 0 times 1/√eps, pure rounding.
                if width > 1 {
                    assert_equal(x.grad(&fused).unwrap(), x.grad(&composed).unwrap());
                }
                for parameter in [&gain, &bias] {
                    match (parameter.grad(&fused), parameter.grad(&composed)) {
                        (Some(fused), Some(composed)) => {
                            assert!(fused.all_close(composed, Some(1e-5), Some(1e-4)));
                        }
                        (None, None) => {}
                        _ => panic!("only one of the two has a gradient in case {case}"),
                    }
                }
            }
        }
    }

    #[test]
    fn normalised_rows_have_mean_0_and_variance_1() {
        let y = layer_norm(random([40, 64], &Device::flex()) + 100.0, None, None, 0.0);
        let mean = mean_dim(y.clone(), 1).abs().max().into_scalar::<f32>();
        let variance = (mean_dim(y.square(), 1) - 1.0).abs().max().into_scalar::<f32>();
        // Inputs near 100 have an absolute rounding error of 4e-6.
        assert!(mean < 2e-5 && variance < 2e-5, "mean {mean:e}, variance off by {variance:e}");
    }
}
