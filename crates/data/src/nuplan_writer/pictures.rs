//! Pictures of all logs: copied where they are JPEG files of the right size, else decoded or rendered and encoded.

use std::path::Path;

use geometry::ImageEdit;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;

use super::config::NuPlanWriterConfig;
use super::plan::{Plan, PlannedImage};
use crate::staging as files;
use crate::{DataError, ImageSource, jpeg};

/// What the manifest says about the pictures.
pub(super) fn describe(config: &NuPlanWriterConfig) -> String {
    let quality = config.jpeg_quality;
    match config.image_size {
        None => format!("jpeg; source JPEG files copied, others encoded with quality {quality}; not resampled"),
        Some((width, height)) => {
            format!(
                "jpeg, quality {quality}; files resampled to {width}x{height} by area average, rendered ones made at that size"
            )
        }
    }
}

/// Writes all pictures below `blobs` and returns their number.
pub(super) fn write(
    plans: &[Plan<'_>],
    config: &NuPlanWriterConfig,
    blobs: &Path,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<usize, DataError> {
    let images: Vec<(&PlannedImage<'_>, &ImageSource)> = plans
        .iter()
        .flat_map(|plan| &plan.images)
        .filter_map(|image| image.view.image.as_ref().map(|source| (image, source)))
        .collect();
    for plan in plans {
        for camera in &plan.cameras {
            files::create_dir(&blobs.join(&plan.name).join(&camera.channel))?;
        }
    }
    let mut done = 0;
    // A few pictures per thread at a time, so that progress moves and few pictures are in memory.
    for chunk in images.chunks(2 * rayon::current_num_threads()) {
        chunk.par_iter().try_for_each(|(image, source)| {
            let path = blobs.join(&image.name);
            files::write(&path, &encoded(image, source, config, &path)?)
        })?;
        done += chunk.len();
        progress(done, images.len());
    }
    Ok(images.len())
}

fn encoded(
    image: &PlannedImage<'_>,
    source: &ImageSource,
    config: &NuPlanWriterConfig,
    path: &Path,
) -> Result<Vec<u8>, DataError> {
    if let (ImageSource::File { file, .. }, None) = (source, config.image_size) {
        let bytes = file.bytes()?;
        if jpeg::is_jpeg(&bytes) {
            // A damaged picture must not travel on.
            source.decode()?;
            return Ok(bytes);
        }
    }
    let raw = &image.view.intrinsics;
    let edit = ImageEdit::identity(raw.width, raw.height);
    let edit = config.image_size.map_or(edit, |(width, height)| edit.resize(width, height));
    let picture = source.load(&edit)?;
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, config.jpeg_quality)
        .encode(picture.as_raw(), picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| DataError::Image { why: error.to_string(), path: path.to_owned() })?;
    Ok(bytes)
}
