//! Pinhole pictures from any lens: models know pinhole cameras only.

use geometry::glam::DVec2;
use geometry::{Camera, ImageEdit, Intrinsics, Lens};
use image::{Rgb, RgbImage};

use crate::resample::resample;
use crate::{DataError, ImageSource, View};

/// Sub-samples per output pixel and axis, so that undistorting does not alias.
const SUBSAMPLES: u32 = 2;

/// The view's picture under `edit` as a pinhole camera with the view's own K would have taken it. Directions that the lens did not see
/// are black.
pub(crate) fn load_pinhole(source: &ImageSource, view: &View, edit: &ImageEdit) -> Result<RgbImage, DataError> {
    if view.lens == Lens::Pinhole {
        return source.load(edit);
    }
    let camera = |lens| {
        Camera::new(view.intrinsics, lens).map_err(|e| DataError::Config(format!("camera {}: {e}", view.channel)))
    };
    match source {
        ImageSource::Rendered { snapshot, world_from_cam, .. } => {
            let (snapshot, world_from_cam) = (snapshot.clone(), *world_from_cam);
            ImageSource::Rendered { snapshot, camera: camera(Lens::Pinhole)?, world_from_cam }.load(edit)
        }
        ImageSource::File { .. } | ImageSource::Embedded { .. } | ImageSource::Memory { .. } => {
            let fine = fine_edit(&view.intrinsics, edit);
            Ok(remap(&source.load(&fine)?, &fine, &camera(view.lens)?, edit))
        }
    }
}

/// Shrinking first, by area, to a multiple of the final size: reading single raw pixels would alias.
fn fine_edit(raw: &Intrinsics, edit: &ImageEdit) -> ImageEdit {
    let (width, height) = (raw.width, raw.height);
    ImageEdit::identity(width, height)
        .resize((edit.width * SUBSAMPLES).min(width), (edit.height * SUBSAMPLES).min(height))
}

/// Which pixels of the view's picture under `edit` count: `[H, W]`, true where no raw pixel that the mask ignores, and no direction
/// that the lens did not see, takes part.
pub(crate) fn load_pinhole_mask(mask: &ImageSource, view: &View, edit: &ImageEdit) -> Result<Vec<bool>, DataError> {
    let mut raw = mask.decode()?;
    raw.pixels_mut().for_each(|pixel| pixel.0 = if keeps(pixel) { [255; 3] } else { [0; 3] });
    let edited = if view.lens == Lens::Pinhole {
        resample(&raw, edit)?
    } else {
        let camera = Camera::new(view.intrinsics, view.lens)
            .map_err(|e| DataError::Config(format!("camera {}: {e}", view.channel)))?;
        let fine = fine_edit(&view.intrinsics, edit);
        remap(&resample(&raw, &fine)?, &fine, &camera, edit)
    };
    Ok(edited.pixels().map(|pixel| pixel.0[0] == u8::MAX).collect())
}

/// Whether a mask's pixel is nonzero as 8-bit grey, by the luma weights of ITU-R 601 in 16-bit fixed point that Python's tools use.
pub(crate) fn keeps(Rgb([r, g, b]): &Rgb<u8>) -> bool {
    19595 * u32::from(*r) + 38470 * u32::from(*g) + 7471 * u32::from(*b) + 0x8000 >= 1 << 16
}

/// Looks every sub-sample of the pinhole picture up in the distorted one.
fn remap(distorted: &RgbImage, distorted_edit: &ImageEdit, camera: &Camera, edit: &ImageEdit) -> RgbImage {
    let k_inverse = camera.intrinsics.matrix().inverse();
    let offsets: Vec<f64> = (0..SUBSAMPLES).map(|i| (f64::from(i) + 0.5) / f64::from(SUBSAMPLES)).collect();
    let weight = 1.0 / f64::from(SUBSAMPLES * SUBSAMPLES);
    RgbImage::from_fn(edit.width, edit.height, |x, y| {
        let mut sum = [0.0; 3];
        for (dx, dy) in offsets.iter().flat_map(|dx| offsets.iter().map(move |dy| (dx, dy))) {
            let raw = edit.invert(DVec2::new(f64::from(x) + dx, f64::from(y) + dy));
            let seen = camera.project(k_inverse * raw.extend(1.0)).filter(|p| camera.intrinsics.contains(*p));
            if let Some(pixel) = seen {
                let color = bilinear(distorted, distorted_edit.apply(pixel));
                sum = std::array::from_fn(|c| sum[c] + weight * color[c]);
            }
        }
        Rgb(sum.map(|value| value.round() as u8))
    })
}

/// Colour at a continuous pixel position, borders repeated.
fn bilinear(image: &RgbImage, at: DVec2) -> [f64; 3] {
    let at = at - 0.5;
    let low = at.floor();
    let part = at - low;
    let pixel = |dx: i64, dy: i64| {
        let x = (low.x as i64 + dx).clamp(0, i64::from(image.width()) - 1);
        let y = (low.y as i64 + dy).clamp(0, i64::from(image.height()) - 1);
        image.get_pixel(x as u32, y as u32).0.map(f64::from)
    };
    let [a, b, c, d] = [pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1)];
    std::array::from_fn(|i| {
        let top = a[i] + (b[i] - a[i]) * part.x;
        let bottom = c[i] + (d[i] - c[i]) * part.x;
        top + (bottom - top) * part.y
    })
}
