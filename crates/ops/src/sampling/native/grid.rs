//! Grid sampling for `flex`: one point per output cell, and usually many channels.
//!
//! Inputs and outputs have channels first. A task takes a block of channels and lays them last, so that a corner is one vector. Tasks that add
//! gradients own their block of one batch item, so that results have the same bits on any number of threads.

use std::borrow::Cow;

use rayon::prelude::*;

use crate::fused::{Blank, Kernel, sum_of_products, vectorized, write_each, written};

use super::super::grid::Interpolation;
use super::batch::{Batch, POINTS};

/// Inputs: maps `[N, C, sites]`, grid `[N, Q, d]`. Output `[N, C, Q]`, given the shape asked for.
#[derive(Debug)]
pub(in crate::sampling) struct GridSampling {
    pub output_shape: Vec<usize>,
    /// Along (x, y, z); z is 1 for maps.
    pub extent: [usize; 3],
    /// Coordinates per point: 2 or 3.
    pub axes: usize,
    pub align_corners: bool,
    pub mode: Interpolation,
}

/// Points of a task on the way forward.
const CHUNK: usize = 32 * POINTS;

/// Calls a function generic over (corners, channels of a block) with the constants that this kernel needs.
macro_rules! specialize {
    ($kernel:expr, $function:ident($($arg:expr),*)) => {
        match ($kernel.axes, $kernel.width()) {
            (2, 16) => $function::<4, 16>($($arg),*),
            (2, 8) => $function::<4, 8>($($arg),*),
            (2, _) => $function::<4, 4>($($arg),*),
            (_, 16) => $function::<8, 16>($($arg),*),
            (_, 8) => $function::<8, 8>($($arg),*),
            (_, _) => $function::<8, 4>($($arg),*),
        }
    };
}

impl GridSampling {
    fn items(&self) -> usize {
        self.output_shape[0]
    }

    fn channels(&self) -> usize {
        self.output_shape[1]
    }

    fn points(&self) -> usize {
        self.output_shape[2..].iter().product()
    }

    fn sites(&self) -> usize {
        self.extent.iter().product()
    }

    /// Channels of a block; the last block may hold fewer and is filled with zeros.
    fn width(&self) -> usize {
        match self.channels() {
            ..=4 => 4,
            5..=8 => 8,
            _ => 16,
        }
    }

    fn blocks(&self) -> usize {
        self.channels().div_ceil(self.width())
    }

    /// The maps as `[N, blocks, sites, W]`.
    fn blocked(&self, input: &[f32]) -> Vec<Vec<f32>> {
        let (width, sites) = (self.width(), self.sites());
        let items = input.par_chunks((self.channels() * sites).max(1));
        let blocks = items.flat_map(|item| item.par_chunks(width * sites));
        blocks.map(|block| specialize!(self, channels_last(block, sites))).collect()
    }

    /// The grid's coordinates of one item, `[Q, d]`.
    fn coordinates<'a>(&self, grid: &'a [f32], item: usize) -> &'a [f32] {
        let length = self.points() * self.axes;
        &grid[item * length..][..length]
    }

    /// The place of every run of points, a piece per channel, in the order (item, block, run).
    fn places<'a>(&self, y: &'a mut Blank) -> Vec<Vec<&'a mut Blank>> {
        let (width, points) = (self.width(), self.points());
        let mut tasks = Vec::new();
        for item in y.chunks_exact_mut(self.channels() * points) {
            for block in item.chunks_mut(width * points) {
                let first = tasks.len();
                tasks.resize_with(first + points.div_ceil(CHUNK), || Vec::with_capacity(width));
                for channel in block.chunks_exact_mut(points) {
                    let runs = tasks[first..].iter_mut().zip(channel.chunks_mut(CHUNK));
                    runs.for_each(|(task, place): (&mut Vec<_>, _)| task.push(place));
                }
            }
        }
        tasks
    }

    /// Positions, in pixels, of up to [`POINTS`] points, operation by operation as the reference computes them.
    #[inline(always)]
    fn locate<const K: usize>(&self, coordinates: &[f32], batch: &mut Batch<K>) {
        let axes = Batch::<K>::AXES;
        for a in 0..axes {
            let size = self.extent[a] as f32;
            let positions = batch.position[a].iter_mut().zip(coordinates.chunks_exact(axes));
            for (position, coordinate) in positions {
                let x = coordinate[a] + 1.0;
                let x = if self.align_corners { x / 2.0 * (size - 1.0) } else { (x * size - 1.0) / 2.0 };
                *position = if self.mode == Interpolation::Nearest { x.round_ties_even() } else { x };
            }
        }
        batch.locate(self.extent, 1);
    }
}

impl Kernel<2> for GridSampling {
    fn output_shape(&self) -> Vec<usize> {
        self.output_shape.clone()
    }

    fn forward(&self, [input, grid]: [&[f32]; 2]) -> Vec<f32> {
        let mut y = Box::<[f32]>::new_uninit_slice(self.output_shape.iter().product());
        if !y.is_empty() {
            let maps = self.blocked(input);
            let runs = self.points().div_ceil(CHUNK);
            let tasks: Vec<_> = self.places(&mut y).into_iter().enumerate().collect();
            tasks.into_par_iter().for_each(|(task, mut places)| {
                let (block, first) = (task / runs, task % runs * CHUNK);
                let coordinates = self.coordinates(grid, block / self.blocks());
                let coordinates = &coordinates[first * self.axes..][..places[0].len() * self.axes];
                specialize!(self, sample(self, &maps[block], coordinates, &mut places));
            });
        }
        #[allow(unsafe_code)]
        // SAFETY: each task got its run of points in every channel of its block, these cover the output, and `sample` writes all of them.
        let y = unsafe { y.assume_init() };
        y.into_vec()
    }

    fn backward(
        &self,
        [input, grid]: [&[f32]; 2],
        upstream: Cow<'_, [f32]>,
        wanted: [bool; 2],
    ) -> [Option<Vec<f32>>; 2] {
        let (length, points, sites) = (self.width() * self.points(), self.points(), self.sites());
        let maps = if wanted[1] { self.blocked(input) } else { Vec::new() };
        let mut values = vec![0.0; if wanted[0] { input.len() } else { 0 }];
        let mut blocks: Vec<&mut [f32]> = values
            .chunks_mut((self.channels() * sites).max(1))
            .flat_map(|item| item.chunks_mut(self.width() * sites))
            .collect();
        blocks.resize_with(self.items() * self.blocks(), || &mut []);
        let tasks = blocks.into_par_iter().enumerate().map(|(block, values)| {
            let (item, at) = (block / self.blocks(), block % self.blocks());
            let upstream = &upstream[item * self.channels() * points..][..self.channels() * points];
            let upstream = &upstream[at * length..upstream.len().min((at + 1) * length)];
            let map = maps.get(block).map(Vec::as_slice);
            specialize!(self, gradients(self, map, self.coordinates(grid, item), upstream, values))
        });
        let parts: Vec<Vec<f32>> = tasks.collect();
        let grid_gradient = wanted[1].then(|| self.sum_parts(&parts));
        [wanted[0].then_some(values), grid_gradient]
    }
}

impl GridSampling {
    /// Adds the blocks' parts of the gradients by position and turns them into gradients by coordinate.
    fn sum_parts(&self, parts: &[Vec<f32>]) -> Vec<f32> {
        let length = self.points() * self.axes;
        let scale: [f32; 3] = self.extent.map(|size| if self.align_corners { size as f32 - 1.0 } else { size as f32 });
        written(self.items() * length, length, |item, out| {
            let mut total = vec![0.0; length];
            for part in &parts[item * self.blocks()..][..self.blocks()] {
                total.iter_mut().zip(part).for_each(|(total, part)| *total += part);
            }
            for point in total.chunks_exact_mut(self.axes) {
                point.iter_mut().zip(scale).for_each(|(x, scale)| *x = *x * scale / 2.0);
            }
            write_each!(out, x in &total => x)
        })
    }
}

vectorized! {
    /// `[≤ W channels, sites]` to `[sites, W]`, zeros in channels that are not there.
    fn channels_last[const K: usize, const W: usize](block: &[f32], sites: usize) -> Vec<f32> {
        let mut out = vec![0.0; sites * W];
        let (rows, _) = out.as_chunks_mut::<W>();
        for (tile, rows) in rows.chunks_mut(POINTS).enumerate() {
            for (c, channel) in block.chunks_exact(sites).enumerate() {
                for (row, &value) in rows.iter_mut().zip(&channel[tile * POINTS..]) {
                    row[c] = value;
                }
            }
        }
        debug_assert!(K > 0);
        out
    }
}

vectorized! {
    /// Samples one block of channels at some points; `places` are the points' numbers in each of its channels.
    fn sample[const K: usize, const W: usize](
        kernel: &GridSampling,
        map: &[f32],
        coordinates: &[f32],
        places: &mut [&mut Blank],
    ) {
        let (map, _) = map.as_chunks::<W>();
        let mut batch = Batch::<K>::new();
        let mut tile = [[0.0f32; W]; POINTS];
        for (at, coordinates) in coordinates.chunks(POINTS * kernel.axes).enumerate() {
            let count = coordinates.len() / kernel.axes;
            kernel.locate(coordinates, &mut batch);
            for i in 0..count {
                let mut total = [0.0; W];
                for k in 0..K {
                    let (weight, value) = (batch.weight[k][i], &map[batch.row[k][i] as usize]);
                    for j in 0..W {
                        total[j] += weight * value[j];
                    }
                }
                tile[i] = total;
            }
            for (c, place) in places.iter_mut().enumerate() {
                for (place, point) in place[at * POINTS..][..count].iter_mut().zip(&tile) {
                    place.write(point[c]);
                }
            }
        }
    }
}

vectorized! {
    /// Gradients through one block of channels: writes those of its values, where there is room for them, and returns those by position,
    /// `[Q, d]`, where the map is given.
    fn gradients[const K: usize, const W: usize](
        kernel: &GridSampling,
        map: Option<&[f32]>,
        coordinates: &[f32],
        upstream: &[f32],
        values: &mut [f32],
    ) -> Vec<f32> {
        let points = coordinates.len() / kernel.axes;
        let map = map.map(|map| map.as_chunks::<W>().0);
        let mut sums = vec![[0.0f32; W]; if values.is_empty() { 0 } else { kernel.sites() }];
        let mut slopes = vec![0.0; if map.is_some() { coordinates.len() } else { 0 }];
        let mut batch = Batch::<K>::new();
        let mut tile = [[0.0f32; W]; POINTS];
        for (at, coordinates) in coordinates.chunks(POINTS * kernel.axes).enumerate() {
            let count = coordinates.len() / kernel.axes;
            kernel.locate(coordinates, &mut batch);
            for (c, channel) in upstream.chunks_exact(points).enumerate() {
                for (point, &value) in tile.iter_mut().zip(&channel[at * POINTS..][..count]) {
                    point[c] = value;
                }
            }
            if !sums.is_empty() {
                for i in 0..count {
                    for k in 0..K {
                        let (weight, sum) = (batch.weight[k][i], &mut sums[batch.row[k][i] as usize]);
                        for j in 0..W {
                            sum[j] += weight * tile[i][j];
                        }
                    }
                }
            }
            if let Some(map) = map {
                let mut corner = [[0.0; POINTS]; K];
                for i in 0..count {
                    for k in 0..K {
                        corner[k][i] = sum_of_products(&tile[i], &map[batch.row[k][i] as usize]);
                    }
                }
                for a in 0..Batch::<K>::AXES {
                    let along = batch.slopes(a, &corner);
                    let out = slopes[at * POINTS * kernel.axes..].chunks_exact_mut(kernel.axes);
                    out.zip(&along[..count]).for_each(|(out, &slope)| out[a] = slope);
                }
            }
        }
        for (c, channel) in values.chunks_exact_mut(kernel.sites()).enumerate() {
            channel.iter_mut().zip(&sums).for_each(|(value, sum)| *value = sum[c]);
        }
        slopes
    }
}
