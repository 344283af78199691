//! Attention over `[B, H, N, D]` tensors.

use std::borrow::Cow;

use burn::tensor::{Bool, Tensor};
use rayon::prelude::*;

use super::core::{Head, HeadGradients, attend, attend_backward};
use crate::fused::Kernel;
use crate::product::Matrix;

/// Queries of a part of a head. Fixed, because the gradients of keys and values are summed over parts, which neither the number of threads nor
/// that of batch items may change.
const PART: usize = 512;

/// Inputs: q, k, v.
#[derive(Debug)]
pub(super) struct Attention {
    /// Batch and heads.
    pub heads: [usize; 2],
    /// Queries, keys, width of q and k, width of v.
    pub sizes: [usize; 4],
    pub mask: Option<Mask>,
}

/// Admitted keys `[B or 1, H or 1, N or 1, K]`.
#[derive(Debug)]
pub(super) struct Mask {
    values: Vec<bool>,
    dims: [usize; 3],
    keys: usize,
}

impl Mask {
    pub fn new(mask: Tensor<4, Bool>, keys: usize) -> Self {
        let [b, h, n, _] = mask.dims();
        let mask = if mask.dims()[3] == keys { mask } else { mask.expand([b, h, n, keys]) };
        let values = mask.into_data().convert::<bool>();
        let values = values.try_to_vec::<bool>().expect("a tensor of truth values");
        Self { values, dims: [b, h, n], keys }
    }

    fn row(&self, at: [usize; 3]) -> &[bool] {
        let row = at.into_iter().zip(self.dims).fold(0, |row, (i, size)| row * size + if size == 1 { 0 } else { i });
        &self.values[row * self.keys..][..self.keys]
    }
}

impl Attention {
    fn head<'a>(&self, [q, k, v]: [&'a [f32]; 3], at: usize) -> Head<'a> {
        let [n, keys, d, e] = self.sizes;
        Head {
            q: Matrix::row_major(&q[at * n * d..][..n * d], n, d),
            k: Matrix::row_major(&k[at * keys * d..][..keys * d], keys, d),
            v: Matrix::row_major(&v[at * keys * e..][..keys * e], keys, e),
        }
    }

    fn admitted(&self, head: usize, query: usize) -> Option<&[bool]> {
        let h = self.heads[1];
        self.mask.as_ref().map(|mask| mask.row([head / h, head % h, query]))
    }
}

impl Kernel<3> for Attention {
    fn output_shape(&self) -> Vec<usize> {
        let ([b, h], [n, _, _, e]) = (self.heads, self.sizes);
        vec![b, h, n, e]
    }

    fn forward(&self, inputs: [&[f32]; 3]) -> Vec<f32> {
        let [n, _, _, e] = self.sizes;
        let mut out = vec![0.0; self.output_shape().iter().product()];
        out.par_chunks_mut((n * e).max(1)).enumerate().for_each(|(at, out)| {
            let head = self.head(inputs, at);
            out.par_chunks_mut((PART * e).max(1)).enumerate().for_each(|(i, out)| {
                let first = i * PART;
                attend(head, &|query| self.admitted(at, query), first, n.min(first + PART), out);
            });
        });
        out
    }

    fn backward(&self, inputs: [&[f32]; 3], upstream: Cow<'_, [f32]>, _wanted: [bool; 3]) -> [Option<Vec<f32>>; 3] {
        let ([b, h], [n, keys, d, e]) = (self.heads, self.sizes);
        let mut gradients = [b * h * n * d, b * h * keys * d, b * h * keys * e].map(|length| vec![0.0; length]);
        let [dq, dk, dv] = &mut gradients;
        let chunks = dq.par_chunks_mut((n * d).max(1)).zip(dk.par_chunks_mut((keys * d).max(1)));
        let chunks = chunks.zip(dv.par_chunks_mut((keys * e).max(1))).enumerate();
        chunks.for_each(|(at, ((dq, dk), dv))| {
            let head = self.head(inputs, at);
            let parts: Vec<HeadGradients> = (0..n.div_ceil(PART))
                .into_par_iter()
                .map(|i| {
                    let (first, last) = (i * PART, n.min((i + 1) * PART));
                    let upstream = &upstream[(at * n + first) * e..][..(last - first) * e];
                    let upstream = Matrix::row_major(upstream, last - first, e);
                    attend_backward(head, &|query| self.admitted(at, query), first, last, upstream)
                })
                .collect();
            for (i, from) in parts.into_iter().enumerate() {
                dq[i * PART * d..][..from.q.len()].copy_from_slice(&from.q);
                dk.iter_mut().zip(from.k).for_each(|(total, part)| *total += part);
                dv.iter_mut().zip(from.v).for_each(|(total, part)| *total += part);
            }
        });
        gradients.map(Some)
    }
}
