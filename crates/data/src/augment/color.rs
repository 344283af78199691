//! Colour changes of planar RGB pictures with values in [0, 1].

use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Random brightness, contrast, saturation and hue, applied in random order.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ColorJitter {
    /// Chance that a view is recoloured.
    pub probability: f64,
    /// The brightness factor is uniform in 1 ± this.
    pub brightness: f64,
    /// The contrast factor is uniform in 1 ± this.
    pub contrast: f64,
    /// The saturation factor is uniform in 1 ± this.
    pub saturation: f64,
    /// The hue is turned by ± this share of a full circle.
    pub hue: f64,
}

impl Default for ColorJitter {
    /// Off; the ranges are those of the public BEV-VAE settings.
    fn default() -> Self {
        Self { probability: 0.0, brightness: 0.4, contrast: 0.4, saturation: 0.2, hue: 0.1 }
    }
}

#[derive(Debug, Clone, Copy)]
enum Change {
    Brightness(f32),
    Contrast(f32),
    Saturation(f32),
    Hue(f32),
}

/// One drawn recolouring.
#[derive(Debug, Clone)]
pub(super) struct ColorChange([Change; 4]);

impl ColorJitter {
    pub(super) fn draw(&self, rng: &mut ChaCha8Rng) -> ColorChange {
        let mut spread = |range: f64| rng.random_range(-1.0..=1.0) * range;
        let mut changes = [
            Change::Brightness((1.0 + spread(self.brightness)) as f32),
            Change::Contrast((1.0 + spread(self.contrast)) as f32),
            Change::Saturation((1.0 + spread(self.saturation)) as f32),
            Change::Hue(spread(self.hue) as f32),
        ];
        for last in (1..changes.len()).rev() {
            changes.swap(last, rng.random_range(0..=last));
        }
        ColorChange(changes)
    }
}

impl ColorChange {
    /// `pixels`: `[3, H, W]` RGB in [0, 1].
    pub(super) fn apply(&self, pixels: &mut [f32]) {
        for change in self.0 {
            match change {
                Change::Brightness(factor) => {
                    for value in pixels.iter_mut() {
                        *value = (*value * factor).clamp(0.0, 1.0);
                    }
                }
                Change::Contrast(factor) => contrast(pixels, factor),
                Change::Saturation(factor) => each_pixel(pixels, |rgb| {
                    let gray = luma(rgb);
                    rgb.map(|c| (gray + (c - gray) * factor).clamp(0.0, 1.0))
                }),
                Change::Hue(turn) => each_pixel(pixels, |rgb| turn_hue(rgb, turn)),
            }
        }
    }
}

/// Rec. 601 luma, repeated in all channels.
pub(super) fn to_gray(pixels: &mut [f32]) {
    each_pixel(pixels, |rgb| [luma(rgb); 3]);
}

fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

fn contrast(pixels: &mut [f32], factor: f32) {
    let mut sum = 0.0f64;
    each_pixel(pixels, |rgb| {
        sum += f64::from(luma(rgb));
        rgb
    });
    let mean = (sum / (pixels.len() / 3).max(1) as f64) as f32;
    for value in pixels {
        *value = (mean + (*value - mean) * factor).clamp(0.0, 1.0);
    }
}

fn each_pixel(pixels: &mut [f32], mut change: impl FnMut([f32; 3]) -> [f32; 3]) {
    let plane = pixels.len() / 3;
    let (red, rest) = pixels.split_at_mut(plane);
    let (green, blue) = rest.split_at_mut(plane);
    for ((r, g), b) in red.iter_mut().zip(green).zip(blue) {
        [*r, *g, *b] = change([*r, *g, *b]);
    }
}

/// Turns the hue of the HSV hexcone by a share of the full circle; value and saturation stay.
fn turn_hue(rgb: [f32; 3], turn: f32) -> [f32; 3] {
    let [r, g, b] = rgb;
    let (most, least) = (r.max(g).max(b), r.min(g).min(b));
    let chroma = most - least;
    if chroma <= 0.0 {
        return rgb;
    }
    let sextant = if most == r {
        (g - b) / chroma
    } else if most == g {
        (b - r) / chroma + 2.0
    } else {
        (r - g) / chroma + 4.0
    };
    let hue = (sextant + 6.0 * turn).rem_euclid(6.0);
    // Each channel is a trapezoid over the hue circle, shifted by a third of it.
    [5.0, 3.0, 1.0].map(|shift: f32| {
        let k = (shift + hue) % 6.0;
        most - chroma * k.min(4.0 - k).clamp(0.0, 1.0)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: [f32; 3], b: [f32; 3]) -> bool {
        a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-6)
    }

    #[test]
    fn hue_turns_in_thirds() {
        let color = [0.8, 0.3, 0.1];
        assert!(close(turn_hue(color, 0.0), color));
        assert!(close(turn_hue(color, 1.0 / 3.0), [0.1, 0.8, 0.3]));
        assert!(close(turn_hue(color, -1.0 / 3.0), [0.3, 0.1, 0.8]));
        assert!(close(turn_hue([0.4; 3], 0.2), [0.4; 3]));
    }

    #[test]
    fn gray_keeps_luma_and_contrast_keeps_the_mean() {
        let mut pixels = [0.2, 0.6, 0.4, 0.4, 0.5, 0.1];
        to_gray(&mut pixels);
        assert!((pixels[0] - luma([0.2, 0.4, 0.5])).abs() < 1e-6);
        assert_eq!([pixels[1]; 2], [pixels[3], pixels[5]]);
        let mean = |p: &[f32]| p.iter().sum::<f32>() / p.len() as f32;
        let before = mean(&pixels);
        contrast(&mut pixels, 1.3);
        assert!((mean(&pixels) - before).abs() < 1e-6);
    }
}
