//! Metrics on host arrays, computed in f64: pictures, features, views of one rig, detections, segmentations.
//!
//! Images are f32 in [0, 1]; values outside are clamped, because that is what a stored picture would show. NaN stays
//! NaN, so a diverged model cannot hide. Collectors stream: their memory does not grow with the number of images (but for
//! detections), and collectors of parts of a set merge to the result of the whole.

pub mod detection;
mod error;
mod exact_sum;
mod frechet;
mod kid;
mod layout;
mod mean;
mod mean_image;
mod moments;
mod ms_ssim;
mod novel_view;
mod pool;
mod precision_recall;
mod protocol;
mod psnr;
mod resize;
mod segmentation;
mod ssim;
mod view_consistency;
mod wcoda;

pub use error::MetricError;
pub use exact_sum::ExactSum;
pub use frechet::{FrechetDistance, frechet_distance};
pub use kid::{Kid, KidSubsets, kid, polynomial_mmd};
pub use layout::{EditLocality, LayoutIou, UNKNOWN_CLASS};
pub use mean::{Histogram, Mean, Ranked, Worst};
pub use mean_image::MeanImages;
pub use moments::{FeatureStatistics, Moments};
pub use ms_ssim::ms_ssim;
pub use novel_view::{NovelViewSummary, NovelViews};
pub use pool::{FeaturePool, FeatureRows};
pub use precision_recall::{PrecisionRecall, precision_recall};
pub use protocol::{ClipRule, Feature, FrameRule, MetricChoice, PictureStep, Protocol, ViewRule};
pub use psnr::{Psnr, PsnrSummary, image_mse, psnr_db};
pub use resize::{Raster, ResizeFilter};
pub use segmentation::{Overlap, SegmentationIou, mean_iou};
pub use ssim::{ImageSize, SsimWindow, ssim};
pub use view_consistency::{Seam, ViewConsistency, mvsc, seam, seam_pairs};
pub use wcoda::wcoda_score;

/// A pixel value: f32 in [0, 1], or a byte of a stored picture, which is exact.
pub trait Pixel: Copy {
    /// In [0, 1], as a stored picture would show it; NaN stays NaN.
    fn displayed(self) -> f64;
}

impl Pixel for f32 {
    fn displayed(self) -> f64 {
        f64::from(self.clamp(0.0, 1.0))
    }
}

impl Pixel for u8 {
    fn displayed(self) -> f64 {
        f64::from(self) / 255.0
    }
}
