//! What generators are told beside words: occupancy along rays, masks of objects, codes of cameras and boxes. Host arrays, in the loader.
//!
//! Parity: `tests/it/conditions.rs`.

mod foreground_mask;
mod fourier;
mod projected;
mod rays;

pub use foreground_mask::{ForegroundMask, MaskConfig, MaskRegion};
pub use fourier::{FOURIER_WIDTH, camera_code, fourier_code};
pub use projected::{ConvexHull, project_box};
pub use rays::{LatentRays, RayLabels, RaySampling};
