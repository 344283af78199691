//! Structural similarity, data range 1.
//!
//! Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity", equation 13 with
//! K1 = 0.01, K2 = 0.03; mean over the windows that lie inside the image, then over channels. Parity:
//! `tests/it/main.rs`.

use crate::displayed;

/// (0.01 · range)² and (0.03 · range)².
const C1: f64 = 1e-4;
const C2: f64 = 9e-4;

/// Which window the local statistics are taken over. The two protocols give different numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
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
pub fn ssim(prediction: &[f32], target: &[f32], size: ImageSize, window: SsimWindow) -> f64 {
    let ImageSize { channels, height, width } = size;
    let taps = window.taps();
    assert!(height.min(width) >= taps.len(), "{height}x{width} is smaller than the window");
    let plane = height * width;
    for image in [prediction, target] {
        assert_eq!(image.len(), channels * plane, "values of an image of {size:?}");
    }
    let pairs = prediction.chunks_exact(plane).zip(target.chunks_exact(plane));
    pairs.map(|(p, t)| plane_ssim(p, t, width, &taps, window.covariance_factor())).sum::<f64>() / channels as f64
}

fn plane_ssim(x: &[f32], y: &[f32], width: usize, taps: &[f64], covariance_factor: f64) -> f64 {
    let x: Vec<f64> = x.iter().map(|&value| displayed(value)).collect();
    let y: Vec<f64> = y.iter().map(|&value| displayed(value)).collect();
    let mean = |values: Vec<f64>| filter(&values, width, taps);
    let product = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).collect();
    let (xx, yy, xy) = (mean(product(&x, &x)), mean(product(&y, &y)), mean(product(&x, &y)));
    let (mx, my) = (mean(x), mean(y));

    let local = (0..mx.len()).map(|i| {
        let (vx, vy, vxy) = (xx[i] - mx[i] * mx[i], yy[i] - my[i] * my[i], xy[i] - mx[i] * my[i]);
        let [vx, vy, vxy] = [vx, vy, vxy].map(|v| v * covariance_factor);
        let likeness = (2.0 * mx[i] * my[i] + C1) * (2.0 * vxy + C2);
        likeness / ((mx[i] * mx[i] + my[i] * my[i] + C1) * (vx + vy + C2))
    });
    local.sum::<f64>() / mx.len() as f64
}

/// Separable filter over the windows inside the plane; the result is `taps.len() - 1` smaller on both axes.
fn filter(plane: &[f64], width: usize, taps: &[f64]) -> Vec<f64> {
    let inner = width - taps.len() + 1;
    let weigh = |start: &[f64], step: usize| taps.iter().enumerate().map(|(k, tap)| tap * start[k * step]).sum();
    let rows: Vec<f64> =
        plane.chunks_exact(width).flat_map(|row| (0..inner).map(move |i| weigh(&row[i..], 1))).collect();
    let heights = rows.len() / inner - taps.len() + 1;
    (0..heights * inner).map(|i| weigh(&rows[i..], inner)).collect()
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
