//! Group norm, alone and followed by SiLU.

use std::borrow::Cow;

use burn::tensor::{Tensor, activation};
use rayon::prelude::*;

use super::moments;
use crate::activation::{sigmoid, silu_slope};
use crate::fused::{
    Blank, Kernel, fused_3, on_flex, sum, sum_of_products, vectorized, write_each, write_rows, written,
};
use crate::mean_dim;

/// Group norm: mean and variance over each group of channels and all positions, gain and bias per channel.
///
/// Source: Wu & He, "Group Normalization".
///
/// # Shapes
/// - x and output: `[N, C, ..]`
/// - gain, bias: `[C]`
///
/// # Panics
/// If `groups` does not divide C or the shapes disagree.
#[must_use]
pub fn group_norm<const R: usize>(
    x: Tensor<R>,
    groups: usize,
    gain: Tensor<1>,
    bias: Tensor<1>,
    eps: f32,
) -> Tensor<R> {
    apply(x, groups, gain, bias, eps, false)
}

/// [`group_norm`] followed by SiLU.
///
/// # Shapes
/// - x and output: `[N, C, ..]`
/// - gain, bias: `[C]`
///
/// # Panics
/// As [`group_norm`].
#[must_use]
pub fn group_norm_silu<const R: usize>(
    x: Tensor<R>,
    groups: usize,
    gain: Tensor<1>,
    bias: Tensor<1>,
    eps: f32,
) -> Tensor<R> {
    apply(x, groups, gain, bias, eps, true)
}

fn apply<const R: usize>(
    x: Tensor<R>,
    groups: usize,
    gain: Tensor<1>,
    bias: Tensor<1>,
    eps: f32,
    silu: bool,
) -> Tensor<R> {
    let dims = x.dims();
    let [n, c] = [dims[0], dims[1]];
    assert!(groups > 0 && c % groups == 0, "{groups} groups do not divide {c} channels");
    assert_eq!((gain.dims(), bias.dims()), ([c], [c]), "gain and bias [C]");
    let area: usize = dims[2..].iter().product();
    if on_flex(&x) {
        return fused_3(Group { shape: dims.to_vec(), groups, channels: c, area, eps, silu }, x, gain, bias);
    }
    let rows = x.reshape([n * groups, c / groups * area]);
    let centred = rows.clone() - mean_dim(rows, 1);
    let variance = mean_dim(centred.clone().square(), 1);
    let normed = (centred / (variance + eps).sqrt()).reshape([n, c, area]);
    let y = (normed * gain.reshape([1, c, 1]) + bias.reshape([1, c, 1])).reshape(dims);
    if silu { activation::silu(y) } else { y }
}

/// Inputs: x `[N, C, ..]`, gain `[C]`, bias `[C]`.
#[derive(Debug)]
struct Group {
    shape: Vec<usize>,
    groups: usize,
    channels: usize,
    /// Positions per channel.
    area: usize,
    eps: f32,
    silu: bool,
}

impl Group {
    /// Channels per group.
    fn depth(&self) -> usize {
        self.channels / self.groups
    }

    /// Elements of one group of one item, at least 1 so that empty tensors need no case of their own.
    fn row(&self) -> usize {
        (self.depth() * self.area).max(1)
    }
}

impl Kernel<3> for Group {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    fn forward(&self, [x, gain, bias]: [&[f32]; 3]) -> Vec<f32> {
        let length = self.row();
        written(x.len(), length, |row, y| {
            let first = row % self.groups * self.depth();
            let (gain, bias) = (&gain[first..][..self.depth()], &bias[first..][..self.depth()]);
            forward_group(self, &x[row * length..][..length], gain, bias, y)
        })
    }

    fn backward(
        &self,
        [x, gain, bias]: [&[f32]; 3],
        upstream: Cow<'_, [f32]>,
        wanted: [bool; 3],
    ) -> [Option<Vec<f32>>; 3] {
        let mut dx = upstream.into_owned();
        let rows = dx.par_chunks_mut(self.row()).zip(x.par_chunks(self.row()));
        let parts = rows.enumerate().map(|(row, (dx, x))| {
            let first = row % self.groups * self.depth();
            let (gain, bias) = (&gain[first..][..self.depth()], &bias[first..][..self.depth()]);
            backward_group(self, x, gain, bias, dx)
        });
        let parts: Vec<Vec<[f32; 2]>> = parts.collect();
        // Summed over the batch in order.
        let mut parameters = vec![[0.0f32; 2]; self.channels];
        for (row, part) in parts.iter().enumerate() {
            let first = row % self.groups * self.depth();
            for (total, part) in parameters[first..].iter_mut().zip(part) {
                *total = [total[0] + part[0], total[1] + part[1]];
            }
        }
        let of = |which: usize| parameters.iter().map(|pair| pair[which]).collect();
        [wanted[0].then_some(dx), wanted[1].then(|| of(0)), wanted[2].then(|| of(1))]
    }
}

vectorized! {
    fn forward_group['a](kernel: &Group, x: &[f32], gain: &[f32], bias: &[f32], y: &'a mut Blank) -> &'a mut [f32] {
        let (mean, variance) = moments(x, true);
        let scale = 1.0 / (variance + kernel.eps).sqrt();
        write_rows!(y, kernel.area, (j, y) => {
            let (x, gain, bias) = (&x[j * kernel.area..][..kernel.area], gain[j], bias[j]);
            let y = write_each!(y, x in x => (x - mean) * scale * gain + bias);
            if kernel.silu {
                for y in y.iter_mut() {
                    *y *= sigmoid(*y);
                }
            }
            y
        })
    }
}

vectorized! {
    /// Turns the upstream gradient into that of x, in place, and returns the gradients of (gain, bias) of the group's channels for this item.
    fn backward_group[](
        kernel: &Group,
        x: &[f32],
        gain: &[f32],
        bias: &[f32],
        dx: &mut [f32],
    ) -> Vec<[f32; 2]> {
        let (mean, variance) = moments(x, true);
        let scale = 1.0 / (variance + kernel.eps).sqrt();
        let mut normed = vec![0.0; kernel.area];
        let mut parameters = vec![[0.0f32; 2]; gain.len()];
        let (mut shift, mut along) = (0.0f64, 0.0f64);
        for (j, parameters) in parameters.iter_mut().enumerate() {
            let range = j * kernel.area..(j + 1) * kernel.area;
            let dx = &mut dx[range.clone()];
            for (normed, &x) in normed.iter_mut().zip(&x[range]) {
                *normed = (x - mean) * scale;
            }
            if kernel.silu {
                for (dx, &normed) in dx.iter_mut().zip(&normed) {
                    *dx *= silu_slope(normed * gain[j] + bias[j]);
                }
            }
            *parameters = [sum_of_products(dx, &normed), sum(dx)];
            along += (parameters[0] * gain[j]) as f64;
            shift += (parameters[1] * gain[j]) as f64;
        }
        let count = x.len() as f64;
        let (along, shift) = ((along / count) as f32, (shift / count) as f32);
        for (j, &gain) in gain.iter().enumerate() {
            let range = j * kernel.area..(j + 1) * kernel.area;
            for (dx, &x) in dx[range.clone()].iter_mut().zip(&x[range]) {
                *dx = (*dx * gain - shift - (x - mean) * scale * along) * scale;
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

    #[test]
    fn kernel_equals_the_composition_in_rank_4_and_5() {
        let device = Device::flex().autodiff();
        let random = |shape: [usize; 4]| crate::noise::normal::<4>(shape, 0.3, 1.5, &device);
        for (shape, groups) in [([2, 6, 3, 5], 3), ([3, 8, 7, 16], 2), ([1, 4, 1, 1], 1)] {
            let x = random(shape).require_grad();
            let upstream = random(shape);
            let parameter = |_| crate::noise::normal::<1>([shape[1]], 0.5, 1.0, &device).require_grad();
            let [gain, bias] = [0, 1].map(parameter);
            for silu in [false, true] {
                let norm = |x: Tensor<4>| apply(x, groups, gain.clone(), bias.clone(), 1e-5, silu);
                let (fused, composed) = (norm(x.clone()), composed_only(|| norm(x.clone())));
                assert!(fused.clone().all_close(composed.clone(), Some(1e-5), Some(1e-5)));
                let fused = (fused * upstream.clone()).sum().backward();
                let composed = (composed * upstream.clone()).sum().backward();
                let (a, b) = (x.grad(&fused).unwrap(), x.grad(&composed).unwrap());
                assert!(a.clone().all_close(b.clone(), Some(1e-5), Some(2e-5)), "{a} against {b}");
                for parameter in [&gain, &bias] {
                    let (a, b) = (parameter.grad(&fused).unwrap(), parameter.grad(&composed).unwrap());
                    assert!(a.all_close(b, Some(1e-5), Some(1e-4)));
                }
            }
            let [n, c, h, w] = shape;
            let flat = group_norm(x.clone(), groups, gain.clone(), bias.clone(), 1e-5);
            let deep = group_norm(x.reshape([n, c, 1, h, w]), groups, gain, bias, 1e-5);
            assert_eq!(flat.reshape([n, c, 1, h, w]).into_data(), deep.into_data());
        }
    }
}
