//! Reference implementation from burn's tensor operations, for every backend.
//!
//! Corners are gathered with `select` along one flattened axis: its gradient is an ordered sum on every backend, while
//! the gradient of `gather_nd` races on GPUs.

use burn::tensor::{Int, Tensor};

use super::core::{Levels, Sampling};
use crate::sum_dim;

/// The two neighbours of every point along one axis.
struct Neighbours {
    /// Clamped pixel index `[N, V, Q, M, P]` of the lower and the upper neighbour.
    index: [Tensor<5, Int>; 2],
    /// Linear weight `[N, V, Q, M, P]`, zero where the neighbour lies outside the map.
    weight: [Tensor<5>; 2],
}

/// See [`super::core::sample_views`].
pub(super) fn sample_views(levels: &Levels, sampling: Sampling) -> Tensor<3> {
    let [n, v, s, m, c] = sampling.values.dims();
    let q = sampling.offsets.dims()[1];
    let table = sampling.values.clone().reshape([n * v * s * m, c]);
    let visible = sampling.visible.clone().float();
    let seen = sum_dim(visible.clone(), 1).clamp_min(1.0).reshape([n, q, 1]);
    let mut total: Option<Tensor<5>> = None;
    for level in 0..levels.extents.len() {
        let sum = sample_level(levels, level, &sampling, &table);
        total = Some(match total {
            Some(total) => total + sum,
            None => sum,
        });
    }
    let total = total.expect("a value tensor has at least one level");
    let total = total * visible.reshape([n, v, q, 1, 1]);
    sum_dim(total, 1).reshape([n, q, m * c]) / seen
}

/// Weighted sum over the points of one level, per view: `[N, V, Q, M, C]`.
fn sample_level(levels: &Levels, level: usize, sampling: &Sampling, table: &Tensor<2>) -> Tensor<5> {
    let [n, v, s, m, c] = sampling.values.dims();
    let [_, q, _, _, p, _] = sampling.offsets.dims();
    let neighbours: Vec<Neighbours> = (0..levels.axes).map(|axis| neighbours(levels, level, axis, sampling)).collect();
    let attention = sampling.weights.clone().narrow(3, level, 1).reshape([n, 1, q, m, p]);
    let first = first_row(levels, level, sampling);
    let mut sum: Option<Tensor<5>> = None;
    for corner in 0..1usize << levels.axes {
        let mut weight = attention.clone();
        let mut site: Option<Tensor<5, Int>> = None;
        let mut stride = 1;
        for (axis, near) in neighbours.iter().enumerate() {
            let upper = corner >> axis & 1;
            weight = weight * near.weight[upper].clone();
            let step = near.index[upper].clone() * stride as i32;
            site = Some(match site {
                Some(site) => site + step,
                None => step,
            });
            stride *= levels.extents[level][axis];
        }
        let site = site.expect("a point has at least two axes");
        let row = site * m as i32 + first.clone();
        let value = table.clone().select(0, row.reshape([n * v * q * m * p]));
        let part = value.reshape([n * v * q * m, p, c]) * weight.reshape([n * v * q * m, p, 1]);
        let part = sum_dim(part, 1).reshape([n, v, q, m, c]);
        sum = Some(match sum {
            Some(sum) => sum + part,
            None => part,
        });
    }
    debug_assert_eq!(s, levels.total());
    sum.expect("a point has at least four corners")
}

/// Row of the flattened value table where the level of each view and head begins: `[N, V, 1, M, 1]`.
fn first_row(levels: &Levels, level: usize, sampling: &Sampling) -> Tensor<5, Int> {
    let [n, v, s, m, _] = sampling.values.dims();
    let device = sampling.values.device();
    let view = Tensor::<1, Int>::arange(0..(n * v) as i64, &device).reshape([n, v, 1, 1, 1]);
    let head = Tensor::<1, Int>::arange(0..m as i64, &device).reshape([1, 1, 1, m, 1]);
    (view * s as i32 + levels.start(level) as i32) * m as i32 + head
}

fn neighbours(levels: &Levels, level: usize, axis: usize, sampling: &Sampling) -> Neighbours {
    let [n, v, q, _] = sampling.reference.dims();
    let [_, _, m, _, p, _] = sampling.offsets.dims();
    let size = levels.extents[level][axis];
    let reference = sampling.reference.clone().detach().narrow(3, axis, 1).reshape([n, v, q, 1, 1]);
    let offset = sampling.offsets.clone().narrow(3, level, 1).narrow(5, axis, 1).reshape([n, 1, q, m, p]);
    let pixel = reference * size as f32 + offset - levels.centre;
    let lower = pixel.clone().detach().floor();
    let fraction = pixel - lower.clone();
    // Far points have weight 0 on both sides; the clamp keeps the conversion to integers defined.
    let lower = lower.clamp(-2.0, size as f32);
    let weights = [-fraction.clone() + 1.0, fraction];
    let last = (size - 1) as f32;
    let mut upper = 0.0;
    let mut index = Vec::with_capacity(2);
    let weight = weights.map(|weight| {
        let position = lower.clone() + upper;
        upper += 1.0;
        index.push(position.clone().clamp(0.0, last).int());
        // Two comparisons rather than one with the clamped position: NaN passes both and stays visible.
        let outside = position.clone().lower_elem(0.0).bool_or(position.greater_elem(last));
        weight.mask_fill(outside, 0.0)
    });
    let [first, second] = <[_; 2]>::try_from(index).unwrap_or_else(|_| unreachable!("one index per neighbour"));
    Neighbours { index: [first, second], weight }
}
