//! Resizing exactly as the programs that metrics are quoted from do it; which one is part of a protocol.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// A way to resize.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ResizeFilter {
    /// Pillow's `BILINEAR`: a triangle as wide as the shrinking, bytes in and out.
    PilBilinear,
    /// Pillow's `BICUBIC` (a = -0.5), widened alike.
    PilBicubic,
    /// Pillow's `LANCZOS`, three lobes, widened alike.
    PilLanczos,
    /// PyTorch's `interpolate(mode="bilinear", align_corners=False)` without antialiasing: two neighbours whatever the factor.
    TorchBilinear,
    /// TensorFlow 1's bilinear resize without the half-pixel shift, as torch-fidelity does it.
    Tf1Bilinear,
}

/// A picture `[H, W, 3]` in memory, RGB.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster<T> {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Row by row, three values per pixel.
    pub pixels: Vec<T>,
}

impl Raster<u8> {
    /// Resized; the filters that compute with fractions round at the end.
    #[must_use]
    pub fn resized(&self, height: usize, width: usize, filter: ResizeFilter) -> Self {
        let kernel = match filter {
            ResizeFilter::PilBilinear => Kernel { reach: 1.0, weight: |x| 1.0 - x.abs() },
            ResizeFilter::PilBicubic => Kernel { reach: 2.0, weight: cubic },
            ResizeFilter::PilLanczos => Kernel { reach: 3.0, weight: |x| sinc(x) * sinc(x / 3.0) },
            ResizeFilter::TorchBilinear | ResizeFilter::Tf1Bilinear => {
                let exact = self.map(f32::from).interpolated(height, width, filter == ResizeFilter::TorchBilinear);
                return exact.map(|value| (value + 0.5) as u8);
            }
        };
        // Pillow goes along rows first and rounds in between. Release 13 goes down columns first for some shapes, mostly upright
        // ones, which moves single values by a few of 255; the sizes of the built-in protocols are not among them.
        let columns = kernel.taps(self.width, width);
        let mut wide = Vec::with_capacity(self.height * width * 3);
        for row in self.pixels.chunks_exact((self.width * 3).max(1)) {
            wide.extend(
                columns.iter().flat_map(|taps| taps.apply(|at| [row[3 * at], row[3 * at + 1], row[3 * at + 2]])),
            );
        }
        let mut pixels = Vec::with_capacity(height * width * 3);
        for taps in kernel.taps(self.height, height) {
            for column in 0..width {
                let at = |row: usize| (row * width + column) * 3;
                pixels.extend(taps.apply(|row| [wide[at(row)], wide[at(row) + 1], wide[at(row) + 2]]));
            }
        }
        Self { height, width, pixels }
    }
}

impl Raster<f32> {
    /// Bilinear between the two neighbours on each axis, `half_pixel` for centres at +0.5.
    #[must_use]
    pub fn interpolated(&self, height: usize, width: usize, half_pixel: bool) -> Self {
        let (rows, columns) = (neighbours(self.height, height, half_pixel), neighbours(self.width, width, half_pixel));
        let mut pixels = Vec::with_capacity(height * width * 3);
        for (top, bottom, down) in rows {
            for (left, right, across) in &columns {
                for channel in 0..3 {
                    let at = |row: usize, column: usize| self.pixels[(row * self.width + column) * 3 + channel];
                    let mix = |row: usize| at(row, *left) * (1.0 - across) + at(row, *right) * across;
                    pixels.push(mix(top) * (1.0 - down) + mix(bottom) * down);
                }
            }
        }
        Self { height, width, pixels }
    }
}

impl<T: Copy> Raster<T> {
    /// The same picture with other values.
    #[must_use]
    pub fn map<U>(&self, value: impl Fn(T) -> U) -> Raster<U> {
        let pixels = self.pixels.iter().map(|pixel| value(*pixel)).collect();
        Raster { height: self.height, width: self.width, pixels }
    }

    /// A part; `None` when it reaches beyond the picture.
    #[must_use]
    pub fn cropped(&self, top: usize, left: usize, height: usize, width: usize) -> Option<Self> {
        let rows = top..top.checked_add(height)?;
        let inside = rows.end <= self.height && left.checked_add(width)? <= self.width;
        let row = |row: usize| &self.pixels[(row * self.width + left) * 3..(row * self.width + left + width) * 3];
        inside.then(|| Self { height, width, pixels: rows.flat_map(row).copied().collect() })
    }

    /// `[3, H, W]`.
    #[must_use]
    pub fn planes(&self) -> Vec<T> {
        (0..3).flat_map(|channel| self.pixels.iter().skip(channel).step_by(3).copied()).collect()
    }
}

/// Two source places and the weight of the second, for each output place.
fn neighbours(source: usize, output: usize, half_pixel: bool) -> Vec<(usize, usize, f32)> {
    let scale = source as f32 / output.max(1) as f32;
    let shift = if half_pixel { 0.5 } else { 0.0 };
    let last = source.saturating_sub(1);
    let one = |at: usize| {
        let place = ((at as f32 + shift) * scale - shift).max(0.0);
        let first = (place as usize).min(last);
        (first, (first + 1).min(last), place - first as f32)
    };
    (0..output).map(one).collect()
}

/// A Pillow filter: `reach` source pixels to both sides when nothing shrinks.
struct Kernel {
    reach: f64,
    weight: fn(f64) -> f64,
}

/// Fixed-point weights of one output place.
struct Taps {
    first: usize,
    weights: Vec<i32>,
}

/// Fraction bits of Pillow's weights for bytes.
const FRACTION_BITS: u32 = 22;

impl Kernel {
    fn taps(&self, source: usize, output: usize) -> Vec<Taps> {
        let scale = source as f64 / output.max(1) as f64;
        let widened = scale.max(1.0);
        let reach = self.reach * widened;
        let one = |at: usize| {
            let center = (at as f64 + 0.5) * scale;
            let first = (center - reach + 0.5).max(0.0) as usize;
            let end = ((center + reach + 0.5) as usize).min(source);
            let weight = |place: usize| {
                let x = (place as f64 - center + 0.5) / widened;
                if x.abs() < self.reach { (self.weight)(x) } else { 0.0 }
            };
            let weights: Vec<f64> = (first..end).map(weight).collect();
            let sum: f64 = weights.iter().sum();
            let fixed = |weight: &f64| (weight / sum * f64::from(1 << FRACTION_BITS)).round() as i32;
            Taps { first, weights: weights.iter().map(fixed).collect() }
        };
        (0..output).map(one).collect()
    }
}

impl Taps {
    fn apply(&self, pixel: impl Fn(usize) -> [u8; 3]) -> [u8; 3] {
        let mut sums = [1_i32 << (FRACTION_BITS - 1); 3];
        for (step, weight) in self.weights.iter().enumerate() {
            let values = pixel(self.first + step);
            sums.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * i32::from(value));
        }
        sums.map(|sum| (sum >> FRACTION_BITS).clamp(0, 255) as u8)
    }
}

fn cubic(x: f64) -> f64 {
    const A: f64 = -0.5;
    let x = x.abs();
    if x < 1.0 { ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0 } else { (((x - 5.0) * x + 8.0) * x - 4.0) * A }
}

fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { (PI * x).sin() / (PI * x) }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pattern(height: usize, width: usize) -> Raster<u8> {
        let value = |at: usize| ((7 * (at / 3 % width) + 13 * (at / 3 / width) + 29 * (at % 3)) % 256) as u8;
        Raster { height, width, pixels: (0..height * width * 3).map(value).collect() }
    }

    #[test]
    fn flat_pictures_stay_flat_at_any_size() {
        let flat = Raster { height: 5, width: 9, pixels: vec![200; 135] };
        use ResizeFilter::{PilBicubic, PilBilinear, PilLanczos, Tf1Bilinear, TorchBilinear};
        for filter in [PilBilinear, PilBicubic, PilLanczos, TorchBilinear, Tf1Bilinear] {
            for (height, width) in [(5, 9), (3, 4), (1, 1), (20, 13)] {
                let found = flat.resized(height, width, filter);
                assert_eq!((found.height, found.width), (height, width));
                assert!(found.pixels.iter().all(|value| *value == 200), "{filter:?}");
            }
            assert_eq!(pattern(6, 7).resized(6, 7, filter), pattern(6, 7), "{filter:?} to the same size");
        }
    }

    /// Pillow 13.0: `Image.fromarray(pattern).resize((width, height), filter)` of the 20x40 pattern, its first bytes and the
    /// sum of all bytes times their places.
    #[test]
    fn pillow_small_cases() {
        for (filter, height, width, first, sum) in [
            (ResizeFilter::PilBilinear, 2, 3, [121, 143, 156, 153, 143, 123], 21836),
            (ResizeFilter::PilBilinear, 30, 5, [30, 59, 88, 81, 110, 139], 13097095),
            (ResizeFilter::PilBicubic, 2, 3, [118, 146, 163, 161, 146, 122], 21832),
            (ResizeFilter::PilBicubic, 30, 5, [25, 54, 83, 78, 107, 136], 13064105),
            (ResizeFilter::PilLanczos, 2, 3, [120, 150, 167, 164, 146, 119], 21751),
            (ResizeFilter::PilLanczos, 30, 5, [24, 53, 82, 79, 107, 133], 13056946),
        ] {
            let found = pattern(20, 40).resized(height, width, filter).pixels;
            let weighted: u64 = found.iter().zip(1..).map(|(value, place)| u64::from(*value) * place).sum();
            assert_eq!((found[..6].to_vec(), weighted), (first.to_vec(), sum), "{filter:?} {height}x{width}");
        }
    }

    #[test]
    fn two_neighbours_with_and_without_the_half_pixel() {
        let row = Raster { height: 1, width: 2, pixels: vec![0.0, 0.0, 0.0, 1.0, 1.0, 1.0] };
        let red = |raster: Raster<f32>| raster.pixels.iter().step_by(3).copied().collect::<Vec<_>>();
        assert_eq!(red(row.interpolated(1, 4, true)), [0.0, 0.25, 0.75, 1.0]);
        assert_eq!(red(row.interpolated(1, 4, false)), [0.0, 0.5, 1.0, 1.0]);
    }

    #[test]
    fn parts_and_planes() {
        let part = pattern(4, 5).cropped(1, 2, 2, 3).unwrap();
        assert_eq!(part.pixels[..3], [27, 56, 85]);
        assert_eq!((part.planes()[..3].to_vec(), pattern(4, 5).cropped(3, 0, 2, 1)), (vec![27, 34, 41], None));
        assert!(pattern(4, 5).cropped(usize::MAX, 0, 2, 1).is_none());
    }
}
