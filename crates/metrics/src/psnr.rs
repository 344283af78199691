//! Peak signal-to-noise ratio, data range 1: `10 log10(1 / mse)` per image, then the mean over images.

use serde::{Deserialize, Serialize};

use crate::{Mean, Pixel};

/// Peak signal-to-noise ratio in dB of a mean squared error on the [0, 1] scale; infinite for zero.
#[must_use]
pub fn psnr_db(mse: f64) -> f64 {
    -10.0 * mse.log10()
}

/// Mean squared difference over all pixels and channels of one image, in any memory order.
///
/// # Panics
/// When the lengths differ or are zero.
#[must_use]
pub fn image_mse<P: Pixel>(prediction: &[P], target: &[P]) -> f64 {
    assert_eq!(prediction.len(), target.len(), "values of prediction and target");
    assert!(!target.is_empty(), "an image without pixels has no error");
    let squares = prediction.iter().zip(target).map(|(&p, &t)| (p.displayed() - t.displayed()).powi(2));
    squares.sum::<f64>() / target.len() as f64
}

/// Collects the PSNR of images one at a time.
///
/// Images may come in any order and be split over any number of collectors that are [merged](Psnr::merge): the result
/// is the same to the last bit, because the values are summed without rounding. Memory does not grow.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Psnr {
    /// dB per image, identical images left out.
    db: Mean,
    identical: usize,
}

/// Mean PSNR of a set of images.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PsnrSummary {
    /// Mean over the images that differ from their target; `None` when there is none.
    pub mean_db: Option<f64>,
    /// Images seen, identical ones included.
    pub images: usize,
    /// Images equal to their target. Their PSNR is infinite, so they are counted here and left out of the mean.
    pub identical: usize,
}

impl Psnr {
    /// Adds one image and returns its PSNR in dB.
    ///
    /// # Panics
    /// When the lengths differ or are zero.
    pub fn update<P: Pixel>(&mut self, prediction: &[P], target: &[P]) -> f64 {
        let db = psnr_db(image_mse(prediction, target));
        if db == f64::INFINITY {
            self.identical += 1;
        } else {
            self.db.add(db);
        }
        db
    }

    /// As [`Psnr::update`] over the pixels that count only. An image without any is left out and gives `None`.
    ///
    /// # Shapes
    /// - prediction, target: `[C, H, W]`
    /// - counts: `[H, W]`
    ///
    /// # Panics
    /// When the lengths do not fit.
    pub fn update_where<P: Pixel>(&mut self, prediction: &[P], target: &[P], counts: &[bool]) -> Option<f64> {
        assert!(target.len().is_multiple_of(counts.len()), "whole planes of {} pixels", counts.len());
        if counts.iter().all(|counts| *counts) {
            return Some(self.update(prediction, target));
        }
        let chosen = |image: &[P]| -> Vec<P> {
            image.iter().zip(counts.iter().cycle()).filter(|(_, counts)| **counts).map(|(value, _)| *value).collect()
        };
        let target = chosen(target);
        (!target.is_empty()).then(|| self.update(&chosen(prediction), &target))
    }

    /// Adds every image of another collector.
    pub fn merge(&mut self, other: &Self) {
        self.db.merge(&other.db);
        self.identical += other.identical;
    }

    /// The result so far.
    #[must_use]
    pub fn summary(&self) -> PsnrSummary {
        let images = self.db.count() as usize + self.identical;
        PsnrSummary { mean_db: self.db.mean(), images, identical: self.identical }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_errors() {
        assert_eq!(psnr_db(1.0), 0.0);
        assert!((psnr_db(0.01) - 20.0).abs() < 1e-12);
        assert_eq!(psnr_db(0.0), f64::INFINITY);
        assert_eq!(image_mse(&[0.5, 1.0], &[0.0, 0.5]), 0.25);
    }

    #[test]
    fn values_outside_the_range_are_clamped_and_nan_is_kept() {
        assert_eq!(image_mse(&[7.0, -3.0], &[1.0, 0.0]), 0.0);
        let mut psnr = Psnr::default();
        assert!(psnr.update(&[f32::NAN, 0.0], &[0.5, 0.5]).is_nan());
        assert!(psnr.summary().mean_db.unwrap().is_nan());
    }

    #[test]
    fn pixels_that_do_not_count_change_nothing() {
        let mut psnr = Psnr::default();
        // Two channels of three pixels; the middle pixel is ignored.
        let (image, counts) = ([0.5, 9.0, 0.5, 0.5, -9.0, 0.5], [true, false, true]);
        let db = psnr.update_where(&image, &[0.0; 6], &counts).unwrap();
        assert!((db - psnr_db(0.25)).abs() < 1e-12);
        assert_eq!(psnr.update_where(&image, &[0.0; 6], &[false; 3]), None);
        assert_eq!(psnr.summary().images, 1);
    }

    #[test]
    fn identical_images_are_counted_apart() {
        let mut psnr = Psnr::default();
        assert_eq!(psnr.summary(), PsnrSummary { mean_db: None, images: 0, identical: 0 });
        assert_eq!(psnr.update(&[0.25; 4], &[0.25; 4]), f64::INFINITY);
        assert_eq!(psnr.summary(), PsnrSummary { mean_db: None, images: 1, identical: 1 });
        psnr.update(&[1.0], &[0.0]);
        psnr.update(&[0.5], &[0.0]);
        let summary = psnr.summary();
        assert_eq!((summary.images, summary.identical), (3, 1));
        assert!((summary.mean_db.unwrap() - 10.0 * 2.0_f64.log10()).abs() < 1e-12, "mean of 0 and 6.02 dB");
    }

    #[test]
    fn shards_merge_to_the_same_bits_in_any_order() {
        let images: Vec<Vec<f32>> = (1..40).map(|i| vec![i as f32 * 0.021, 0.3, 1.0 / i as f32]).collect();
        let collect = |images: &[Vec<f32>]| {
            let mut psnr = Psnr::default();
            images.iter().for_each(|image| _ = psnr.update(image, &[0.5; 3]));
            psnr
        };
        let whole = collect(&images).summary();
        for split in [0, 1, 17, 38] {
            let mut merged = collect(&images[split..]);
            merged.merge(&collect(&images[..split]));
            assert_eq!(merged.summary(), whole);
        }
    }
}
