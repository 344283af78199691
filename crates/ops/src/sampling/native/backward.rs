//! Backward pass.
//!
//! A task owns one (batch item, level, head) and a run of queries: it alone writes the gradients of its offsets and weights,
//! and it adds value gradients into a buffer of its own. The buffers are added afterwards in a fixed order. How queries are
//! cut into runs depends on the sizes only, so the result has the same bits on any number of threads.

use rayon::prelude::*;

use crate::fused::{sum_of_products, vectorized};

use super::corners::{Corners, position};
use super::{Deformable, Size, specialize};

/// Tasks wanted, to keep a large machine busy.
const TASKS: usize = 32;
/// Queries per run below which another value buffer costs more than it gains.
const SHORTEST_RUN: usize = 1024;

/// Gradients of one task; buffers that nobody wants are empty.
struct Part {
    /// `[V, sites of the level, C]`
    values: Vec<f32>,
    /// `[queries, P, d]`
    offsets: Vec<f32>,
    /// `[queries, P]`
    weights: Vec<f32>,
}

/// What a task works on.
#[derive(Clone, Copy)]
struct Task {
    n: usize,
    level: usize,
    head: usize,
    first: usize,
    last: usize,
}

/// Values, offsets, weights and the output's gradient.
struct Inputs<'a> {
    values: &'a [f32],
    offsets: &'a [f32],
    weights: &'a [f32],
    upstream: &'a [f32],
    wanted: [bool; 3],
}

pub(super) fn backward(
    kernel: &Deformable,
    [values, offsets, weights]: [&[f32]; 3],
    upstream: &[f32],
    wanted: [bool; 3],
) -> [Option<Vec<f32>>; 3] {
    let inputs = Inputs { values, offsets, weights, upstream, wanted };
    let tasks = tasks(kernel);
    let parts: Vec<Part> = tasks.par_iter().map(|&task| specialize!(kernel, run(kernel, &inputs, task))).collect();
    let Size { n, v, s, m, c, .. } = kernel.size;
    let values = wanted[0].then(|| gather_values(kernel, &tasks, &parts, vec![0.0; n * v * s * m * c]));
    let offsets = wanted[1].then(|| gather_points(kernel, &tasks, &parts, kernel.axes, |part| &part.offsets));
    let weights = wanted[2].then(|| gather_points(kernel, &tasks, &parts, 1, |part| &part.weights));
    [values, offsets, weights]
}

/// Tasks in the order (batch item, level, head, run of queries).
fn tasks(kernel: &Deformable) -> Vec<Task> {
    let Size { n: items, m: heads, q, .. } = kernel.size;
    let slices = items * kernel.levels() * heads;
    let runs = TASKS.div_ceil(slices.max(1)).min(q.div_ceil(SHORTEST_RUN)).max(1);
    let length = q.div_ceil(runs);
    let mut tasks = Vec::with_capacity(slices * runs);
    for n in 0..items {
        for level in 0..kernel.levels() {
            for head in 0..heads {
                for run in 0..runs {
                    let (first, last) = ((run * length).min(q), ((run + 1) * length).min(q));
                    tasks.push(Task { n, level, head, first, last });
                }
            }
        }
    }
    tasks
}

vectorized! {
    fn run[const K: usize, const C: usize](kernel: &Deformable, inputs: &Inputs<'_>, task: Task) -> Part {
        let size = kernel.size;
        let c = if C == 0 { size.c } else { C };
        let axes = kernel.axes;
        let Task { n, level, head, first, last } = task;
        let (extent, start, sites) =
            (kernel.sites.extents[level], kernel.sites.starts[level], kernel.sites.counts[level]);
        let length = |wanted: bool, length: usize| if wanted { length } else { 0 };
        let mut part = Part {
            values: vec![0.0; length(inputs.wanted[0], size.v * sites * c)],
            offsets: vec![0.0; length(inputs.wanted[1], (last - first) * size.p * axes)],
            weights: vec![0.0; length(inputs.wanted[2], (last - first) * size.p)],
        };
        let points_wanted = inputs.wanted[1] || inputs.wanted[2];
        let mut gradient = vec![0.0f32; c];
        for v in 0..size.v {
            let view = n * size.v + v;
            let map = &inputs.values[view * size.s * size.m * c..][..size.s * size.m * c];
            for &q in kernel.seen.range(view, first, last) {
                let q = q as usize;
                let row = n * size.q + q;
                let upstream = &inputs.upstream[(row * size.m + head) * c..][..c];
                for i in 0..c {
                    gradient[i] = upstream[i] * kernel.seen.share[row];
                }
                let gradient = &gradient[..c];
                let reference = &kernel.reference[(view * size.q + q) * axes..][..axes];
                for p in 0..size.p {
                    let point = ((row * size.m + head) * kernel.levels() + level) * size.p + p;
                    let offset = &inputs.offsets[point * axes..][..axes];
                    let position = position::<K>(reference, offset, extent, kernel.sites.centre);
                    let Some(corners) = Corners::<K>::new(position, extent) else { continue };
                    let weight = inputs.weights[point];
                    if inputs.wanted[0] {
                        let buffer = &mut part.values[v * sites * c..][..sites * c];
                        add_to_corners::<K>(buffer, &corners, weight, gradient);
                    }
                    if points_wanted {
                        let corner: [f32; K] = std::array::from_fn(|k| {
                            let value = &map[((start + corners.site[k]) * size.m + head) * c..][..c];
                            sum_of_products(gradient, value)
                        });
                        let at = (q - first) * size.p + p;
                        if inputs.wanted[1] {
                            for a in 0..axes {
                                part.offsets[at * axes + a] += weight * corners.slope(a, &corner);
                            }
                        }
                        if inputs.wanted[2] {
                            part.weights[at] += sum_of_products(&corners.weight, &corner);
                        }
                    }
                }
            }
        }
        part
    }
}

/// Adds `scale · gradient` to the corners' sites, each by its linear weight.
#[inline(always)]
fn add_to_corners<const K: usize>(buffer: &mut [f32], corners: &Corners<K>, scale: f32, gradient: &[f32]) {
    let c = gradient.len();
    for k in 0..K {
        let weight = corners.weight[k] * scale;
        let site = &mut buffer[corners.site[k] * c..][..c];
        for i in 0..c {
            site[i] += weight * gradient[i];
        }
    }
}

/// Adds the value buffers into `[N, V, S, M, C]`, in parallel over batch items and views.
fn gather_values(kernel: &Deformable, tasks: &[Task], parts: &[Part], mut total: Vec<f32>) -> Vec<f32> {
    let Size { v: views, s, m: heads, c, .. } = kernel.size;
    total.par_chunks_mut((s * heads * c).max(1)).enumerate().for_each(|(view, total)| {
        let (n, v) = (view / views, view % views);
        for (task, part) in tasks.iter().zip(parts).filter(|(task, _)| task.n == n) {
            let (start, sites) = (kernel.sites.starts[task.level], kernel.sites.counts[task.level]);
            let buffer = &part.values[v * sites * c..][..sites * c];
            for (site, row) in buffer.chunks_exact(c).enumerate() {
                let target = &mut total[((start + site) * heads + task.head) * c..][..c];
                for (target, value) in target.iter_mut().zip(row) {
                    *target += value;
                }
            }
        }
    });
    total
}

/// Puts per-point gradients of width `width` in the order `[N, Q, M, L, P, width]`.
fn gather_points<'a>(
    kernel: &Deformable,
    tasks: &[Task],
    parts: &'a [Part],
    width: usize,
    buffer: impl Fn(&'a Part) -> &'a Vec<f32>,
) -> Vec<f32> {
    let Size { n, m: heads, q, p, .. } = kernel.size;
    let row = p * width;
    let mut total = vec![0.0; n * q * heads * kernel.levels() * row];
    for (task, part) in tasks.iter().zip(parts) {
        for (i, source) in buffer(part).chunks_exact(row.max(1)).enumerate() {
            let at = (((task.n * q) + task.first + i) * heads + task.head) * kernel.levels() + task.level;
            total[at * row..][..row].copy_from_slice(source);
        }
    }
    total
}
