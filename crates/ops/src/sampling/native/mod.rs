//! Fused deformable sampling for `flex`.
//!
//! Nothing of size views × queries × points × channels is ever stored: corners are found, read and summed on the fly, once
//! on the way forward and once on the way back, and queries that no view sees cost nothing.

mod backward;
mod batch;
mod forward;
mod grid;

use std::borrow::Cow;

use burn::tensor::{Bool, Tensor};

use crate::fused::{Kernel, fused_3};

use super::core::{Levels, Sampling};

use batch::{Batch, POINTS};
pub(super) use grid::GridSampling;

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

/// One map: a level of a view, seen by one head.
#[derive(Debug, Clone, Copy)]
struct Place {
    n: usize,
    v: usize,
    level: usize,
    head: usize,
}

/// Points that fit into one batch: the same range of points of some queries.
struct Run<'a> {
    place: Place,
    queries: &'a [u32],
    /// First point of the range and how many there are.
    first: usize,
    points: usize,
}

impl Deformable {
    fn levels(&self) -> usize {
        self.sites.extents.len()
    }

    /// The values at a place as blocks of `W` channels, beginning at its first site.
    #[inline(always)]
    fn map<'a, const W: usize>(&self, values: &'a [f32], place: Place) -> &'a [[f32; W]] {
        let Size { v, s, m, c, .. } = self.size;
        let site = (place.n * v + place.v) * s + self.sites.starts[place.level];
        let length = (self.sites.counts[place.level] * m - place.head) * c;
        values[(site * m + place.head) * c..][..length].as_chunks().0
    }

    /// Cuts the points of the queries in `[from, to)` that see a place into batches, in order.
    fn runs(&self, place: Place, from: usize, to: usize) -> impl Iterator<Item = Run<'_>> {
        let seen = self.seen.range(place.n * self.size.v + place.v, from, to);
        let ranges = (0..self.size.p).step_by(POINTS);
        ranges.flat_map(move |first| {
            let points = (self.size.p - first).min(POINTS);
            seen.chunks(POINTS / points).map(move |queries| Run { place, queries, first, points })
        })
    }

    /// Index of the first point of a run's query in `[N, Q, M, L, P]`.
    #[inline(always)]
    fn point(&self, run: &Run<'_>, q: usize) -> usize {
        let Place { n, level, head, .. } = run.place;
        (((n * self.size.q + q) * self.size.m + head) * self.levels() + level) * self.size.p + run.first
    }

    /// Computes the positions of a run's points and finds their corners, as rows of maps whose sites are `pitch` rows apart.
    #[inline(always)]
    fn fill<const K: usize>(&self, batch: &mut Batch<K>, offsets: &[f32], run: &Run<'_>, pitch: usize) {
        let axes = Batch::<K>::AXES;
        let extent = self.sites.extents[run.place.level];
        let view = run.place.n * self.size.v + run.place.v;
        let mut i = 0;
        for &q in run.queries {
            let q = q as usize;
            let reference = &self.reference[(view * self.size.q + q) * axes..][..axes];
            let offsets = &offsets[self.point(run, q) * axes..][..run.points * axes];
            for offset in offsets.chunks_exact(axes) {
                for a in 0..axes {
                    batch.position[a][i] = reference[a] * extent[a] as f32 + offset[a] - self.sites.centre;
                }
                i += 1;
            }
        }
        batch.locate(extent, pitch);
    }

    /// Channels that are handled at once; divides C.
    #[inline(always)]
    fn width(&self) -> usize {
        match self.size.c {
            c if c % 32 == 0 => 32,
            c if c % 16 == 0 => 16,
            c if c % 8 == 0 => 8,
            c if c % 4 == 0 => 4,
            _ => 1,
        }
    }
}

impl Kernel<3> for Deformable {
    fn output_shape(&self) -> Vec<usize> {
        vec![self.size.n, self.size.q, self.size.m * self.size.c]
    }

    fn forward(&self, [values, offsets, weights]: [&[f32]; 3]) -> Vec<f32> {
        forward::forward(self, values, offsets, weights)
    }

    fn backward(&self, inputs: [&[f32]; 3], upstream: Cow<'_, [f32]>, wanted: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        backward::backward(self, inputs, &upstream, wanted)
    }
}

/// Calls a function generic over (corners, channels handled at once) with the constants that this kernel needs.
macro_rules! specialize {
    ($kernel:expr, $function:ident($($arg:expr),*)) => {
        match ($kernel.axes, $kernel.width()) {
            (2, 32) => $function::<4, 32>($($arg),*),
            (2, 16) => $function::<4, 16>($($arg),*),
            (2, 8) => $function::<4, 8>($($arg),*),
            (2, 4) => $function::<4, 4>($($arg),*),
            (2, _) => $function::<4, 1>($($arg),*),
            (_, 32) => $function::<8, 32>($($arg),*),
            (_, 16) => $function::<8, 16>($($arg),*),
            (_, 8) => $function::<8, 8>($($arg),*),
            (_, 4) => $function::<8, 4>($($arg),*),
            (_, _) => $function::<8, 1>($($arg),*),
        }
    };
}
use specialize;
