//! Scaled dot-product attention.

use burn::tensor::{Bool, Tensor};

use crate::softmax;

/// Score of a key that may not be attended; far below any real score, and finite so that no row becomes NaN.
const MASKED_SCORE: f32 = -1e30;

/// Scaled dot-product attention, `softmax(q·kᵀ / √D)·v` over the keys that the mask admits.
///
/// A query without any key gives 0, and zero gradients.
///
/// # Shapes
/// - q: `[B, H, N, D]`
/// - k: `[B, H, K, D]`
/// - v: `[B, H, K, E]`
/// - mask: broadcasts to `[B, H, N, K]`, true where the key may be attended
/// - output: `[B, H, N, E]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn attention(q: Tensor<4>, k: Tensor<4>, v: Tensor<4>, mask: Option<Tensor<4, Bool>>) -> Tensor<4> {
    let [b, h, n, d] = q.dims();
    let keys = k.dims()[2];
    assert_eq!(k.dims(), [b, h, keys, d], "keys [B, H, K, D]");
    assert_eq!(v.dims()[..3], [b, h, keys], "values [B, H, K, E]");
    let scale = 1.0 / (d as f32).sqrt();
    let scores = (q * scale).matmul(k.swap_dims(2, 3));
    let probabilities = match mask {
        None => softmax(scores),
        Some(mask) => {
            let masked = mask.bool_not().expand([b, h, n, keys]);
            let probabilities = softmax(scores.mask_fill(masked.clone(), MASKED_SCORE));
            probabilities.mask_fill(masked, 0.0)
        }
    };
    probabilities.matmul(v)
}
