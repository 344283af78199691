//! Rearranging the operands of a convolution: channels last, zeros around, taps first.

use super::window::Window;
use crate::fused::Blank;
use rayon::prelude::*;

/// Lays a kernel `[O, C, taps]` out as `[taps, C, O]`.
pub(super) fn to_tap_rows(weight: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
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
pub(super) fn from_tap_rows(rows: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
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
pub(super) fn flipped_tap_rows(weight: &[f32], c_out: usize, c_in: usize, taps: usize) -> Vec<f32> {
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
pub(super) fn padded_channels_last(x: &[f32], channels: usize, window: &Window) -> Vec<f32> {
    let (size, before, padded) = (window.input, window.padding, window.padded());
    let mut out = vec![0.0; padded.iter().product::<usize>() * channels];
    let cells = size.iter().product::<usize>();
    out.par_chunks_mut((padded[2] * channels).max(1)).enumerate().with_min_len(ROWS).for_each(|(row, out)| {
        let place = |at: usize, axis: usize| at.checked_sub(before[axis]).filter(|&at| at < size[axis]);
        if let (Some(z), Some(y)) = (place(row / padded[1], 0), place(row % padded[1], 1)) {
            let x = &x[(z * size[1] + y) * size[2]..];
            transpose_row(x, cells, channels, size[2], channels, &mut out[before[2] * channels..]);
        }
    });
    out
}

/// The upstream gradient `[O, z, y, x]` spread by the stride into the reversed convolution's input `[Z, Y, X, O]`.
///
/// Cells that padding alone reaches lie outside and are left out.
pub(super) fn spread_channels_last(upstream: &[f32], channels: usize, window: &Window) -> Vec<f32> {
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

/// Rows of a picture that a task rearranges at least.
const ROWS: usize = 8;

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
pub(super) fn to_scratch(upstream: &[f32], channels: usize, window: &Window) -> Vec<f32> {
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

/// Writes the scratch `[cells, O]` of the output's rows `first..last`, plus the bias, to their places: all rows of one channel each.
///
/// # Panics
/// If there is not one place per channel, or one has another size.
pub(super) fn store(
    scratch: &[f32],
    window: &Window,
    [first, last]: [usize; 2],
    bias: Option<&[f32]>,
    mut places: Vec<&mut Blank>,
) {
    let (channels, width, start) = (places.len(), window.output[2], window.scratch_row(first));
    for place in &places {
        assert_eq!(place.len(), (last - first) * width, "a place holds the rows of its run");
    }
    for row in first..last {
        let from = &scratch[(window.scratch_row(row) - start) * channels..][..width * channels];
        for at in (0..width).step_by(TILE) {
            let count = TILE.min(width - at);
            for (c, place) in places.iter_mut().enumerate() {
                let bias = bias.map_or(0.0, |bias| bias[c]);
                let place = &mut place[(row - first) * width + at..][..count];
                for (i, out) in place.iter_mut().enumerate() {
                    out.write(from[(at + i) * channels + c] + bias);
                }
            }
        }
    }
}
