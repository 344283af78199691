//! Views that no camera took against their rendering, by how far the camera was moved (protocol `nvs/toy`).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::{ImageSize, Mean, Psnr, PsnrSummary, SsimWindow, ssim};

/// Collects decoded views per camera motion, for instance `yaw +10 deg`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct NovelViews {
    motions: BTreeMap<String, (Psnr, Mean)>,
}

/// What one camera motion comes to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct NovelViewSummary {
    /// The motion.
    pub motion: String,
    /// In dB.
    pub psnr: PsnrSummary,
    /// Mean SSIM, 11×11 Gaussian; `None` for pictures smaller than the window.
    pub ssim: Option<f64>,
}

impl NovelViews {
    /// Adds a decoded view and its truth `[3, H, W]`.
    ///
    /// # Panics
    /// When a length does not fit the size.
    pub fn update(&mut self, motion: &str, decoded: &[f32], truth: &[f32], size: ImageSize) {
        let (psnr, similarity) = self.motions.entry(motion.to_owned()).or_default();
        psnr.update(decoded, truth);
        if size.height.min(size.width) >= SsimWindow::Gauss11.side() {
            similarity.add(ssim(decoded, truth, size, SsimWindow::Gauss11));
        }
    }

    /// Adds the views of another collector.
    pub fn merge(&mut self, other: &Self) {
        for (motion, (psnr, similarity)) in &other.motions {
            let own = self.motions.entry(motion.clone()).or_default();
            own.0.merge(psnr);
            own.1.merge(similarity);
        }
    }

    /// One entry per motion, sorted by name.
    #[must_use]
    pub fn summaries(&self) -> Vec<NovelViewSummary> {
        let one = |(motion, (psnr, similarity)): (&String, &(Psnr, Mean))| NovelViewSummary {
            motion: motion.clone(),
            psnr: psnr.summary(),
            ssim: similarity.mean(),
        };
        self.motions.iter().map(one).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn motions_are_kept_apart() {
        let size = ImageSize { channels: 3, height: 12, width: 12 };
        let (black, grey) = (vec![0.0; 432], vec![0.5; 432]);
        let mut views = NovelViews::default();
        views.update("yaw +10 deg", &black, &grey, size);
        let mut other = NovelViews::default();
        other.update("yaw -10 deg", &grey, &grey, size);
        views.merge(&other);
        let found = views.summaries();
        assert_eq!(found.iter().map(|one| one.motion.as_str()).collect::<Vec<_>>(), ["yaw +10 deg", "yaw -10 deg"]);
        assert!((found[0].psnr.mean_db.unwrap() - 20.0 * 2.0_f64.log10()).abs() < 1e-12);
        assert_eq!((found[1].psnr.identical, found[1].ssim), (1, Some(1.0)));
        views.update("tiny", &[0.0; 3], &[0.5; 3], ImageSize { channels: 3, height: 1, width: 1 });
        assert_eq!(views.summaries()[0].ssim, None);
    }
}
