//! Strict JPEG decoding: the size comes from the frame header before any pixel buffer exists, and a picture that ends early or is
//! damaged inside is refused instead of being filled up with grey.
//!
//! Pictures are decoded whole, also for a network that sees a twentieth of their pixels: most of the time goes into Huffman codes, which
//! a decoder of half size must read as well, and the one in pure Rust takes a scan that ends early for a whole one.
//! `benches/RESULTS.md` has the figures.

use std::path::Path;

use image::RgbImage;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::DataError;

/// What the markers of a JPEG say without decoding a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct JpegOutline {
    /// Width and height in the frame header.
    pub size: (u32, u32),
    /// Where the end-of-image marker begins, if it was reached.
    pub end: Option<usize>,
    /// Sequential coding in one scan without restart markers, as cameras and encoders write by default.
    pub plain: bool,
}

/// True for bytes that begin like a JPEG.
pub(crate) fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&[0xFF, 0xD8, 0xFF])
}

/// Walks the markers. `header_only` stops at the frame header, so that a prefix of the file is enough.
///
/// # Errors
/// What is wrong with the marker structure, as text.
pub(crate) fn outline(bytes: &[u8], header_only: bool) -> Result<JpegOutline, String> {
    if !is_jpeg(bytes) {
        return Err("it does not begin like a JPEG".to_owned());
    }
    let (mut size, mut sequential, mut scans, mut restarts) = (None, false, 0, false);
    let mut at = 2;
    let end = loop {
        let Some((marker, after)) = next_marker(bytes, at) else { break None };
        at = after;
        match marker {
            0xD9 => break Some(after - 2),
            // Markers without a length: restarts and TEM.
            0xD0..=0xD7 | 0x01 => continue,
            0xDA => scans += 1,
            0xDD => restarts = true,
            _ => {}
        }
        let Some(length) = bytes.get(at..at + 2).map(|b| usize::from(b[0]) << 8 | usize::from(b[1])) else {
            break None;
        };
        // Frame headers are C0..CF without the tables DHT (C4), JPG (C8) and DAC (CC).
        if matches!(marker, 0xC0..=0xCF) && !matches!(marker, 0xC4 | 0xC8 | 0xCC) {
            let header = bytes.get(at + 3..at + 7).ok_or("the frame header is cut off")?;
            let side = |i: usize| u32::from(header[i]) << 8 | u32::from(header[i + 1]);
            size = Some((side(2), side(0)));
            sequential = marker <= 0xC1;
            if header_only {
                break None;
            }
        }
        at += length.max(2);
    };
    let size = size.ok_or("no frame header")?;
    Ok(JpegOutline { size, end, plain: sequential && scans == 1 && !restarts })
}

/// The next marker at or behind `at`, skipping entropy-coded data, stuffed zeros and fill bytes.
fn next_marker(bytes: &[u8], mut at: usize) -> Option<(u8, usize)> {
    loop {
        at += bytes.get(at..)?.iter().position(|b| *b == 0xFF)?;
        while *bytes.get(at)? == 0xFF {
            at += 1;
        }
        let marker = bytes[at];
        at += 1;
        if marker != 0 {
            return Some((marker, at));
        }
    }
}

/// More than the decoder's bit buffer of eight bytes.
const READ_AHEAD: usize = 16;

/// All pixels of a complete, sound JPEG as RGB, in the memory of `pixels`, whose content is lost.
///
/// # Errors
/// [`DataError::Image`] for anything the format forbids, [`DataError::ImageSize`] when the frame header differs from `want`.
pub(crate) fn decode(bytes: &[u8], want: (u32, u32), path: &Path, mut pixels: Vec<u8>) -> Result<RgbImage, DataError> {
    let bad = |why: String| DataError::Image { why, path: path.to_owned() };
    let outline = outline(bytes, false).map_err(bad)?;
    if outline.size != want {
        return Err(DataError::ImageSize { got: outline.size, want, path: path.to_owned() });
    }
    let Some(end) = outline.end else {
        return Err(bad("the file ends before the end-of-image marker".to_owned()));
    };
    // Behind an end marker the decoder invents zeros for missing data even when strict; without one it complains. A few bytes more than it
    // reads ahead keep it from complaining about whole pictures.
    let padded = outline.plain.then(|| [&bytes[..end], &[0; READ_AHEAD]].concat());
    let options = DecoderOptions::default()
        .set_strict_mode(true)
        .set_max_width(want.0 as usize)
        .set_max_height(want.1 as usize)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder =
        zune_jpeg::JpegDecoder::new_with_options(ZCursor::new(padded.as_deref().unwrap_or(bytes)), options);
    decoder.decode_headers().map_err(|error| bad(error.to_string()))?;
    let size = want.0 as usize * want.1 as usize * 3;
    if decoder.output_buffer_size() != Some(size) {
        return Err(bad(format!("the decoder would not return {}x{} RGB pixels", want.0, want.1)));
    }
    pixels.clear();
    pixels.resize(size, 0);
    decoder.decode_into(&mut pixels).map_err(|error| bad(error.to_string()))?;
    RgbImage::from_raw(want.0, want.1, pixels).ok_or_else(|| bad("the decoder returned another size".to_owned()))
}
