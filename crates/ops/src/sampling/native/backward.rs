//! Backward pass.
//!
//! A task owns one (batch item, level, head) and a run of queries: it alone writes the gradients of its offsets and weights,
//! and it adds value gradients into a buffer of its own. The buffers are added afterwards in a fixed order. How queries are
//! cut into runs depends on the sizes only, so the result has the same bits on any number of threads.

use rayon::prelude::*;

use crate::fused::{sum_of_products, vectorized};

use super::batch::{Batch, POINTS};
use super::{Deformable, Place, Run, Size, specialize};

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
    fn run[const K: usize, const W: usize](kernel: &Deformable, inputs: &Inputs<'_>, task: Task) -> Part {
        let Size { v: views, q: queries, m: heads, c, p, .. } = kernel.size;
        let Task { n, level, head, first, last } = task;
        let sites = kernel.sites.counts[level];
        let length = |wanted: bool, length: usize| if wanted { length } else { 0 };
        let mut part = Part {
            values: vec![0.0; length(inputs.wanted[0], views * sites * c)],
            offsets: vec![0.0; length(inputs.wanted[1], (last - first) * p * kernel.axes)],
            weights: vec![0.0; length(inputs.wanted[2], (last - first) * p)],
        };
        let mut batch = Batch::<K>::new();
        let mut gradient = vec![[0.0; W]; c / W];
        for v in 0..views {
            let place = Place { n, v, level, head };
            let map = kernel.map::<W>(inputs.values, place);
            let length = length(inputs.wanted[0], sites * c);
            let (buffer, _) = part.values[v * length..][..length].as_chunks_mut::<W>();
            for run in kernel.runs(place, first, last) {
                kernel.fill(&mut batch, inputs.offsets, &run, c / W);
                let mut corner = [[0.0; POINTS]; K];
                let mut i = 0;
                for &q in run.queries {
                    let row = n * queries + q as usize;
                    let upstream = inputs.upstream[(row * heads + head) * c..][..c].as_chunks::<W>().0;
                    for (gradient, upstream) in gradient.iter_mut().zip(upstream) {
                        *gradient = upstream.map(|x| x * kernel.seen.share[row]);
                    }
                    for &weight in &inputs.weights[kernel.point(&run, q as usize)..][..run.points] {
                        if inputs.wanted[0] {
                            add_to_corners(buffer, &batch, i, weight, &gradient);
                        }
                        for k in 0..K {
                            corner[k][i] = product_with_row(map, batch.row[k][i] as usize * heads, &gradient);
                        }
                        i += 1;
                    }
                }
                add_to_points(kernel, &batch, &corner, inputs, &run, first, &mut part.offsets, &mut part.weights);
            }
        }
        part
    }
}

/// Gradient times the value at one corner.
#[inline(always)]
fn product_with_row<const W: usize>(map: &[[f32; W]], row: usize, gradient: &[[f32; W]]) -> f32 {
    let mut total = 0.0;
    for (b, gradient) in gradient.iter().enumerate() {
        total += sum_of_products(gradient, &map[row + b]);
    }
    total
}

/// Adds `scale · gradient` to the sites of the corners of point `i`, each by its linear weight.
#[inline(always)]
fn add_to_corners<const K: usize, const W: usize>(
    buffer: &mut [[f32; W]],
    batch: &Batch<K>,
    i: usize,
    scale: f32,
    gradient: &[[f32; W]],
) {
    for k in 0..K {
        let weight = batch.weight[k][i] * scale;
        let row = batch.row[k][i] as usize;
        for (b, gradient) in gradient.iter().enumerate() {
            let site = &mut buffer[row + b];
            for j in 0..W {
                site[j] += weight * gradient[j];
            }
        }
    }
}

/// Adds the gradients of a run's offsets and weights, given the products of gradient and corner values.
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn add_to_points<const K: usize>(
    kernel: &Deformable,
    batch: &Batch<K>,
    corner: &[[f32; POINTS]; K],
    inputs: &Inputs<'_>,
    run: &Run<'_>,
    first: usize,
    offsets: &mut [f32],
    weights: &mut [f32],
) {
    let axes = Batch::<K>::AXES;
    let samples = batch.samples(corner);
    let slopes: [[f32; POINTS]; 3] =
        std::array::from_fn(|a| if a < axes { batch.slopes(a, corner) } else { [0.0; POINTS] });
    let mut i = 0;
    for &q in run.queries {
        let weight = &inputs.weights[kernel.point(run, q as usize)..][..run.points];
        let at = (q as usize - first) * kernel.size.p + run.first;
        for (j, &weight) in weight.iter().enumerate() {
            if inputs.wanted[1] {
                for a in 0..axes {
                    offsets[(at + j) * axes + a] += weight * slopes[a][i];
                }
            }
            if inputs.wanted[2] {
                weights[at + j] += samples[i];
            }
            i += 1;
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
