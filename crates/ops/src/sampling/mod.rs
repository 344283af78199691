//! Linear sampling of maps and volumes: grids and multi-scale deformable attention.
//!
//! All public functions are one weighted sum of linear samples, [`core::sample_views`], under different layouts.
//! Conventions: zeros outside, `align_corners = false` for everything deformable, coordinates ordered (x, y) or
//! (x, y, z) while map sizes are ordered (H, W) or (D, H, W).

mod composed;
mod core;
mod deformable;
mod grid;
mod native;

pub use deformable::{deformable_rays_3d, deformable_sample_2d, deformable_sample_3d, deformable_views_2d};
pub use grid::{Interpolation, grid_sample_2d, grid_sample_3d};

#[cfg(test)]
mod tests;
