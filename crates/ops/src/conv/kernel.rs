//! Convolution as few matrix products, without a copy of the input per tap.
//!
//! The input is laid out with channels last and zeros around it. The taps of one row then are `taps·C` neighbouring numbers, and those of the
//! next cell start C later: a matrix whose rows overlap, which the product reads in place. One product per tap row and the sum is done.

use std::borrow::Cow;

use rayon::prelude::*;

use super::layout::{
    flipped_tap_rows, from_tap_rows, padded_channels_last, spread_channels_last, store, to_scratch, to_tap_rows,
};
use super::window::Window;
use crate::fused::{Blank, Kernel};
use crate::linear::column_sums;
use crate::product::{Matrix, MatrixMut, Old, Threads, product, product_on};

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
        let correlation = Correlation { window: self.window, weight: &weight, channels: [self.c_in, self.c_out], bias };
        let pictures = inputs[0].par_chunks(self.chunks()[0]);
        let pictures: Vec<_> = pictures.map(|x| padded_channels_last(x, self.c_in, &self.window)).collect();
        correlation.run(&pictures, self.output_shape.iter().product())
    }

    fn backward(&self, inputs: [&[f32]; N], upstream: Cow<'_, [f32]>, wanted: [bool; N]) -> [Option<Vec<f32>>; N] {
        let upstream = upstream.as_ref();
        let taps = self.window.taps.iter().product();
        let mut gradients = [const { None }; N];
        gradients[0] = wanted[0].then(|| {
            let weight = flipped_tap_rows(inputs[1], self.c_out, self.c_in, taps);
            let (window, channels) = (self.window.reversed(), [self.c_out, self.c_in]);
            let pictures = upstream.par_chunks(self.chunks()[1]);
            let pictures: Vec<_> = pictures.map(|g| spread_channels_last(g, self.c_out, &self.window)).collect();
            Correlation { window, weight: &weight, channels, bias: None }.run(&pictures, inputs[0].len())
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

/// Cells of a task's scratch, about: it stays in the second-level cache over all taps. Fixed, as sums run over the taps of one task.
const TASK_CELLS: usize = 512;

/// A correlation of padded pictures `[cells, C]` with a kernel `[taps, C, O]`.
struct Correlation<'a> {
    window: Window,
    weight: &'a [f32],
    /// C and O.
    channels: [usize; 2],
    bias: Option<&'a [f32]>,
}

impl Correlation<'_> {
    /// The outputs `[O, z, y, x]` of all pictures, `length` numbers.
    fn run(&self, pictures: &[Vec<f32>], length: usize) -> Vec<f32> {
        let mut y = Box::<[f32]>::new_uninit_slice(length);
        if length > 0 {
            let runs = self.window.runs(TASK_CELLS);
            let tasks: Vec<_> = self.places(&runs, &mut y).into_iter().enumerate().collect();
            tasks.into_par_iter().for_each(|(task, places)| {
                let [first, last] = runs[task % runs.len()];
                let scratch = self.scratch(&pictures[task / runs.len()], first, last);
                store(&scratch, &self.window, [first, last], self.bias, places);
            });
        }
        #[allow(unsafe_code)]
        // SAFETY: the runs cover every row of the output, each task got the places of its run in every channel, and `store` writes all of them.
        let y = unsafe { y.assume_init() };
        y.into_vec()
    }

    /// Where each run of each picture lies in the output: one piece per channel.
    fn places<'a>(&self, runs: &[[usize; 2]], y: &'a mut Blank) -> Vec<Vec<&'a mut Blank>> {
        let (cells, width) = (self.window.output.iter().product::<usize>(), self.window.output[2]);
        let mut tasks = Vec::new();
        for picture in y.chunks_exact_mut(cells * self.channels[1]) {
            let first = tasks.len();
            tasks.resize_with(first + runs.len(), || Vec::with_capacity(self.channels[1]));
            for mut channel in picture.chunks_exact_mut(cells) {
                for (task, [from, to]) in tasks[first..].iter_mut().zip(runs) {
                    let (place, rest) = channel.split_at_mut((to - from) * width);
                    task.push(place);
                    channel = rest;
                }
            }
        }
        tasks
    }

    /// The scratch `[cells, O]` of the output's rows `first..last`.
    fn scratch(&self, x: &[f32], first: usize, last: usize) -> Vec<f32> {
        let (window, [c_in, c_out]) = (&self.window, self.channels);
        let stretches = window.stretches_of(first, last);
        let cells = stretches.last().map_or(0, |stretch| stretch.output + stretch.rows);
        let mut scratch = vec![0.0; cells * c_out];
        let row = window.taps[2] * c_in;
        for stretch in stretches {
            for (i, tap) in window.tap_rows().into_iter().enumerate() {
                let inputs = Matrix {
                    data: &x[(stretch.input + tap) * c_in..],
                    rows: stretch.rows,
                    columns: row,
                    row_stride: window.stride[2] * c_in,
                    column_stride: 1,
                };
                let weight = Matrix::row_major(&self.weight[i * row * c_out..], row, c_out);
                let out = MatrixMut::row_major(&mut scratch[stretch.output * c_out..], stretch.rows, c_out);
                product_on(Threads::One, out, inputs, weight, 1.0, if i == 0 { Old::Replaced } else { Old::Kept });
            }
        }
        scratch
    }
}
