//! Forward pass, parallel over chunks of queries.

use rayon::prelude::*;

use crate::fused::vectorized;

use super::batch::{Batch, POINTS};
use super::{Deformable, Place, specialize};

/// Queries per task: enough to make a task worth its start, few enough for many cores.
const CHUNK: usize = 512;

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
    fn forward_chunk[const K: usize, const W: usize](
        kernel: &Deformable,
        values: &[f32],
        offsets: &[f32],
        weights: &[f32],
        n: usize,
        first: usize,
        out: &mut [f32],
    ) {
        let size = kernel.size;
        let blocks = size.c / W;
        let last = first + out.len() / (size.m * size.c);
        let (out, _) = out.as_chunks_mut::<W>();
        let mut batch = Batch::<K>::new();
        for v in 0..size.v {
            for head in 0..size.m {
                for level in 0..kernel.levels() {
                    let place = Place { n, v, level, head };
                    let map = kernel.map::<W>(values, place);
                    for run in kernel.runs(place, first, last) {
                        kernel.fill(&mut batch, offsets, &run, size.m * blocks);
                        let mut i = 0;
                        for &q in run.queries {
                            let q = q as usize;
                            let share = kernel.seen.share[n * size.q + q];
                            let point = kernel.point(&run, q);
                            let out = &mut out[((q - first) * size.m + head) * blocks..][..blocks];
                            for &weight in &weights[point..][..run.points] {
                                add_sample(map, &batch, i, weight * share, out);
                                i += 1;
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Adds `scale` times the linear sample at point `i` of the batch to the channel blocks `out`.
#[inline(always)]
fn add_sample<const K: usize, const W: usize>(
    map: &[[f32; W]],
    batch: &Batch<K>,
    i: usize,
    scale: f32,
    out: &mut [[f32; W]],
) {
    debug_assert!(i < POINTS);
    let weight: [f32; K] = std::array::from_fn(|k| batch.weight[k][i] * scale);
    for (b, out) in out.iter_mut().enumerate() {
        for k in 0..K {
            let value = &map[batch.row[k][i] as usize + b];
            for j in 0..W {
                out[j] += weight[k] * value[j];
            }
        }
    }
}
