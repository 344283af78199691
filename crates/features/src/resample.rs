//! Bilinear resizing without antialiasing, as the feature networks' reference programs do it before they look.

use burn::tensor::{Device, Int, Tensor, TensorData};

/// Which source coordinate an output pixel reads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelCentres {
    /// `(i + 0.5) · in / out − 0.5`, clamped at 0: PyTorch's `align_corners = False`.
    Half,
    /// `i · in / out`: TensorFlow 1.
    Corner,
}

/// # Shapes
/// - images: `[N, C, H, W]`
/// - output: `[N, C, size[0], size[1]]`
#[must_use]
pub fn resize_bilinear(images: Tensor<4>, size: [usize; 2], centres: PixelCentres) -> Tensor<4> {
    resize_axis(resize_axis(images, 2, size[0], centres), 3, size[1], centres)
}

fn resize_axis(images: Tensor<4>, axis: usize, length: usize, centres: PixelCentres) -> Tensor<4> {
    let source = images.dims()[axis];
    if source == length {
        return images;
    }
    let taps: Vec<(usize, usize, f32)> = (0..length).map(|at| taps_of(at, source, length, centres)).collect();
    let device = images.device();
    let (lower, upper) = (index(taps.iter().map(|tap| tap.0), &device), index(taps.iter().map(|tap| tap.1), &device));
    let mut shape = [1; 4];
    shape[axis] = length;
    let share = TensorData::new(taps.iter().map(|tap| tap.2).collect::<Vec<_>>(), shape);
    let (from, to) = (images.clone().select(axis, lower), images.select(axis, upper));
    from.clone() + (to - from) * Tensor::from_data(share, &device)
}

/// Lower and upper neighbour of an output pixel and the upper one's share.
fn taps_of(at: usize, source: usize, length: usize, centres: PixelCentres) -> (usize, usize, f32) {
    // In f32 as the references do it: the share's rounding is part of their result.
    let scale = source as f32 / length as f32;
    let place = match centres {
        PixelCentres::Half => ((at as f32 + 0.5) * scale - 0.5).max(0.0),
        PixelCentres::Corner => at as f32 * scale,
    };
    let lower = (place as usize).min(source - 1);
    (lower, (lower + 1).min(source - 1), place - lower as f32)
}

fn index(values: impl Iterator<Item = usize>, device: &Device) -> Tensor<1, Int> {
    let values: Vec<i64> = values.map(|value| value as i64).collect();
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}
