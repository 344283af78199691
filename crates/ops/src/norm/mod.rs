//! Normalisation layers as functions: layer norm, RMS norm, group norm.

mod group;
mod last_axis;

pub use group::{group_norm, group_norm_silu};
pub use last_axis::{layer_norm, rms_norm};

/// Mean of `x` and of the squared distance from it (or from 0 where `centred` is false, with mean 0).
///
/// Two passes, each summed in f32 lanes over blocks and in f64 over the blocks: no cancellation, and no loss of digits in
/// large groups.
#[inline(always)]
fn moments(x: &[f32], centred: bool) -> (f32, f32) {
    use crate::fused::sum;
    const BLOCK: usize = 4096;
    let count = x.len() as f64;
    let mean = if centred { (x.chunks(BLOCK).map(|block| sum(block) as f64).sum::<f64>() / count) as f32 } else { 0.0 };
    let squares = x.chunks(BLOCK).map(|block| squared_distance(block, mean) as f64).sum::<f64>();
    (mean, (squares / count) as f32)
}

/// Sum of `(x - mean)²`, in 16 interleaved partial sums.
#[inline(always)]
fn squared_distance(x: &[f32], mean: f32) -> f32 {
    const LANES: usize = 16;
    let (blocks, rest) = x.as_chunks::<LANES>();
    let mut lanes = [0.0f32; LANES];
    for block in blocks {
        for i in 0..LANES {
            let centred = block[i] - mean;
            lanes[i] += centred * centred;
        }
    }
    for (lane, &value) in lanes.iter_mut().zip(rest) {
        let centred = value - mean;
        *lane += centred * centred;
    }
    crate::fused::sum(&lanes)
}
