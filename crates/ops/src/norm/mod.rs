//! Normalisation layers as functions: layer norm, RMS norm, group norm.

mod group;
mod last_axis;
mod modulated;

use crate::fused::{sum, sum_of_squares};

pub use group::{group_norm, group_norm_silu};
pub use last_axis::{layer_norm, rms_norm};
pub use modulated::modulated_layer_norm;

/// Mean of `x` and of the squared distance from it (or from 0 where `centred` is false, with mean 0).
///
/// Two passes, each summed in f32 lanes over blocks and in f64 over the blocks: no cancellation, and no loss of digits in
/// large groups.
#[inline(always)]
fn moments(x: &[f32], centred: bool) -> (f32, f32) {
    const BLOCK: usize = 4096;
    let count = x.len() as f64;
    let mean = if centred { (x.chunks(BLOCK).map(|block| sum(block) as f64).sum::<f64>() / count) as f32 } else { 0.0 };
    let squares = x.chunks(BLOCK).map(|block| sum_of_squares(block, mean) as f64).sum::<f64>();
    (mean, (squares / count) as f32)
}
