//! Multi-scale structural similarity, data range 1.
//!
//! Wang, Simoncelli & Bovik, "Multiscale Structural Similarity for Image Quality Assessment", equation 7 with the five
//! published weights. Details as in pytorch-msssim: 2×2 means between scales (an odd side is padded by a row of zeros
//! on both ends), terms below 0 count as 0, product over scales per channel, then the mean over channels.

use crate::ssim::{displayed_values, similarities};
use crate::{ImageSize, MetricError, Pixel, SsimWindow};

/// Exponents of the scales, finest first.
const WEIGHTS: [f64; 5] = [0.0448, 0.2856, 0.3001, 0.2363, 0.1333];

/// Smallest side, px: the window must fit inside the coarsest scale.
const LEAST_SIDE: usize = 161;

/// MS-SSIM of two images `[channels, height, width]`; 1 for equal images.
///
/// # Errors
/// [`MetricError::TooSmall`] for a side of 160 px or less.
///
/// # Panics
/// When a length does not fit the size.
pub fn ms_ssim<P: Pixel>(prediction: &[P], target: &[P], size: ImageSize) -> Result<f64, MetricError> {
    if size.height.min(size.width) < LEAST_SIDE {
        let ImageSize { height, width, .. } = size;
        return Err(MetricError::TooSmall { what: "MS-SSIM".to_owned(), needed: LEAST_SIDE, height, width });
    }
    let (mut x, mut y) = (displayed_values(prediction, size), displayed_values(target, size));
    let mut size = size;
    let mut per_channel = vec![1.0; size.channels];
    for (scale, weight) in WEIGHTS.iter().enumerate() {
        let found = similarities(&x, &y, size, SsimWindow::Gauss11);
        let last = scale + 1 == WEIGHTS.len();
        for (product, found) in per_channel.iter_mut().zip(found) {
            let term: f64 = if last { found.whole } else { found.contrast };
            *product *= if term.is_nan() { term } else { term.max(0.0).powf(*weight) };
        }
        if !last {
            (x, y) = (halve(&x, size), halve(&y, size));
            size = ImageSize { height: size.height.div_ceil(2), width: size.width.div_ceil(2), ..size };
        }
    }
    Ok(per_channel.iter().sum::<f64>() / per_channel.len() as f64)
}

/// 2×2 means; with an odd side the windows begin half outside, where the image is 0.
fn halve(image: &[f64], size: ImageSize) -> Vec<f64> {
    let ImageSize { height, width, .. } = size;
    let mut halved = Vec::with_capacity(image.len() / 4 + height + width);
    for plane in image.chunks_exact(height * width) {
        for row in 0..height.div_ceil(2) {
            for column in 0..width.div_ceil(2) {
                let rows = inside(2 * row, height);
                let columns = inside(2 * column, width);
                let sum: f64 = rows.flat_map(|y| columns.clone().map(move |x| plane[y * width + x])).sum();
                halved.push(sum / 4.0);
            }
        }
    }
    halved
}

/// The two places of a window along one axis, those outside left out.
fn inside(start: usize, length: usize) -> std::ops::Range<usize> {
    let shift = length % 2;
    start.saturating_sub(shift)..(start + 2 - shift).min(length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn odd_sides_are_padded_with_zeros_on_both_ends() {
        let size = ImageSize { channels: 1, height: 2, width: 3 };
        // Columns: (pad, 1st), (2nd, 3rd).
        assert_eq!(halve(&[4.0, 8.0, 12.0, 4.0, 0.0, 0.0], size), [2.0, 5.0]);
        let even = ImageSize { channels: 1, height: 2, width: 2 };
        assert_eq!(halve(&[1.0, 2.0, 3.0, 6.0], even), [3.0]);
    }

    #[test]
    fn equal_images_and_small_ones() {
        let size = ImageSize { channels: 2, height: 161, width: 170 };
        let image: Vec<f32> = (0..2 * 161 * 170).map(|i| (i % 97) as f32 / 97.0).collect();
        assert!((ms_ssim(&image, &image, size).unwrap() - 1.0).abs() < 1e-12);
        let inverted: Vec<f32> = image.iter().map(|value| 1.0 - value).collect();
        assert_eq!(ms_ssim(&image, &inverted, size).unwrap(), 0.0, "contrast of opposite sign counts as 0");
        let small = ImageSize { channels: 1, height: 160, width: 200 };
        assert!(matches!(ms_ssim(&[0.0; 32_000], &[0.0; 32_000], small), Err(MetricError::TooSmall { .. })));
    }
}
