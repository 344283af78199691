//! Brings a picture to network size exactly as its [`ImageEdit`] says: pixel centres at +0.5, content moves with the matrix.
//!
//! Shrinking averages the area that a new pixel covers, enlarging interpolates linearly between old pixel centres, and whatever lies
//! outside the old picture is black. Scale, shift and mirror act on columns and rows separately, so the filter is separable.

use geometry::ImageEdit;
use image::RgbImage;

use crate::DataError;

/// The weighted source indices of every output index of an axis: equally many for each, padded with weights of zero, so that the loops
/// over them never change their length.
struct Taps {
    /// First source index of each output index.
    first: Vec<usize>,
    /// `count` weights for each output index.
    weights: Vec<f32>,
    count: usize,
}

impl Taps {
    fn iter(&self) -> impl Iterator<Item = (usize, &[f32])> {
        self.first.iter().copied().zip(self.weights.chunks_exact(self.count))
    }
}

/// The edited picture.
///
/// # Errors
/// [`DataError::Config`] for an edit that is not made of scale, shift and mirror.
pub(crate) fn resample(source: &RgbImage, edit: &ImageEdit) -> Result<RgbImage, DataError> {
    let m = edit.img_from_raw.transpose().to_cols_array_2d();
    let plain = m[0][1] == 0.0 && m[1][0] == 0.0 && m[2] == [0.0, 0.0, 1.0];
    let scaled = [m[0][0], m[1][1]].iter().all(|s| s.is_finite() && *s != 0.0);
    if !plain || !scaled || !m[0][2].is_finite() || !m[1][2].is_finite() {
        return Err(DataError::Config(format!("an image edit may only scale, shift and mirror, but is {m:?}")));
    }
    let mut output = RgbImage::new(edit.width, edit.height);
    if source.is_empty() || output.is_empty() {
        return Ok(output);
    }
    let columns = taps(m[0][0], m[0][2], source.width(), edit.width);
    let rows = taps(m[1][1], m[1][2], source.height(), edit.height);
    let (source_stride, stride) = (source.width() as usize * 3, edit.width as usize * 3);
    // One value more than the pixels have, so that four values can be read at the last one.
    let mut line = vec![0.0f32; source_stride + 1];
    let mut sums = vec![0u16; source_stride];
    for ((first, weights), target) in rows.iter().zip(output.chunks_exact_mut(stride)) {
        let pixels = &source.as_raw()[first * source_stride..][..weights.len() * source_stride];
        weigh_rows(pixels, weights, &mut line[..source_stride], &mut sums);
        weigh_columns(&line, &columns, target);
    }
    Ok(output)
}

/// As many bytes as a u16 can sum.
const MOST_ROWS: usize = 257;

/// The weighted sum of rows of bytes. The rows inside a shrunk pixel all weigh the same: their bytes are summed before they are
/// weighed, eight at a time instead of four.
fn weigh_rows(rows: &[u8], weights: &[f32], line: &mut [f32], sums: &mut [u16]) {
    let stride = line.len();
    let start = weights.iter().take_while(|weight| **weight == 0.0).count();
    let end = weights.iter().rposition(|weight| *weight != 0.0).map_or(start, |last| last + 1);
    let (rows, weights) = (&rows[start * stride..end * stride], &weights[start..end]);
    let alike = |inner: &[f32]| inner.len() <= MOST_ROWS && inner.windows(2).all(|pair| pair[0] == pair[1]);
    match weights {
        [first, inner @ .., last] if !inner.is_empty() && alike(inner) => {
            let (first_row, rest) = rows.split_at(stride);
            let (inner_rows, last_row) = rest.split_at(inner.len() * stride);
            sums.fill(0);
            for row in inner_rows.chunks_exact(stride) {
                sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += u16::from(*value));
            }
            for (((out, a), sum), b) in line.iter_mut().zip(first_row).zip(sums).zip(last_row) {
                *out = first * f32::from(*a) + inner[0] * f32::from(*sum) + last * f32::from(*b);
            }
        }
        _ => {
            line.fill(0.0);
            for (row, weight) in rows.chunks_exact(stride).zip(weights) {
                line.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * f32::from(*value));
            }
        }
    }
}

/// The weighted sums of RGB triples, rounded. A fourth value is summed along with each triple and dropped: four fill a register.
fn weigh_columns(line: &[f32], columns: &Taps, target: &mut [u8]) {
    for ((first, weights), target) in columns.iter().zip(target.chunks_exact_mut(3)) {
        let mut sum = [0.5f32; 4];
        for (weight, values) in weights.iter().zip(line[first * 3..].windows(4).step_by(3)) {
            sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += weight * value);
        }
        target.iter_mut().zip(sum).for_each(|(target, sum)| *target = sum as u8);
    }
}

/// Weights along one axis: output pixel i covers the source interval between `(i - shift) / scale` and `(i + 1 - shift) / scale`.
fn taps(scale: f64, shift: f64, source: u32, output: u32) -> Taps {
    let spans: Vec<(usize, Vec<f32>)> = (0..output)
        .map(|i| {
            let (a, b) = ((f64::from(i) - shift) / scale, (f64::from(i) + 1.0 - shift) / scale);
            let (low, high) = (a.min(b), a.max(b));
            if high - low >= 1.0 - 1e-9 { area(low, high, source) } else { linear(0.5 * (low + high), source) }
        })
        .collect();
    let count = spans.iter().map(|span| span.1.len()).max().unwrap_or(0).max(1);
    let mut taps = Taps { first: Vec::new(), weights: vec![0.0; count * spans.len()], count };
    for ((first, span), weights) in spans.into_iter().zip(taps.weights.chunks_exact_mut(count)) {
        // Padding behind the last source index would lead outside, so it stands in front there.
        let padded = first.min(source as usize - count);
        weights[first - padded..][..span.len()].copy_from_slice(&span);
        taps.first.push(padded);
    }
    taps
}

/// Mean over an interval; the part outside the picture counts as black.
fn area(low: f64, high: f64, source: u32) -> (usize, Vec<f32>) {
    let (inside_low, inside_high) = (low.max(0.0), high.min(f64::from(source)));
    if inside_high <= inside_low {
        return (0, Vec::new());
    }
    let first = inside_low.floor() as usize;
    let last = (inside_high.ceil() as usize).min(source as usize);
    let weights = (first..last)
        .map(|k| {
            let covered = inside_high.min(k as f64 + 1.0) - inside_low.max(k as f64);
            (covered / (high - low)) as f32
        })
        .collect();
    (first, weights)
}

/// Between the two nearest pixel centres; the outer half of a border pixel keeps that pixel's value.
fn linear(center: f64, source: u32) -> (usize, Vec<f32>) {
    if source == 0 || center < 0.0 || center > f64::from(source) {
        return (0, Vec::new());
    }
    let position = (center - 0.5).clamp(0.0, f64::from(source - 1));
    let first = (position.floor() as usize).min((source as usize).saturating_sub(2));
    let amount = (position - first as f64) as f32;
    let weights = if source == 1 { vec![1.0] } else { vec![1.0 - amount, amount] };
    (first, weights)
}

#[cfg(test)]
mod tests {
    use geometry::glam::DVec2;
    use image::Rgb;

    use super::*;

    /// Red grows to the right, green downwards, both linear in the pixel centre.
    fn gradient(width: u32, height: u32, slope: (f64, f64)) -> RgbImage {
        RgbImage::from_fn(width, height, |x, y| {
            let value = |at: u32, slope: f64| ((f64::from(at) + 0.5) * slope).round() as u8;
            Rgb([value(x, slope.0), value(y, slope.1), 77])
        })
    }

    fn assert_gradient(edit: &ImageEdit, raw: (u32, u32), slope: (f64, f64), border: f64) {
        let edited = resample(&gradient(raw.0, raw.1, slope), edit).unwrap();
        assert_eq!(edited.dimensions(), (edit.width, edit.height));
        let mut compared = 0;
        for (x, y, pixel) in edited.enumerate_pixels() {
            let at = edit.invert(DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5));
            let inside = |v: f64, size: u32| v > border && v < f64::from(size) - border;
            if inside(at.x, raw.0) && inside(at.y, raw.1) {
                let want = [at.x * slope.0, at.y * slope.1, 77.0];
                for (got, want) in pixel.0.iter().zip(want) {
                    // Rounding of the source and of the result: half a level each.
                    assert!((f64::from(*got) - want).abs() <= 1.01, "({x}, {y}) holds {pixel:?}, wanted {want}");
                }
                compared += 1;
            }
        }
        assert!(compared > 50, "only {compared} pixels compared");
    }

    #[test]
    fn a_gradient_stays_the_analytic_gradient() {
        let id = ImageEdit::identity(160, 90);
        let slope = (1.5, 2.5);
        assert_gradient(&id.resize(40, 22), (160, 90), slope, 4.0);
        assert_gradient(&id.resize(37, 41), (160, 90), slope, 4.0);
        assert_gradient(&id.resize(401, 233), (160, 90), slope, 1.0);
        assert_gradient(&id.resize(61, 233), (160, 90), slope, 3.0);
        assert_gradient(&id.resize(71, 40).crop(-3, 5, 60, 44).flip(), (160, 90), slope, 4.0);
        // A portrait picture squeezed to a square, as Argoverse's front camera is.
        let portrait = ImageEdit::identity(1550, 2048).resize(256, 256);
        assert_gradient(&portrait, (1550, 2048), (0.16, 0.12), 8.0);
    }

    #[test]
    fn identity_keeps_every_byte_and_flip_mirrors_exactly() {
        let source = RgbImage::from_fn(31, 17, |x, y| Rgb([(x * 8) as u8, (y * 15) as u8, ((x * y) % 251) as u8]));
        let id = ImageEdit::identity(31, 17);
        assert_eq!(resample(&source, &id).unwrap(), source);
        assert_eq!(resample(&source, &id.flip()).unwrap(), image::imageops::flip_horizontal(&source));
    }

    #[test]
    fn crops_outside_are_black_and_inside_are_exact() {
        let source = RgbImage::from_fn(20, 10, |x, y| Rgb([100 + x as u8, 100 + y as u8, 200]));
        let edited = resample(&source, &ImageEdit::identity(20, 10).crop(-4, -2, 30, 16)).unwrap();
        for (x, y, pixel) in edited.enumerate_pixels() {
            let inside = (4..24).contains(&x) && (2..12).contains(&y);
            let want = if inside { *source.get_pixel(x - 4, y - 2) } else { Rgb([0, 0, 0]) };
            assert_eq!(*pixel, want, "at ({x}, {y})");
        }
    }

    /// Share of source pixel `k` in the interval an output pixel covers.
    fn share(scale: f64, shift: f64, output: u32, k: u32) -> f64 {
        let ends = [0.0, 1.0].map(|end| (f64::from(output) + end - shift) / scale);
        let (low, high) = (ends[0].min(ends[1]), ends[0].max(ends[1]));
        (high.min(f64::from(k) + 1.0) - low.max(f64::from(k))).max(0.0) / (high - low)
    }

    #[test]
    fn shrinking_by_any_factor_is_the_area_average_of_every_pixel() {
        let id = ImageEdit::identity(70, 300);
        let source = RgbImage::from_fn(70, 300, |x, y| Rgb([0, 1, 2].map(|c| (x * 97 + y * 193 + c * 71) as u8)));
        // One output row covers 300 source rows, more than a u16 can sum; other edits shift, crop and mirror.
        let edits =
            [id.resize(9, 1), id.resize(69, 299), id.resize(13, 40).crop(-2, 3, 17, 30).flip(), id.resize(70, 7)];
        for edit in edits {
            let edited = resample(&source, &edit).unwrap();
            let m = edit.img_from_raw.transpose().to_cols_array_2d();
            for (x, y, pixel) in edited.enumerate_pixels() {
                let mut want = [0.0; 3];
                for (k, l, value) in source.enumerate_pixels() {
                    let weight = share(m[0][0], m[0][2], x, k) * share(m[1][1], m[1][2], y, l);
                    (0..3).for_each(|c| want[c] += weight * f64::from(value.0[c]));
                }
                for (got, want) in pixel.0.iter().zip(want) {
                    assert!((f64::from(*got) - want).abs() <= 0.501, "{edit:?} at ({x}, {y}): {got} for {want}");
                }
            }
        }
        assert_eq!(resample(&source, &id.crop(500, 0, 5, 5)).unwrap(), RgbImage::new(5, 5));
    }

    #[test]
    fn shrinking_by_four_is_the_mean_of_sixteen() {
        let source = RgbImage::from_fn(8, 8, |x, y| Rgb([((x * 37 + y * 11) % 256) as u8, 0, 255]));
        let edited = resample(&source, &ImageEdit::identity(8, 8).resize(2, 2)).unwrap();
        for (x, y, pixel) in edited.enumerate_pixels() {
            let block = (0..16).map(|i| u32::from(source.get_pixel(x * 4 + i % 4, y * 4 + i / 4).0[0]));
            let mean = block.sum::<u32>() as f64 / 16.0;
            assert!((f64::from(pixel.0[0]) - mean).abs() <= 0.51);
            assert_eq!(pixel.0[2], 255);
        }
    }
}
