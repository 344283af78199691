//! Image metrics on host arrays, computed in f64.
//!
//! Images are f32 in [0, 1]; values outside are clamped, because that is what a stored picture would show. NaN stays
//! NaN, so a diverged model cannot hide.

mod mean_image;
mod psnr;
mod ssim;

pub use mean_image::MeanImages;
pub use psnr::{Psnr, PsnrSummary, image_mse, psnr_db};
pub use ssim::{ImageSize, SsimWindow, ssim};

/// A pixel value as a stored picture would show it.
fn displayed(value: f32) -> f64 {
    f64::from(value.clamp(0.0, 1.0))
}
