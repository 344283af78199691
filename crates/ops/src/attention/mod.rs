//! Scaled dot-product attention.

mod core;
mod kernel;
mod packed;

use burn::tensor::{Bool, Tensor};

use crate::fused::{fused_3, on_flex};
use crate::softmax;
use kernel::{Attention, Mask};

pub use packed::rotary_attention;

/// Score of a key that may not be attended; far below any real score, and finite so that no row becomes NaN.
const MASKED_SCORE: f32 = -1e30;

/// Scaled dot-product attention, `softmax(q·kᵀ / √D)·v` over the keys that the mask admits.
///
/// A query without any key gives 0, and zero gradients. On the CPU backend neither way keeps a table of all scores: they are computed again,
/// for a few queries at a time, when gradients are taken.
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
    if let Some(mask) = &mask {
        let fits = mask.dims().into_iter().zip([b, h, n, keys]).all(|(given, full)| given == full || given == 1);
        assert!(fits, "mask {:?} does not broadcast to {:?}", mask.dims(), [b, h, n, keys]);
    }
    if on_flex(&q) {
        let kernel =
            Attention { heads: [b, h], sizes: [n, keys, d, v.dims()[3]], mask: mask.map(|m| Mask::new(m, keys)) };
        return fused_3(kernel, q, k, v);
    }
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
