//! Structural similarity, data range 1.
//!
//! Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", equation 13 with
//! K1 = 0.01, K2 = 0.03; mean over the windows that lie inside the image, then over channels. Parity:
//! `tests/it/pictures.rs`.

use serde::{Deserialize, Serialize};

use crate::Pixel;

/// (0.01 · range)² and (0.03 · range)².
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Which window the local statistics are taken over. The two protocols give different numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SsimWindow {
    /// 7×7 box with sample covariance (n / (n - 1), n = 49): scikit-image's default.
    Uniform7,
    /// 11×11 Gaussian of deviation 1.5 px with population covariance: the paper's.
    Gauss11,
}

/// Size of a planar image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageSize {
    /// Number of planes.
    pub channels: usize,
    /// Rows of a plane.
    pub height: usize,
    /// Columns of a plane.
    pub width: usize,
}

impl SsimWindow {
    /// Pixels along one axis; smaller pictures have no value.
    #[must_use]
    pub fn side(self) -> usize {
        match self {
            Self::Uniform7 => 7,
            Self::Gauss11 => 11,
        }
    }

    /// Weights along one axis, their sum is 1.
    fn taps(self) -> Vec<f64> {
        match self {
            Self::Uniform7 => vec![1.0 / 7.0; 7],
            Self::Gauss11 => {
                let bell = |i: i32| (-0.5 * (f64::from(i - 5) / 1.5).powi(2)).exp();
                let sum: f64 = (0..11).map(bell).sum();
                (0..11).map(|i| bell(i) / sum).collect()
            }
        }
    }

    /// From population to the protocol's covariance.
    fn covariance_factor(self) -> f64 {
        match self {
            Self::Uniform7 => 49.0 / 48.0,
            Self::Gauss11 => 1.0,
        }
    }
}

/// Mean structural similarity of two images `[channels, height, width]`; 1 for equal images.
///
/// # Panics
/// When a length does not fit the size, or a side is shorter than the window.
#[must_use]
pub fn ssim<P: Pixel>(prediction: &[P], target: &[P], size: ImageSize, window: SsimWindow) -> f64 {
    let (x, y) = (displayed_values(prediction, size), displayed_values(target, size));
    let per_channel = similarities(&x, &y, size, window);
    per_channel.iter().map(|found| found.whole).sum::<f64>() / size.channels as f64
}

/// Means over the windows of one channel.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Similarity {
    /// Luminance, contrast and structure.
    pub(crate) whole: f64,
    /// Contrast and structure alone.
    pub(crate) contrast: f64,
}

/// An image in f64, as it would be shown.
pub(crate) fn displayed_values<P: Pixel>(image: &[P], size: ImageSize) -> Vec<f64> {
    assert_eq!(image.len(), size.channels * size.height * size.width, "values of an image of {size:?}");
    image.iter().map(|value| value.displayed()).collect()
}

/// Channel by channel.
pub(crate) fn similarities(x: &[f64], y: &[f64], size: ImageSize, window: SsimWindow) -> Vec<Similarity> {
    let ImageSize { height, width, .. } = size;
    let taps = window.taps();
    assert!(height.min(width) >= taps.len(), "{height}x{width} is smaller than the window");
    let planes = x.chunks_exact(height * width).zip(y.chunks_exact(height * width));
    planes.map(|(x, y)| plane_similarity(x, y, width, &taps, window.covariance_factor())).collect()
}

fn plane_similarity(x: &[f64], y: &[f64], width: usize, taps: &[f64], covariance_factor: f64) -> Similarity {
    let product: Vec<f64> = x.iter().zip(y).map(|(x, y)| x * y).collect();
    // The formula needs the two variances only as a sum.
    let squares: Vec<f64> = x.iter().zip(y).map(|(x, y)| x * x + y * y).collect();
    let rows = x.len() / width - taps.len() + 1;
    let inner = width - taps.len() + 1;
    let mut lines = [0; 4].map(|_| LineFilter { across: vec![0.0; width], means: vec![0.0; inner] });
    let (mut whole, mut contrast) = (0.0, 0.0);
    for row in 0..rows {
        for (line, plane) in lines.iter_mut().zip([x, y, &product, &squares]) {
            line.apply(&plane[row * width..(row + taps.len()) * width], taps);
        }
        let [mx, my, mxy, msq] = lines.each_ref().map(|line| line.means.as_slice());
        for (((mx, my), mxy), msq) in mx.iter().zip(my).zip(mxy).zip(msq) {
            let centre = mx * mx + my * my;
            let covariance = (mxy - mx * my) * covariance_factor;
            let variances = (msq - centre) * covariance_factor;
            let shape = (2.0 * covariance + C2) / (variances + C2);
            contrast += shape;
            whole += (2.0 * mx * my + C1) / (centre + C1) * shape;
        }
    }
    let count = (rows * inner) as f64;
    Similarity { whole: whole / count, contrast: contrast / count }
}

/// Weighted means over the windows of one row of windows, first down the columns, then along the row.
struct LineFilter {
    across: Vec<f64>,
    means: Vec<f64>,
}

impl LineFilter {
    /// `rows` are as many rows as there are taps.
    fn apply(&mut self, rows: &[f64], taps: &[f64]) {
        let weigh = |sums: &mut [f64], values: &[f64], tap: f64| {
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += tap * value);
        };
        self.across.fill(0.0);
        for (row, tap) in rows.chunks_exact(self.across.len()).zip(taps) {
            weigh(&mut self.across, row, *tap);
        }
        self.means.fill(0.0);
        for (shift, tap) in taps.iter().enumerate() {
            weigh(&mut self.means, &self.across[shift..], *tap);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constant_images_leave_the_luminance_term() {
        let size = ImageSize { channels: 2, height: 11, width: 12 };
        let flat = |value: f32| vec![value; 2 * 11 * 12];
        for window in [SsimWindow::Uniform7, SsimWindow::Gauss11] {
            let expected = (2.0 * 0.25 * 0.5 + C1) / (0.25_f64.powi(2) + 0.5_f64.powi(2) + C1);
            assert!((ssim(&flat(0.25), &flat(0.5), size, window) - expected).abs() < 1e-12);
            assert!((ssim(&flat(0.3), &flat(0.3), size, window) - 1.0).abs() < 1e-12);
        }
    }

    #[test]
    fn negated_texture_scores_below_zero() {
        let size = ImageSize { channels: 1, height: 16, width: 16 };
        let board: Vec<f32> = (0..256).map(|i| if (i / 16 + i) % 2 == 0 { 0.25 } else { 0.75 }).collect();
        let negated: Vec<f32> = board.iter().map(|v| 1.0 - v).collect();
        for window in [SsimWindow::Uniform7, SsimWindow::Gauss11] {
            assert!(ssim(&board, &negated, size, window) < -0.9);
        }
    }
}
