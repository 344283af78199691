//! Pictures and masks.

use std::collections::BTreeSet;
use std::path::Path;

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder};
use rayon::prelude::*;

use super::scene::Shot;
use crate::undistort::keeps;
use crate::{DataError, ImageSource, jpeg, sample::in_frame, staging};

/// What was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Counts {
    pub(super) pictures: usize,
    pub(super) copied: usize,
    pub(super) masks: usize,
}

/// Channels with a mask for any picture; readers then expect one for every picture.
pub(super) fn masked<'a>(shots: &[Shot<'a>]) -> BTreeSet<&'a str> {
    shots.iter().filter(|shot| shot.view.mask.is_some()).map(|shot| shot.channel).collect()
}

/// Writes the pictures and masks of a scene. `advance` is called with the number of pictures just finished.
pub(super) fn write(
    shots: &[Shot<'_>],
    folder: &Path,
    jpeg_quality: u8,
    advance: &mut dyn FnMut(usize),
) -> Result<Counts, DataError> {
    let masked = masked(shots);
    for channel in shots.iter().map(|shot| shot.channel).collect::<BTreeSet<_>>() {
        staging::create_dir(&folder.join("images").join(channel))?;
    }
    for channel in &masked {
        staging::create_dir(&folder.join("masks").join(channel))?;
    }
    let mut counts = Counts::default();
    // A few pictures per thread at a time, so that progress moves and few pictures are in memory.
    for chunk in shots.chunks(2 * rayon::current_num_threads()) {
        let write_one = |shot: &Shot<'_>| {
            let copied = picture(shot, folder, jpeg_quality)?;
            let has_mask = masked.contains(shot.channel);
            if has_mask {
                mask(shot, folder)?;
            }
            Ok((copied, has_mask))
        };
        let written: Vec<(bool, bool)> = chunk
            .par_iter()
            .map(|shot| write_one(shot).map_err(|error| in_frame(&shot.frame.id, error)))
            .collect::<Result<_, DataError>>()?;
        counts.pictures += written.len();
        counts.copied += written.iter().filter(|one| one.0).count();
        counts.masks += written.iter().filter(|one| one.1).count();
        advance(chunk.len());
    }
    Ok(counts)
}

/// Copies a JPEG file as it is, encodes everything else. True for a copy.
fn picture(shot: &Shot<'_>, folder: &Path, quality: u8) -> Result<bool, DataError> {
    let path = folder.join("images").join(shot.name());
    let Some(source) = &shot.view.image else { return Ok(false) };
    if let ImageSource::File { file, .. } = source {
        source.inspect()?;
        let bytes = file.bytes()?;
        if jpeg::is_jpeg(&bytes) {
            staging::write(&path, &bytes)?;
            return Ok(true);
        }
    }
    let picture = source.decode()?;
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality)
        .write_image(picture.as_raw(), picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| DataError::Image { why: error.to_string(), path: path.clone() })?;
    staging::write(&path, &bytes)?;
    Ok(false)
}

/// 8-bit grey, 0 to ignore and 255 to keep; a picture without a mask keeps everything.
fn mask(shot: &Shot<'_>, folder: &Path) -> Result<(), DataError> {
    let path = folder.join("masks").join(shot.channel).join(format!("{}.png", shot.stamp));
    let (width, height) = (shot.view.intrinsics.width, shot.view.intrinsics.height);
    let grey: Vec<u8> = match &shot.view.mask {
        Some(source) => source.decode()?.pixels().map(|pixel| if keeps(pixel) { u8::MAX } else { 0 }).collect(),
        None => vec![u8::MAX; width as usize * height as usize],
    };
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes)
        .write_image(&grey, width, height, ExtendedColorType::L8)
        .map_err(|error| DataError::Image { why: error.to_string(), path: path.clone() })?;
    staging::write(&path, &bytes)
}
