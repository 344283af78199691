//! Bilinear resizing of pictures without antialiasing.

use std::borrow::Cow;

use burn::tensor::{Device, Int, Tensor, TensorData};
use rayon::prelude::*;

use crate::fused::{Kernel, fused_1, on_flex, vectorized, write_rows, written};

/// Which source coordinate an output pixel reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelCentres {
    /// `(i + 0.5) · in / out − 0.5`, clamped at 0: PyTorch's `align_corners = False`.
    Half,
    /// `i · in / out`: TensorFlow 1.
    Corner,
}

/// Resizes pictures: linear between the two nearest rows, then columns, whatever the factor.
///
/// # Shapes
/// - images: `[N, C, H, W]`
/// - output: `[N, C, size[0], size[1]]`
///
/// # Panics
/// If the pictures have no pixels.
#[must_use]
pub fn resize_bilinear(images: Tensor<4>, size: [usize; 2], centres: PixelCentres) -> Tensor<4> {
    let [n, c, h, w] = images.dims();
    assert!(h * w > 0, "pictures of {h}x{w}");
    if size == [h, w] {
        return images;
    }
    let axes = [Axis::new(h, size[0], centres), Axis::new(w, size[1], centres)];
    if on_flex(&images) {
        return fused_1(Resize { shape: vec![n, c, size[0], size[1]], source: [h, w], axes }, images);
    }
    let [rows, columns] = axes;
    columns.apply(rows.apply(images, 2), 3)
}

/// For every output pixel along an axis: its lower and upper neighbour and the upper one's share.
#[derive(Debug)]
struct Axis {
    lower: Vec<usize>,
    upper: Vec<usize>,
    share: Vec<f32>,
}

impl Axis {
    fn new(source: usize, length: usize, centres: PixelCentres) -> Self {
        // In f32 as the references do it: the share's rounding is part of their result.
        let scale = source as f32 / length as f32;
        let places = (0..length).map(|at| match centres {
            PixelCentres::Half => ((at as f32 + 0.5) * scale - 0.5).max(0.0),
            PixelCentres::Corner => at as f32 * scale,
        });
        let places: Vec<f32> = places.collect();
        let lower: Vec<usize> = places.iter().map(|&place| (place as usize).min(source - 1)).collect();
        let upper = lower.iter().map(|&lower| (lower + 1).min(source - 1)).collect();
        let share = places.iter().zip(&lower).map(|(place, &lower)| place - lower as f32).collect();
        Self { lower, upper, share }
    }

    fn apply(&self, images: Tensor<4>, axis: usize) -> Tensor<4> {
        let device = images.device();
        let mut shape = [1; 4];
        shape[axis] = self.share.len();
        let share = Tensor::from_data(TensorData::new(self.share.clone(), shape), &device);
        let lower = images.clone().select(axis, index(&self.lower, &device));
        let upper = images.select(axis, index(&self.upper, &device));
        lower.clone() + (upper - lower) * share
    }
}

fn index(values: &[usize], device: &Device) -> Tensor<1, Int> {
    let values: Vec<i64> = values.iter().map(|&value| value as i64).collect();
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}

/// Input: pictures `[N, C, H, W]`.
#[derive(Debug)]
struct Resize {
    shape: Vec<usize>,
    source: [usize; 2],
    /// Rows and columns.
    axes: [Axis; 2],
}

impl Kernel<1> for Resize {
    fn output_shape(&self) -> Vec<usize> {
        self.shape.clone()
    }

    fn forward(&self, [x]: [&[f32]; 1]) -> Vec<f32> {
        let (plane, area) = (self.source[0] * self.source[1], self.shape[2] * self.shape[3]);
        written(self.shape.iter().product(), area, |i, y| {
            let x = &x[i * plane..][..plane];
            let mut row = vec![0.0; self.source[1]];
            write_rows!(y, self.shape[3], (at, y) => {
                self.mix_rows(x, at, &mut row);
                for (i, y) in y.iter_mut().enumerate() {
                    let (lower, upper) = (row[self.axes[1].lower[i]], row[self.axes[1].upper[i]]);
                    y.write(lower + (upper - lower) * self.axes[1].share[i]);
                }
                #[allow(unsafe_code)]
                // SAFETY: the loop wrote every place.
                unsafe {
                    y.assume_init_mut()
                }
            })
        })
    }

    fn backward(&self, _inputs: [&[f32]; 1], upstream: Cow<'_, [f32]>, _wanted: [bool; 1]) -> [Option<Vec<f32>>; 1] {
        let ([height, width], [out_height, out_width]) = (self.source, [self.shape[2], self.shape[3]]);
        let planes = self.shape[0] * self.shape[1];
        let mut dx = vec![0.0; planes * height * width];
        let chunks = dx.par_chunks_mut(height * width).zip(upstream.par_chunks((out_height * out_width).max(1)));
        chunks.for_each(|(dx, upstream)| {
            let mut row = vec![0.0; width];
            for (at, upstream) in upstream.chunks_exact(out_width).enumerate() {
                row.fill(0.0);
                for (i, &upstream) in upstream.iter().enumerate() {
                    let share = self.axes[1].share[i];
                    row[self.axes[1].lower[i]] += upstream * (1.0 - share);
                    row[self.axes[1].upper[i]] += upstream * share;
                }
                let share = self.axes[0].share[at];
                add_scaled(&row, 1.0 - share, &mut dx[self.axes[0].lower[at] * width..][..width]);
                add_scaled(&row, share, &mut dx[self.axes[0].upper[at] * width..][..width]);
            }
        });
        [Some(dx)]
    }
}

impl Resize {
    /// The source row that output row `at` reads, between its two neighbours.
    fn mix_rows(&self, x: &[f32], at: usize, row: &mut [f32]) {
        let width = self.source[1];
        let from = |index: usize| &x[index * width..][..width];
        mix(from(self.axes[0].lower[at]), from(self.axes[0].upper[at]), self.axes[0].share[at], row);
    }
}

vectorized! {
    fn mix[](lower: &[f32], upper: &[f32], share: f32, out: &mut [f32]) {
        for ((out, &lower), &upper) in out.iter_mut().zip(lower).zip(upper) {
            *out = lower + (upper - lower) * share;
        }
    }
}

vectorized! {
    fn add_scaled[](x: &[f32], scale: f32, out: &mut [f32]) {
        for (out, &x) in out.iter_mut().zip(x) {
            *out += x * scale;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::composed_only;

    fn pictures(shape: [usize; 4]) -> Tensor<4> {
        crate::noise::normal(shape, 0.0, 1.0, &Device::flex().autodiff())
    }

    fn values<const D: usize>(x: Tensor<D>) -> Vec<f32> {
        x.into_data().try_to_vec().unwrap()
    }

    #[test]
    fn kernel_equals_the_composition() {
        for (source, size) in [([5, 7], [9, 3]), ([1, 1], [4, 2]), ([6, 8], [6, 5]), ([4, 4], [8, 8]), ([9, 2], [1, 1])]
        {
            for centres in [PixelCentres::Half, PixelCentres::Corner] {
                let x = pictures([2, 3, source[0], source[1]]).require_grad();
                let upstream = pictures([2, 3, size[0], size[1]]);
                let run = || {
                    let y = resize_bilinear(x.clone(), size, centres);
                    let gradients = (y.clone() * upstream.clone()).sum().backward();
                    [values(y), values(x.grad(&gradients).unwrap())]
                };
                let ([y, dx], [composed_y, composed_dx]) = (run(), composed_only(run));
                assert_eq!(y, composed_y, "{source:?} to {size:?}");
                for (a, b) in dx.iter().zip(&composed_dx) {
                    assert!((a - b).abs() <= 1e-5 * (1.0 + b.abs()), "{source:?} to {size:?}: {a} {b}");
                }
            }
        }
    }

    /// The operation is linear, so that central differences are exact up to rounding.
    #[test]
    fn gradient_equals_finite_differences() {
        let x = pictures([1, 1, 3, 4]).require_grad();
        let upstream = pictures([1, 1, 5, 6]);
        let loss = |x: Tensor<4>| (resize_bilinear(x, [5, 6], PixelCentres::Half) * upstream.clone()).sum();
        let exact = values(x.grad(&loss(x.clone()).backward()).unwrap());
        for (i, exact) in exact.into_iter().enumerate() {
            let mut bump = vec![0.0; 12];
            bump[i] = 0.5;
            let bump = Tensor::from_data(TensorData::new(bump, [1, 1, 3, 4]), &x.device());
            let slope =
                loss(x.clone() + bump.clone()).into_scalar::<f32>() - loss(x.clone() - bump).into_scalar::<f32>();
            assert!((exact - slope).abs() < 1e-4, "{i}: {exact} against {slope}");
        }
    }

    #[test]
    fn a_ramp_is_sampled_at_pixel_centres() {
        let ramp = Tensor::<1>::from_floats([0.0, 1.0, 2.0, 3.0], &Device::flex()).reshape([1, 1, 1, 4]);
        let halved = resize_bilinear(ramp.clone(), [1, 2], PixelCentres::Half);
        assert_eq!(values(halved), [0.5, 2.5]);
        assert_eq!(values(resize_bilinear(ramp, [1, 2], PixelCentres::Corner)), [0.0, 2.0]);
    }
}
