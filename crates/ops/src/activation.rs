//! Activations: GELU, exact and by tanh, and SiLU.

use std::borrow::Cow;

use burn::tensor::{Tensor, activation};
use rayon::prelude::*;

use crate::fused::{Blank, Kernel, exp_difference, fused_1, on_flex, vectorized, write_each, written};

/// Exact GELU, `x / 2 · (1 + erf(x / √2))`, elementwise.
///
/// Source: Hendrycks & Gimpel, "Gaussian Error Linear Units". The fused kernel is accurate to 1e-6 relative, also in the
/// negative tail.
///
/// # Shapes
/// - x and output: any, equal
#[must_use]
pub fn gelu<const R: usize>(x: Tensor<R>) -> Tensor<R> {
    if !on_flex(&x) {
        // Not burn's own: its backward pass is that of the tanh approximation, off by up to 5e-4.
        return x.clone() * ((x * std::f64::consts::FRAC_1_SQRT_2).erf() + 1.0) * 0.5;
    }
    fused_1(Activation { shape: x.dims().to_vec(), function: Function::Gelu }, x)
}

/// The tanh approximation of GELU, `x / 2 · (1 + tanh(√(2/π)·(x + 0.044715·x³)))`, elementwise.
///
/// Source: Hendrycks & Gimpel, "Gaussian Error Linear Units". For networks that were trained with it; [`gelu`] differs by up to 5e-4.
///
/// # Shapes
/// - x and output: any, equal
#[must_use]
pub fn gelu_tanh<const R: usize>(x: Tensor<R>) -> Tensor<R> {
    if !on_flex(&x) {
        let cubic = x.clone() * x.clone() * x.clone() * f64::from(CUBIC);
        return x.clone() * activation::sigmoid((x + cubic) * f64::from(TWICE_SLOPE));
    }
    fused_1(Activation { shape: x.dims().to_vec(), function: Function::GeluTanh }, x)
}

/// Coefficient of the cube in [`gelu_tanh`].
const CUBIC: f32 = 0.044_715;
/// 2·√(2/π): `(1 + tanh(u)) / 2` is `sigmoid(2u)`.
const TWICE_SLOPE: f32 = 1.595_769;

/// SiLU, `x · sigmoid(x)`, elementwise.
///
/// # Shapes
/// - x and output: any, equal
#[must_use]
pub fn silu<const R: usize>(x: Tensor<R>) -> Tensor<R> {
    if !on_flex(&x) {
        return activation::silu(x);
    }
    fused_1(Activation { shape: x.dims().to_vec(), function: Function::Silu }, x)
}

#[derive(Debug, Clone, Copy)]
enum Function {
    Gelu,
    GeluTanh,
    Silu,
}

#[derive(Debug)]
struct Activation {
    shape: Vec<usize>,
    function: Function,
}

/// Elements per task.
const CHUNK: usize = 1 << 14;

impl Kernel<1> for Activation {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    fn forward(&self, [x]: [&[f32]; 1]) -> Vec<f32> {
        written(x.len(), CHUNK, |i, y| {
            let x = &x[i * CHUNK..][..y.len()];
            match self.function {
                Function::Gelu => gelu_forward(x, y),
                Function::GeluTanh => gelu_tanh_forward(x, y),
                Function::Silu => silu_forward(x, y),
            }
        })
    }

    fn backward(&self, [x]: [&[f32]; 1], upstream: Cow<'_, [f32]>, _wanted: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let mut gradient = upstream.into_owned();
        gradient.par_chunks_mut(CHUNK).zip(x.par_chunks(CHUNK)).for_each(|(gradient, x)| match self.function {
            Function::Gelu => gelu_backward(x, gradient),
            Function::GeluTanh => gelu_tanh_backward(x, gradient),
            Function::Silu => silu_backward(x, gradient),
        });
        [Some(gradient)]
    }
}

vectorized! {
    fn gelu_forward['a](x: &[f32], y: &'a mut Blank) -> &'a mut [f32] {
        write_each!(y, x in x => x * normal(x).0)
    }
}

vectorized! {
    fn gelu_backward[](x: &[f32], gradient: &mut [f32]) {
        for (gradient, &x) in gradient.iter_mut().zip(x) {
            let (cumulative, density) = normal(x);
            *gradient *= cumulative + x * density;
        }
    }
}

vectorized! {
    fn gelu_tanh_forward['a](x: &[f32], y: &'a mut Blank) -> &'a mut [f32] {
        write_each!(y, x in x => x * sigmoid(TWICE_SLOPE * (x + CUBIC * x * x * x)))
    }
}

vectorized! {
    fn gelu_tanh_backward[](x: &[f32], gradient: &mut [f32]) {
        for (gradient, &x) in gradient.iter_mut().zip(x) {
            let s = sigmoid(TWICE_SLOPE * (x + CUBIC * x * x * x));
            let slope = TWICE_SLOPE * (1.0 + 3.0 * CUBIC * x * x);
            *gradient *= s + x * s * (1.0 - s) * slope;
        }
    }
}

vectorized! {
    fn silu_forward['a](x: &[f32], y: &'a mut Blank) -> &'a mut [f32] {
        write_each!(y, x in x => x * sigmoid(x))
    }
}

vectorized! {
    fn silu_backward[](x: &[f32], gradient: &mut [f32]) {
        for (gradient, &x) in gradient.iter_mut().zip(x) {
            *gradient *= silu_slope(x);
        }
    }
}

/// Cumulative distribution and density of the standard normal distribution.
///
/// The tail is `exp(-x²/2) · t · P(t)` with `t = 1 / (1 + 0.35·|x|)` and a degree-8 minimax polynomial P for |x| ≤ 14,
/// fitted in 40 digits (relative error 6e-8 with these f32 coefficients).
#[inline(always)]
fn normal(x: f32) -> (f32, f32) {
    const TAIL: [f32; 9] = [
        -0.029_679_522,
        0.146_545_83,
        -0.260_961_23,
        0.165_051,
        -0.027_046_608,
        0.107_114_59,
        0.119_444_914,
        0.139_912_29,
        0.139_618_71,
    ];
    /// 1 / √(2π)
    const PEAK: f32 = 0.398_942_3;
    let z = x.abs();
    // z² to more digits than one f32: the upper half of the mantissa squares exactly, the rest is a small correction.
    let coarse = f32::from_bits(z.to_bits() & 0xffff_f000);
    let exponential = exp_difference(-0.5 * coarse * coarse, 0.5 * (z - coarse) * (z + coarse));
    let t = 1.0 / z.mul_add(0.35, 1.0);
    let mut p = TAIL[0];
    for &coefficient in &TAIL[1..] {
        p = p.mul_add(t, coefficient);
    }
    let tail = exponential * (p * t);
    (if x < 0.0 { tail } else { 1.0 - tail }, PEAK * exponential)
}

/// `1 / (1 + exp(-x))`.
#[inline(always)]
pub(crate) fn sigmoid(x: f32) -> f32 {
    let e = exp_difference(-x.abs(), 0.0);
    let small = 1.0 / (1.0 + e);
    if x < 0.0 { e * small } else { small }
}

/// Derivative of SiLU.
#[inline(always)]
pub(crate) fn silu_slope(x: f32) -> f32 {
    let s = sigmoid(x);
    s * (1.0 + x * (1.0 - s))
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;
    use crate::composed_only;

    fn ramp(tape: bool) -> Tensor<2> {
        let values: Vec<f32> = (0..40_001).map(|i| (i as f32 - 20_000.0) * 5e-4).collect();
        let device = Device::flex();
        let device = if tape { device.autodiff() } else { device };
        Tensor::<1>::from_floats(values.as_slice(), &device).reshape([1, 40_001])
    }

    #[test]
    fn normal_distribution_is_accurate() {
        // Φ(-1), Φ(-3), Φ(-5), Φ(-8) and φ at the same points, 17 digits.
        let expected = [
            (-1.0, 0.158_655_253_931_457_05, 0.241_970_724_519_143_37),
            (-3.0, 0.001_349_898_031_630_094_6, 0.004_431_848_411_938_007_5),
            (-5.0, 2.866_515_718_791_939e-7, 1.486_719_514_734_297_9e-6),
            (-8.0, 6.220_960_574_271_785e-16, 5.052_271_083_536_893e-15),
        ];
        for (x, cumulative, density) in expected {
            let (p, d) = normal(x);
            assert!((p as f64 / cumulative - 1.0).abs() < 1e-6, "Φ({x}) = {p:e}");
            assert!((d as f64 / density - 1.0).abs() < 1e-6, "φ({x}) = {d:e}");
            assert!((normal(-x).0 as f64 - (1.0 - cumulative)).abs() < 1e-7);
        }
        assert!((normal(0.0).0 - 0.5).abs() <= f32::EPSILON);
        assert_eq!(normal(-40.0), (0.0, 0.0));
        assert!(normal(f32::NAN).0.is_nan());
    }

    /// burn's own erf is accurate to about 2e-7 absolute.
    #[test]
    fn kernels_equal_the_composition() {
        for function in [gelu::<2>, gelu_tanh::<2>, silu::<2>] {
            let (x, y) = (ramp(true).require_grad(), ramp(true).require_grad());
            let (fused, composed) = (function(x.clone()), composed_only(|| function(y.clone())));
            assert!(fused.clone().all_close(composed.clone(), Some(1e-5), Some(2e-6)));
            let upstream = ramp(true).sin();
            let fused = (fused * upstream.clone()).sum().backward();
            let composed = (composed * upstream).sum().backward();
            let (fused, composed) = (x.grad(&fused).unwrap(), y.grad(&composed).unwrap());
            assert!(fused.all_close(composed, Some(1e-5), Some(3e-6)));
        }
    }

    #[test]
    fn non_contiguous_input() {
        let x = ramp(false).reshape([40_001, 1]).repeat_dim(1, 3);
        let a = gelu(x.clone().transpose()).transpose();
        assert_eq!(a.into_data(), gelu(x).into_data());
    }
}
