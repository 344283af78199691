//! Sampling of maps and volumes on a grid of normalised coordinates.

use burn::tensor::Tensor;

use super::core::{Levels, Sampling, sample_views};
use super::native::GridSampling;
use crate::fused::{fused_2, on_flex};

/// How a value between pixel centres is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Interpolation {
    /// Linear along every axis.
    Bilinear,
    /// The nearest pixel, halves to the even one; the grid gets no gradient.
    Nearest,
}

/// Samples maps at normalised coordinates, zeros outside.
///
/// The pixel of coordinate x is `((x + 1)·W - 1) / 2`, or `(x + 1) / 2 · (W - 1)` with `align_corners`.
///
/// # Shapes
/// - input: `[N, C, H, W]`
/// - grid: `[N, Ho, Wo, 2]`, (x, y) with -1 and 1 on the borders
/// - output: `[N, C, Ho, Wo]`
///
/// # Panics
/// If the shapes disagree or the input has no pixels.
#[must_use]
pub fn grid_sample_2d(input: Tensor<4>, grid: Tensor<4>, align_corners: bool, mode: Interpolation) -> Tensor<4> {
    let [n, c, h, w] = input.dims();
    let [_, ho, wo, axes] = grid.dims();
    assert_eq!((grid.dims()[0], axes), (n, 2), "grid [N, Ho, Wo, 2]");
    assert!(h * w > 0, "a map of {h}x{w}");
    if on_flex(&input) && on_flex(&grid) {
        let kernel = GridSampling { output_shape: vec![n, c, ho, wo], extent: [w, h, 1], axes, align_corners, mode };
        // The nearest pixel does not move with the point.
        let grid = if mode == Interpolation::Nearest { grid.detach() } else { grid };
        return fused_2(kernel, input, grid);
    }
    let levels = Levels::maps(&[[h, w]], 0.0);
    let pixels = pixels(grid.reshape([n, ho * wo, axes]), &levels, align_corners);
    let pixels = match mode {
        Interpolation::Bilinear => pixels,
        Interpolation::Nearest => round_half_even(pixels.detach()),
    };
    sample_pixels(&levels, input.reshape([n, c, h * w]), pixels).reshape([n, c, ho, wo])
}

/// Trilinear sampling of volumes at normalised coordinates, zeros outside, `align_corners = false`.
///
/// # Shapes
/// - input: `[N, C, D, H, W]`
/// - grid: `[N, Do, Ho, Wo, 3]`, (x, y, z) with -1 and 1 on the borders
/// - output: `[N, C, Do, Ho, Wo]`
///
/// # Panics
/// If the shapes disagree or the input has no pixels.
#[must_use]
pub fn grid_sample_3d(input: Tensor<5>, grid: Tensor<5>) -> Tensor<5> {
    let [n, c, d, h, w] = input.dims();
    let [_, od, oh, ow, axes] = grid.dims();
    assert_eq!((grid.dims()[0], axes), (n, 3), "grid [N, Do, Ho, Wo, 3]");
    assert!(d * h * w > 0, "a volume of {d}x{h}x{w}");
    if on_flex(&input) && on_flex(&grid) {
        let (extent, mode) = ([w, h, d], Interpolation::Bilinear);
        let kernel = GridSampling { output_shape: vec![n, c, od, oh, ow], extent, axes, align_corners: false, mode };
        return fused_2(kernel, input, grid);
    }
    let levels = Levels::volumes(&[[d, h, w]], 0.0);
    let pixels = pixels(grid.reshape([n, od * oh * ow, axes]), &levels, false);
    sample_pixels(&levels, input.reshape([n, c, d * h * w]), pixels).reshape([n, c, od, oh, ow])
}

/// Pixel coordinates `[N, Q, d]` of normalised ones, operation by operation as the reference computes them: points on
/// pixel centres must land on the same side of `floor`.
fn pixels(grid: Tensor<3>, levels: &Levels, align_corners: bool) -> Tensor<3> {
    assert_eq!(grid.dims()[2], levels.axes, "coordinates per grid point");
    let sizes = levels.extents[0][..levels.axes].iter().map(|&size| size as f32);
    let sizes: Vec<f32> = if align_corners { sizes.map(|size| size - 1.0).collect() } else { sizes.collect() };
    let sizes = Tensor::<1>::from_floats(sizes.as_slice(), &grid.device()).reshape([1, 1, levels.axes]);
    if align_corners { (grid + 1.0) / 2.0 * sizes } else { ((grid + 1.0) * sizes - 1.0) / 2.0 }
}

/// Nearest integer, halves to the even one, from operations that agree on every backend.
fn round_half_even(x: Tensor<3>) -> Tensor<3> {
    let floor = x.clone().floor();
    let fraction = x - floor.clone();
    let odd = floor.clone() - (floor.clone() / 2.0).floor() * 2.0;
    let above = fraction.clone().greater_elem(0.5);
    let tie_to_upper = fraction.equal_elem(0.5).bool_and(odd.equal_elem(1.0));
    floor + above.bool_or(tie_to_upper).float()
}

/// `input [N, C, S]` at `pixels [N, Q, d]`, giving `[N, C, Q]`.
fn sample_pixels(levels: &Levels, input: Tensor<3>, pixels: Tensor<3>) -> Tensor<3> {
    let [n, c, s] = input.dims();
    let [_, q, axes] = pixels.dims();
    let device = input.device();
    let sampling = Sampling {
        values: input.swap_dims(1, 2).reshape([n, 1, s, 1, c]),
        reference: Tensor::zeros([n, 1, q, axes], &device),
        visible: Tensor::<3>::zeros([n, 1, q], &device).equal_elem(0.0),
        offsets: pixels.reshape([n, q, 1, 1, 1, axes]),
        weights: Tensor::ones([n, q, 1, 1, 1], &device),
    };
    sample_views(levels, sampling).swap_dims(1, 2)
}
