//! Convolution as few matrix products, without a copy of the input per tap.
//!
//! The input is laid out with channels last and zeros around it. The taps of one row then are `taps·C` neighbouring numbers, and those of the
//! next cell start C later: a matrix whose rows overlap, which the product reads in place. One product per tap row and the sum is done.

use rayon::prelude::*;

use super::window::Window;
use crate::fused::Kernel;
use crate::linear::column_sums;
use crate::product::{Matrix, MatrixMut, Old, product};

/// Inputs: x `[B, C, ..]`, weight `[O, C, ..]`, then bias `[O]` where there is one.
#[derive(Debug)]
pub(super) struct Convolution {
    pub output_shape: Vec<usize>,
    pub c_in: usize,
    pub c_out: usize,
    pub window: Window,
}

/// Kernels with more numbers than this are summed picture after picture, smaller ones side by side.
const SUMMED_IN_PLACE_FROM: usize = 1 << 18;

impl Convolution {
    /// Cells of one input and of one output map.
    fn cells(&self) -> [usize; 2] {
        [self.window.input, self.window.output].map(|size| size.iter().product())
    }

    /// The input's numbers per picture, at least 1 so that they can size chunks.
    fn chunks(&self) -> [usize; 2] {
        let [input, output] = self.cells();
        [(self.c_in * input).max(1), (self.c_out * output).max(1)]
    }

    fn weight_gradient(&self, x: &[f32], upstream: &[f32]) -> Vec<f32> {
        let [input, output] = self.chunks();
        let pictures: Vec<_> = x.chunks(input).zip(upstream.chunks(output)).collect();
        let taps: usize = self.window.taps.iter().product();
        let mut total = vec![0.0; taps * self.c_in * self.c_out];
        if total.len() >= SUMMED_IN_PLACE_FROM {
            for (x, upstream) in pictures {
                self.add_weight_gradient(x, upstream, &mut total);
            }
        } else {
            let parts: Vec<Vec<f32>> = pictures
                .into_par_iter()
                .map(|(x, upstream)| {
                    let mut part = vec![0.0; total.len()];
                    self.add_weight_gradient(x, upstream, &mut part);
                    part
                })
                .collect();
            for part in parts {
                total.iter_mut().zip(part).for_each(|(total, part)| *total += part);
            }
        }
        from_tap_rows(&total, self.c_out, self.c_in, taps)
    }

    /// Adds one picture's part to a gradient laid out as [`to_tap_rows`].
    fn add_weight_gradient(&self, x: &[f32], upstream: &[f32], total: &mut [f32]) {
        let window = &self.window;
        let x = padded_channels_last(x, self.c_in, window);
        let upstream = to_scratch(upstream, self.c_out, window);
        let row = window.taps[2] * self.c_in;
        let tap_rows = window.tap_rows();
        total.par_chunks_mut((row * self.c_out).max(1)).zip(tap_rows).for_each(|(total, tap)| {
            for stretch in window.stretches() {
                let inputs = Matrix {
                    data: &x[(stretch.input + tap) * self.c_in..],
                    rows: stretch.rows,
                    columns: row,
                    row_stride: window.stride[2] * self.c_in,
                    column_stride: 1,
                };
                let upstream = &upstream[stretch.output * self.c_out..];
                let upstream = Matrix::row_major(upstream, stretch.rows, self.c_out);
                let out = MatrixMut::row_major(total, row, self.c_out);
                product(out, inputs.transposed(), upstream, 1.0, Old::Kept);
            }
        });
    }
}

impl<const N: usize> Kernel<N> for Convolution {
    fn output_shape(&self) -> Vec<usize> {
        self.output_shape.clone()
    }

    fn forward(&self, inputs: [&[f32]; N]) -> Vec<f32> {
        let (weight, bias) = (inputs[1], inputs.get(2).copied());
        let taps = self.window.taps.iter().product();
        let weight = to_tap_rows(weight, self.c_out, self.c_in, taps);
        let [input, output] = self.chunks();
        let mut y = vec![0.0; self.output_shape.iter().product()];
        y.par_chunks_mut(output).zip(inputs[0].par_chunks(input)).for_each(|(y, x)| {
            let window = &self.window;
            let x = padded_channels_last(x, self.c_in, window);
            let scratch = correlate(&x, &weight, [self.c_in, self.c_out], window);
            from_scratch(&scratch, self.c_out, window, bias, y);
        });
        y
    }

    fn backward(&self, inputs: [&[f32]; N], upstream: &[f32], wanted: [bool; N]) -> [Option<Vec<f32>>; N] {
        let [input, output] = self.chunks();
        let taps = self.window.taps.iter().product();
        let mut gradients = [const { None }; N];
        gradients[0] = wanted[0].then(|| {
            let flipped = flipped_tap_rows(inputs[1], self.c_out, self.c_in, taps);
            let mut dx = vec![0.0; inputs[0].len()];
            dx.par_chunks_mut(input).zip(upstream.par_chunks(output)).for_each(|(dx, upstream)| {
                let reversed = self.window.reversed();
                let spread = spread_channels_last(upstream, self.c_out, &self.window);
                let scratch = correlate(&spread, &flipped, [self.c_out, self.c_in], &reversed);
                from_scratch(&scratch, self.c_in, &reversed, None, dx);
            });
            dx
        });
        gradients[1] = wanted[1].then(|| self.weight_gradient(inputs[0], upstream));
        if let (Some(gradient), Some(true)) = (gradients.get_mut(2), wanted.get(2)) {
            *gradient = Some(self.bias_gradient(upstream));
        }
        gradients
    }
}

impl Convolution {
    /// Sum of the upstream gradient over pictures and cells.
    fn bias_gradient(&self, upstream: &[f32]) -> Vec<f32> {
        let cells = self.cells()[1].max(1);
        let sums: Vec<f32> = upstream.par_chunks(cells).map(crate::fused::sum).collect();
        column_sums(&sums, self.c_out)
    }
}

/// The output's scratch, `[scratch cells, O]`, of one padded picture `[cells, C]`.
fn correlate(x: &[f32], weight: &[f32], [c_in, c_out]: [usize; 2], window: &Window) -> Vec<f32> {
    let mut scratch = vec![0.0; window.scratch_cells() * c_out];
    let row = window.taps[2] * c_in;
    for stretch in window.stretches() {
        for (i, tap) in window.tap_rows().into_iter().enumerate() {
            let inputs = Matrix {
                data: &x[(stretch.input + tap) * c_in..],
                rows: stretch.rows,
                columns: row,
                row_stride: window.stride[2] * c_in,
                column_stride: 1,
            };
            let weight = Matrix::row_major(&weight[i * row * c_out..], row, c_out);
            let out = MatrixMut::row_major(&mut scratch[stretch.output * c_out..], stretch.rows, c_out);
            product(out, inputs, weight, 1.0, if i == 0 { Old::Replaced } else { Old::Kept });
        }
    }
    scratch
}

/// Lays a kernel `[O, C, taps]` out as `[taps, C, O]`.
fn to_tap_rows(weight: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
    let mut rows = vec![0.0; weight.len()];
    for (o, weight) in weight.chunks_exact((c_in * taps).max(1)).enumerate() {
        for (c, weight) in weight.chunks_exact(taps).enumerate() {
            for (tap, &value) in weight.iter().enumerate() {
                rows[(tap * c_in + c) * c_out + o] = value;
            }
        }
    }
    rows
}

/// Undoes [`to_tap_rows`].
fn from_tap_rows(rows: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
    let mut weight = vec![0.0; rows.len()];
    for (o, weight) in weight.chunks_exact_mut((c_in * taps).max(1)).enumerate() {
        for (c, weight) in weight.chunks_exact_mut(taps).enumerate() {
            for (tap, value) in weight.iter_mut().enumerate() {
                *value = rows[(tap * c_in + c) * c_out + o];
            }
        }
    }
    weight
}

/// Lays a kernel `[O, C, taps]` out as `[taps backwards, O, C]`.
fn flipped_tap_rows(weight: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
    let mut rows = vec![0.0; weight.len()];
    for (o, weight) in weight.chunks_exact((c_in * taps).max(1)).enumerate() {
        for (c, weight) in weight.chunks_exact(taps).enumerate() {
            for (tap, &value) in weight.iter().enumerate() {
                rows[((taps - 1 - tap) * c_out + o) * c_in + c] = value;
            }
        }
    }
    rows
}

/// A picture `[C, z, y, x]` to `[Z, Y, X, C]` with zeros around it.
fn padded_channels_last(x: &[f32], channels: usize, window: &Window) -> Vec<f32> {
    let (size, before, padded) = (window.input, window.padding, window.padded());
    let mut out = vec![0.0; padded.iter().product::<usize>() * channels];
    let cells = size.iter().product::<usize>();
    for z in 0..size[0] {
        for y in 0..size[1] {
            let row = (before[0] + z) * padded[1] + before[1] + y;
            let out = &mut out[(row * padded[2] + before[2]) * channels..];
            transpose_row(&x[(z * size[1] + y) * size[2]..], cells, channels, size[2], channels, out);
        }
    }
    out
}

/// The upstream gradient `[O, z, y, x]` spread by the stride into the reversed convolution's input `[Z, Y, X, O]`.
///
/// Cells that padding alone reaches lie outside and are left out.
fn spread_channels_last(upstream: &[f32], channels: usize, window: &Window) -> Vec<f32> {
    let (size, padded) = (window.output, window.reversed().input);
    let mut out = vec![0.0; padded.iter().product::<usize>() * channels];
    let cells = size.iter().product::<usize>();
    // Output cell i meets input cell i·stride + tap - padding; in the reversed input it stands at i·stride + last tap - padding.
    let place = |axis: usize, i: usize| {
        let at = (i * window.stride[axis] + window.taps[axis] - 1).checked_sub(window.padding[axis])?;
        (at < padded[axis]).then_some(at)
    };
    for z in 0..size[0] {
        for y in 0..size[1] {
            let (Some(z_at), Some(y_at)) = (place(0, z), place(1, y)) else { continue };
            let inside = (0..size[2]).filter(|&x| place(2, x).is_some());
            let (Some(first), count) = (inside.clone().next(), inside.count()) else { continue };
            let Some(x_at) = place(2, first) else { continue };
            let out = &mut out[((z_at * padded[1] + y_at) * padded[2] + x_at) * channels..];
            let from = (z * size[1] + y) * size[2] + first;
            transpose_row(&upstream[from..], cells, channels, count, window.stride[2] * channels, out);
        }
    }
    out
}

/// Cells handled together when channels and cells change places, so that both sides stay in the cache.
const TILE: usize = 16;

/// Writes `count` cells of all channels (`x[c·pitch + i]`) to `out[i·step + c]`.
fn transpose_row(x: &[f32], pitch: usize, channels: usize, count: usize, step: usize, out: &mut [f32]) {
    for first in (0..count).step_by(TILE) {
        let cells = TILE.min(count - first);
        for c in 0..channels {
            let x = &x[c * pitch + first..][..cells];
            for (i, &value) in x.iter().enumerate() {
                out[(first + i) * step + c] = value;
            }
        }
    }
}

/// `[O, z, y, x]` to the output's scratch `[scratch cells, O]`, zeros in unused cells.
fn to_scratch(upstream: &[f32], channels: usize, window: &Window) -> Vec<f32> {
    let ([z_count, y_count, x_count], [row, slice]) = (window.output, window.scratch_pitch());
    let mut scratch = vec![0.0; window.scratch_cells() * channels];
    let cells = z_count * y_count * x_count;
    for z in 0..z_count {
        for y in 0..y_count {
            let out = &mut scratch[(z * slice + y * row) * channels..];
            transpose_row(&upstream[(z * y_count + y) * x_count..], cells, channels, x_count, channels, out);
        }
    }
    scratch
}

/// The output's scratch to `[O, z, y, x]`, plus the bias.
fn from_scratch(scratch: &[f32], channels: usize, window: &Window, bias: Option<&[f32]>, out: &mut [f32]) {
    let ([z_count, y_count, x_count], [row, slice]) = (window.output, window.scratch_pitch());
    let cells = z_count * y_count * x_count;
    for z in 0..z_count {
        for y in 0..y_count {
            let from = &scratch[(z * slice + y * row) * channels..];
            let at = (z * y_count + y) * x_count;
            for first in (0..x_count).step_by(TILE) {
                let count = TILE.min(x_count - first);
                for c in 0..channels {
                    let bias = bias.map_or(0.0, |bias| bias[c]);
                    let out = &mut out[c * cells + at + first..][..count];
                    for (i, out) in out.iter_mut().enumerate() {
                        *out = from[(first + i) * channels + c] + bias;
                    }
                }
            }
        }
    }
}
