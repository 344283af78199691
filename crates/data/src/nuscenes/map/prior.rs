//! The semantic prior: a grey picture of road and sidewalk, 10 px/m, row 0 at the northern edge. Decoded row by row into one bit per
//! pixel, because the largest would take 1.2 GB.

use std::io::Cursor;

use png::{BitDepth, ColorType, Decoder};

use crate::DataError;
use crate::store::StoredFile;

const PIXELS_PER_M: f64 = 10.0;
/// The value of road and sidewalk.
const COVERED: u8 = 255;

/// Where road or sidewalk is.
#[derive(Debug, Clone, PartialEq)]
pub struct MapPrior {
    size: [usize; 2],
    bits: Vec<u64>,
}

impl MapPrior {
    /// Decodes a picture.
    ///
    /// # Errors
    /// [`DataError::Image`] for anything but a whole 8-bit grey PNG, [`DataError::Missing`] and [`DataError::Io`].
    pub fn read(file: &StoredFile) -> Result<Self, DataError> {
        let bad = |why: String| DataError::Image { why, path: file.path().to_owned() };
        let mut reader =
            Decoder::new(Cursor::new(file.bytes()?)).read_info().map_err(|error| bad(error.to_string()))?;
        let info = reader.info();
        if info.color_type != ColorType::Grayscale || info.bit_depth != BitDepth::Eight || info.interlaced {
            return Err(bad("it is no plain 8-bit grey PNG".to_owned()));
        }
        let size = [info.width as usize, info.height as usize];
        // Grows with the rows that really come: the size in the header proves nothing.
        let mut bits = Vec::new();
        while let Some(row) = reader.next_row().map_err(|error| bad(error.to_string()))? {
            bits.extend(
                row.data().chunks(64).map(|pixels| {
                    pixels.iter().rev().fold(0u64, |word, pixel| word << 1 | u64::from(*pixel == COVERED))
                }),
            );
        }
        if bits.len() != size[0].div_ceil(64) * size[1] {
            return Err(bad("it ends early".to_owned()));
        }
        Ok(Self { size, bits })
    }

    /// Width and height in pixels, 0.1 m each.
    pub fn size(&self) -> [usize; 2] {
        self.size
    }

    /// Whether a pixel shows road or sidewalk; row 0 is the northern edge. `None` outside.
    pub fn pixel(&self, column: usize, row: usize) -> Option<bool> {
        let [width, height] = self.size;
        if column >= width || row >= height {
            return None;
        }
        let word = self.bits.get(row * width.div_ceil(64) + column / 64)?;
        Some(word >> (column % 64) & 1 == 1)
    }

    /// Whether a point of the map, metres from its south-western corner, is road or sidewalk, by the official rounding. `None` outside.
    pub fn covers(&self, x: f64, y: f64) -> Option<bool> {
        let column = (x * PIXELS_PER_M).round_ties_even();
        let row = (self.size[1] as f64 - y * PIXELS_PER_M).round_ties_even();
        if !(column >= 0.0 && row >= 0.0) {
            return None;
        }
        self.pixel(column as usize, row as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn row_zero_is_north_and_every_bit_is_its_pixel() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.png");
        let value =
            |x: u32, y: u32| if (x * 7 + y * 13).is_multiple_of(5) || (x, y) == (129, 0) { 255 } else { x as u8 % 200 };
        image::GrayImage::from_fn(130, 70, |x, y| image::Luma([value(x, y)])).save(&path).unwrap();
        let prior = MapPrior::read(&path.clone().into()).unwrap();
        assert_eq!(prior.size(), [130, 70]);
        for y in 0..70 {
            for x in 0..130 {
                assert_eq!(prior.pixel(x as usize, y as usize), Some(value(x, y) == 255));
            }
        }
        assert_eq!(prior.pixel(130, 0), None);
        assert_eq!(prior.covers(12.9, 7.0), prior.pixel(129, 0));
        assert_eq!(prior.covers(0.0, 7.0), prior.pixel(0, 0));
        assert_eq!(prior.covers(0.5, 0.1), prior.pixel(5, 69));
        assert_eq!((prior.covers(-1.0, 1.0), prior.covers(1.0, 8.0), prior.covers(f64::NAN, 1.0)), (None, None, None));
        let bytes = std::fs::read(&path).unwrap();
        for length in (0..bytes.len() - 12).step_by(97) {
            std::fs::write(&path, &bytes[..length]).unwrap();
            let error = MapPrior::read(&path.clone().into()).unwrap_err();
            assert!(matches!(error, DataError::Image { .. }), "{length} of {} bytes: {error}", bytes.len());
        }
        image::RgbImage::new(4, 4).save(&path).unwrap();
        assert!(MapPrior::read(&path.into()).is_err());
    }
}
