//! Fused deformable sampling for `flex`.
//!
//! Nothing of size views × queries × points × channels is ever stored: corners are found, read and summed on the fly, once
//! on the way forward and once on the way back, and queries that no view sees cost nothing.

mod backward;
mod corners;
mod forward;

use burn::tensor::{Bool, Tensor};

use crate::fused::{Kernel, fused_3};

use super::core::{Levels, Sampling};

/// See [`super::core::sample_views`].
pub(super) fn sample_views(levels: &Levels, sampling: Sampling) -> Tensor<3> {
    let [n, v, s, m, c] = sampling.values.dims();
    let [_, q, _, _, p, _] = sampling.offsets.dims();
    let size = Size { n, v, s, m, c, q, p };
    let kernel = Deformable {
        sites: Sites::new(levels),
        reference: host(sampling.reference),
        seen: Seen::new(&size, host_mask(sampling.visible)),
        size,
        axes: levels.axes,
    };
    fused_3(kernel, sampling.values, sampling.offsets, sampling.weights)
}

fn host(tensor: Tensor<4>) -> Vec<f32> {
    tensor.into_data().try_to_vec::<f32>().expect("an f32 tensor")
}

fn host_mask(mask: Tensor<3, Bool>) -> Vec<bool> {
    mask.into_data().try_to_vec::<bool>().expect("a mask")
}

/// Sizes of the tensors, by the letters of the crate's documentation.
#[derive(Debug, Clone, Copy)]
struct Size {
    n: usize,
    v: usize,
    s: usize,
    m: usize,
    c: usize,
    q: usize,
    p: usize,
}

/// Where the levels lie.
#[derive(Debug)]
struct Sites {
    extents: Vec<[usize; 3]>,
    starts: Vec<usize>,
    counts: Vec<usize>,
    centre: f32,
}

impl Sites {
    fn new(levels: &Levels) -> Self {
        let count = levels.extents.len();
        Self {
            extents: levels.extents.clone(),
            starts: (0..count).map(|level| levels.start(level)).collect(),
            counts: (0..count).map(|level| levels.sites(level)).collect(),
            centre: levels.centre,
        }
    }
}

/// Which queries each view sees.
#[derive(Debug)]
struct Seen {
    /// Ascending queries per (n, v).
    queries: Vec<Vec<u32>>,
    /// `1 / max(count, 1)` per (n, q).
    share: Vec<f32>,
}

impl Seen {
    fn new(size: &Size, visible: Vec<bool>) -> Self {
        let mut queries = vec![Vec::new(); size.n * size.v];
        let mut count = vec![0u32; size.n * size.q];
        for (view, row) in visible.chunks_exact(size.q.max(1)).enumerate() {
            for (q, _) in row.iter().enumerate().filter(|(_, seen)| **seen) {
                queries[view].push(q as u32);
                count[view / size.v * size.q + q] += 1;
            }
        }
        Self { queries, share: count.into_iter().map(|count| 1.0 / count.max(1) as f32).collect() }
    }

    /// The queries in `[from, to)` that view `v` of item `n` sees.
    fn range(&self, view: usize, from: usize, to: usize) -> &[u32] {
        let queries = &self.queries[view];
        let at = |limit: usize| queries.partition_point(|&q| (q as usize) < limit);
        &queries[at(from)..at(to)]
    }
}

/// Inputs: values `[N, V, S, M, C]`, offsets `[N, Q, M, L, P, d]`, weights `[N, Q, M, L, P]`. Output `[N, Q, M·C]`.
#[derive(Debug)]
struct Deformable {
    size: Size,
    axes: usize,
    sites: Sites,
    reference: Vec<f32>,
    seen: Seen,
}

impl Deformable {
    fn levels(&self) -> usize {
        self.sites.extents.len()
    }
}

impl Kernel<3> for Deformable {
    fn output_shape(&self) -> Vec<usize> {
        vec![self.size.n, self.size.q, self.size.m * self.size.c]
    }

    fn forward(&self, [values, offsets, weights]: [&[f32]; 3]) -> Vec<f32> {
        forward::forward(self, values, offsets, weights)
    }

    fn backward(&self, inputs: [&[f32]; 3], upstream: &[f32], wanted: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        backward::backward(self, inputs, upstream, wanted)
    }
}

/// Calls a function generic over (corners, channels) with the constants that this kernel needs; 0 channels means that the
/// number is known only at run time.
macro_rules! specialize {
    ($kernel:expr, $function:ident($($arg:expr),*)) => {
        match ($kernel.axes, $kernel.size.c) {
            (2, 8) => $function::<4, 8>($($arg),*),
            (2, 16) => $function::<4, 16>($($arg),*),
            (2, 32) => $function::<4, 32>($($arg),*),
            (2, _) => $function::<4, 0>($($arg),*),
            (_, 8) => $function::<8, 8>($($arg),*),
            (_, 16) => $function::<8, 16>($($arg),*),
            (_, 32) => $function::<8, 32>($($arg),*),
            (_, _) => $function::<8, 0>($($arg),*),
        }
    };
}
use specialize;
