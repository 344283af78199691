//! Differentiable tensor operations that burn lacks, with kernels per backend.
//!
//! Every operation is a composition of burn's tensor operations that runs and differentiates on each backend, and most
//! have a fused kernel for the CPU backend (`flex`) beside it. Which one runs is decided at run time from the device of
//! the arguments; both give the same numbers up to rounding. [`composed_only`] switches the kernels off.
//!
//! Shape letters: `N` or `B` batch, `V` views, `Q` queries, `R` rays, `M` heads, `C` channels of one head, `L` levels,
//! `P` points, `S` sites of all levels, `D H W` (or `Z Y X`) map sizes.

// Kernels index several arrays by one counter; iterators over all of them would hide the arithmetic.
#![allow(clippy::needless_range_loop)]

mod activation;
mod attention;
mod conv;
mod fused;
mod linear;
#[cfg(test)]
mod noise;
mod norm;
mod product;
mod resize;
mod rotary;
mod sampling;
mod softmax;
mod sums;

pub use activation::{gelu, gelu_tanh, silu};
pub use attention::{attention, rotary_attention};
pub use conv::{conv2d, conv3d};
pub use fused::{composed_only, keep_freed_memory};
pub use linear::linear;
pub use norm::{group_norm, group_norm_silu, layer_norm, modulated_layer_norm, rms_norm};
pub use resize::{PixelCentres, resize_bilinear};
pub use rotary::rotary;
pub use sampling::{
    Interpolation, deformable_rays_3d, deformable_sample_2d, deformable_sample_3d, deformable_views_2d, grid_sample_2d,
    grid_sample_3d,
};
pub use softmax::softmax;
pub use sums::{mean_dim, sum_dim};
