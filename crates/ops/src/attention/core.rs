//! Attention of one head over matrices, forward and backward, for a few queries at a time.

use crate::fused::{exp_difference, largest, sum, sum_of_products, vectorized};
use crate::product::{Matrix, MatrixMut, Old, product};

/// Queries whose scores are held at a time.
const TILE: usize = 64;

/// Queries, keys and values of one head: `[N, D]`, `[K, D]`, `[K, E]`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Head<'a> {
    pub q: Matrix<'a>,
    pub k: Matrix<'a>,
    pub v: Matrix<'a>,
}

/// Gradients of one head, row-major.
#[derive(Debug, Clone)]
pub(super) struct HeadGradients {
    pub q: Vec<f32>,
    pub k: Vec<f32>,
    pub v: Vec<f32>,
}

/// Which keys a query may attend; `None` where it may attend all.
pub(super) type Admitted<'a> = &'a (dyn Fn(usize) -> Option<&'a [bool]> + Sync);

/// The probabilities `[count, K]` of the queries from `first` on.
fn probabilities(head: Head<'_>, admitted: Admitted<'_>, first: usize, count: usize, scores: &mut [f32]) {
    let keys = head.k.rows;
    let scale = 1.0 / (head.q.columns as f32).sqrt();
    let out = MatrixMut::row_major(scores, count, keys);
    product(out, head.q.rows_at(first, count), head.k.transposed(), scale, Old::Replaced);
    for (i, row) in scores.chunks_exact_mut(keys).enumerate() {
        match admitted(first + i) {
            None => softmax_row(row),
            Some(admitted) => masked_softmax_row(row, admitted),
        }
    }
}

/// Writes the outputs of the queries `first..last`, `[last - first, E]` row-major.
pub(super) fn attend(head: Head<'_>, admitted: Admitted<'_>, first: usize, last: usize, out: &mut [f32]) {
    let (keys, width) = (head.k.rows, head.v.columns);
    if keys == 0 || width == 0 {
        return;
    }
    let mut scores = vec![0.0; TILE.min(last - first) * keys];
    for (tile, out) in out.chunks_mut(TILE * width).enumerate() {
        let count = out.len() / width;
        let scores = &mut scores[..count * keys];
        probabilities(head, admitted, first + tile * TILE, count, scores);
        let scores = Matrix::row_major(scores, count, keys);
        product(MatrixMut::row_major(out, count, width), scores, head.v, 1.0, Old::Replaced);
    }
}

/// Gradients through the queries `first..last`: theirs, and their part of the keys' and values'.
///
/// With P the probabilities and g the upstream gradient: `dV = Pᵀg`, `dP = gVᵀ`, `dS = P·(dP - Σ P·dP)`, `dQ = s·dS K`, `dK = s·dSᵀQ`.
pub(super) fn attend_backward(
    head: Head<'_>,
    admitted: Admitted<'_>,
    first: usize,
    last: usize,
    upstream: Matrix<'_>,
) -> HeadGradients {
    let (keys, d, width) = (head.k.rows, head.q.columns, head.v.columns);
    let scale = 1.0 / (d as f32).sqrt();
    let mut gradients =
        HeadGradients { q: vec![0.0; (last - first) * d], k: vec![0.0; keys * d], v: vec![0.0; keys * width] };
    if keys == 0 {
        return gradients;
    }
    let capacity = TILE.min(last - first) * keys;
    let (mut scores, mut changes) = (vec![0.0; capacity], vec![0.0; capacity]);
    for from in (first..last).step_by(TILE) {
        let count = TILE.min(last - from);
        let (scores, changes) = (&mut scores[..count * keys], &mut changes[..count * keys]);
        probabilities(head, admitted, from, count, scores);
        let g = upstream.rows_at(from - first, count);
        let p = Matrix::row_major(scores, count, keys);
        product(MatrixMut::row_major(&mut gradients.v, keys, width), p.transposed(), g, 1.0, Old::Kept);
        product(MatrixMut::row_major(changes, count, keys), g, head.v.transposed(), 1.0, Old::Replaced);
        for (change, p) in changes.chunks_exact_mut(keys).zip(scores.chunks_exact(keys)) {
            softmax_row_backward(p, change);
        }
        let ds = Matrix::row_major(changes, count, keys);
        let dq = &mut gradients.q[(from - first) * d..][..count * d];
        product(MatrixMut::row_major(dq, count, d), ds, head.k, scale, Old::Replaced);
        let q = head.q.rows_at(from, count);
        product(MatrixMut::row_major(&mut gradients.k, keys, d), ds.transposed(), q, scale, Old::Kept);
    }
    gradients
}

vectorized! {
    fn softmax_row[](row: &mut [f32]) {
        let largest = largest(row);
        for x in row.iter_mut() {
            *x = exp_difference(*x - largest, 0.0);
        }
        let scale = 1.0 / sum(row);
        for x in row {
            *x *= scale;
        }
    }
}

vectorized! {
    /// Zeros where no key is admitted, so also in a row without any.
    fn masked_softmax_row[](row: &mut [f32], admitted: &[bool]) {
        let mut largest = f32::NEG_INFINITY;
        for (&x, &admitted) in row.iter().zip(admitted) {
            largest = if admitted && x > largest { x } else { largest };
        }
        for (x, &admitted) in row.iter_mut().zip(admitted) {
            *x = if admitted { exp_difference(*x - largest, 0.0) } else { 0.0 };
        }
        let total = sum(row);
        let scale = if total == 0.0 { 0.0 } else { 1.0 / total };
        for x in row {
            *x *= scale;
        }
    }
}

vectorized! {
    /// `p·(change - Σ p·change)` in the place of `change`.
    fn softmax_row_backward[](p: &[f32], change: &mut [f32]) {
        let mean = sum_of_products(p, change);
        for (change, &p) in change.iter_mut().zip(p) {
            *change = p * (*change - mean);
        }
    }
}
