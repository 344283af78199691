//! Forward pass, parallel over chunks of queries.

use rayon::prelude::*;

use crate::fused::vectorized;

use super::corners::{Corners, position};
use super::{Deformable, specialize};

/// Queries per task: enough to make a task worth its start, few enough for many cores.
const CHUNK: usize = 128;

pub(super) fn forward(kernel: &Deformable, values: &[f32], offsets: &[f32], weights: &[f32]) -> Vec<f32> {
    let width = kernel.size.m * kernel.size.c;
    let mut output = vec![0.0; kernel.size.n * kernel.size.q * width];
    if output.is_empty() {
        return output;
    }
    let items = output.par_chunks_exact_mut(kernel.size.q * width).enumerate();
    items.for_each(|(n, item)| {
        let chunks = item.par_chunks_mut(CHUNK * width).enumerate();
        chunks.for_each(|(chunk, out)| {
            specialize!(kernel, forward_chunk(kernel, values, offsets, weights, n, chunk * CHUNK, out));
        });
    });
    output
}

vectorized! {
    /// Output of the queries that start at `first`, all views of batch item `n`.
    fn forward_chunk[const K: usize, const C: usize](
        kernel: &Deformable,
        values: &[f32],
        offsets: &[f32],
        weights: &[f32],
        n: usize,
        first: usize,
        out: &mut [f32],
    ) {
        let size = kernel.size;
        let c = if C == 0 { size.c } else { C };
        let axes = kernel.axes;
        let points = size.m * kernel.levels() * size.p;
        let last = first + out.len() / (size.m * c);
        for v in 0..size.v {
            let view = n * size.v + v;
            let map = &values[view * size.s * size.m * c..][..size.s * size.m * c];
            for &q in kernel.seen.range(view, first, last) {
                let q = q as usize;
                let row = n * size.q + q;
                let share = kernel.seen.share[row];
                let reference = &kernel.reference[(view * size.q + q) * axes..][..axes];
                let out = &mut out[(q - first) * size.m * c..][..size.m * c];
                let offsets = &offsets[row * points * axes..][..points * axes];
                let weights = &weights[row * points..][..points];
                for (m, out) in out.chunks_exact_mut(c).enumerate() {
                    for (l, &extent) in kernel.sites.extents.iter().enumerate() {
                        let start = kernel.sites.starts[l];
                        for p in 0..size.p {
                            let point = (m * kernel.levels() + l) * size.p + p;
                            let offset = &offsets[point * axes..][..axes];
                            let position = position::<K>(reference, offset, extent, kernel.sites.centre);
                            let Some(corners) = Corners::<K>::new(position, extent) else { continue };
                            let scale = weights[point] * share;
                            add_sample::<K>(map, &corners, start, scale, size.m, m, out);
                        }
                    }
                }
            }
        }
    }
}

/// Adds `scale` times the linear sample of head `m` to `out`.
#[inline(always)]
fn add_sample<const K: usize>(
    map: &[f32],
    corners: &Corners<K>,
    start: usize,
    scale: f32,
    heads: usize,
    m: usize,
    out: &mut [f32],
) {
    let c = out.len();
    let rows: [&[f32]; K] = std::array::from_fn(|k| &map[((start + corners.site[k]) * heads + m) * c..][..c]);
    let weight = corners.weight.map(|weight| weight * scale);
    for i in 0..c {
        let mut sum = weight[0] * rows[0][i];
        for k in 1..K {
            sum += weight[k] * rows[k][i];
        }
        out[i] += sum;
    }
}
