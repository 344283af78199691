//! Pixels on demand, already brought to network size.

use std::cell::Cell;
use std::path::Path;
use std::sync::Arc;

use geometry::{ImageEdit, Rigid};
use image::RgbImage;

use crate::resample::resample;
use crate::store::StoredFile;
use crate::{DataError, EmbeddedPicture, jpeg};

/// Where the pixels of a view are.
#[derive(Debug, Clone)]
pub enum ImageSource {
    /// An encoded picture on disk whose size must equal the table's.
    File {
        /// The file, checked to lie inside the dataset's root.
        file: StoredFile,
        /// Width and height the tables announce.
        size: (u32, u32),
    },
    /// An encoded picture inside a larger file, such as a record or a table.
    Embedded {
        /// Where it is; holds no bytes.
        picture: EmbeddedPicture,
        /// Width and height the calibration announces.
        size: (u32, u32),
    },
    /// A picture that is in memory, such as a generated one.
    Memory {
        /// The picture.
        picture: Arc<RgbImage>,
        /// Width and height the calibration announces.
        size: (u32, u32),
    },
    /// A camera in the procedural world; rendered exactly at the asked size.
    Rendered {
        /// The world at one instant.
        snapshot: Arc<world::Snapshot>,
        /// Raw camera.
        camera: geometry::Camera,
        /// Camera pose.
        world_from_cam: Rigid,
    },
}

thread_local! {
    /// The raw pixels of the last picture this thread has loaded. Megabytes that are given back to the system and asked for again with
    /// every picture cost a fifth of the time to load it.
    static SCRATCH: Cell<Vec<u8>> = const { Cell::new(Vec::new()) };
}

impl ImageSource {
    /// Width and height of the raw picture, px.
    pub fn size(&self) -> (u32, u32) {
        match self {
            Self::File { size, .. } | Self::Embedded { size, .. } | Self::Memory { size, .. } => *size,
            Self::Rendered { camera, .. } => (camera.intrinsics.width, camera.intrinsics.height),
        }
    }

    /// The edited picture, RGB8 of the edit's size.
    ///
    /// A stored picture is decoded and resampled (area average when shrinking); a rendered source casts its rays through the edited
    /// camera, so no resampling takes place.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Image`] or [`DataError::ImageSize`], naming the file; [`DataError::Config`] for an edit
    /// that is not made of scale, shift and mirror.
    pub fn load(&self, edit: &ImageEdit) -> Result<RgbImage, DataError> {
        match self {
            Self::Rendered { snapshot, camera, world_from_cam } => render(snapshot, camera, world_from_cam, edit),
            Self::Memory { picture, size } => resample(sized(picture, *size)?, edit),
            Self::File { .. } | Self::Embedded { .. } => {
                let raw = self.decode_into(SCRATCH.take())?;
                let edited = resample(&raw, edit);
                SCRATCH.set(raw.into_raw());
                edited
            }
        }
    }

    /// A stored picture's own pixels; a rendered source gives its raw camera's picture.
    ///
    /// # Errors
    /// As [`ImageSource::load`].
    pub fn decode(&self) -> Result<RgbImage, DataError> {
        self.decode_into(Vec::new())
    }

    /// The same, in the memory of `pixels` where the format allows it.
    fn decode_into(&self, pixels: Vec<u8>) -> Result<RgbImage, DataError> {
        match self {
            Self::File { file, size } => decode_bytes(&file.bytes()?, *size, file.path(), pixels),
            Self::Embedded { picture, size } => decode_bytes(&picture.bytes()?, *size, picture.path(), pixels),
            Self::Memory { picture, size } => sized(picture, *size).cloned(),
            Self::Rendered { snapshot, camera, world_from_cam } => {
                let edit = ImageEdit::identity(camera.intrinsics.width, camera.intrinsics.height);
                render(snapshot, camera, world_from_cam, &edit)
            }
        }
    }

    /// Whether a file exists, holds the announced size and does not end early, without decoding its pixels. Rendered sources always pass.
    ///
    /// # Errors
    /// As [`ImageSource::load`], as far as the markers of the file show it.
    pub fn inspect(&self) -> Result<(), DataError> {
        match self {
            Self::File { file, size } => inspect_file(file, *size),
            Self::Embedded { picture, size } => inspect_bytes(&picture.bytes()?, *size, picture.path()),
            Self::Memory { picture, size } => sized(picture, *size).map(drop),
            Self::Rendered { .. } => Ok(()),
        }
    }

    /// The bytes of a JPEG as they are stored, [inspected](ImageSource::inspect); `None` for everything else.
    pub(crate) fn jpeg_bytes(&self) -> Result<Option<Vec<u8>>, DataError> {
        let (bytes, size, path) = match self {
            Self::File { file, size } => (file.bytes()?, size, file.path()),
            Self::Embedded { picture, size } => (picture.bytes()?, size, picture.path()),
            Self::Memory { .. } | Self::Rendered { .. } => return Ok(None),
        };
        inspect_bytes(&bytes, *size, path)?;
        Ok(jpeg::is_jpeg(&bytes).then_some(bytes))
    }
}

/// Rays through the edited camera: a flip is a negative focal length, a crop a shifted principal point, a resize a scaled one.
fn render(
    snapshot: &world::Snapshot,
    raw: &geometry::Camera,
    world_from_cam: &Rigid,
    edit: &ImageEdit,
) -> Result<RgbImage, DataError> {
    let camera = geometry::Camera::new(edit.intrinsics(&raw.intrinsics), raw.lens)
        .map_err(|error| DataError::Config(format!("the edited camera cannot be rendered: {error}")))?;
    // Loader threads render one picture each, so a picture must not spread over the thread pool.
    let rendering = snapshot.render_serial(&camera, world_from_cam, &world::RenderOptions::default());
    RgbImage::from_raw(rendering.width, rendering.height, rendering.rgb)
        .ok_or_else(|| DataError::Config("the renderer returned a picture of another size".to_owned()))
}

/// A picture in memory, checked as a file's would be.
fn sized(picture: &RgbImage, want: (u32, u32)) -> Result<&RgbImage, DataError> {
    let got = picture.dimensions();
    if got == want { Ok(picture) } else { Err(DataError::ImageSize { got, want, path: "a picture in memory".into() }) }
}

/// All pixels of a picture whose size is known from its table; checked against the file's header before a pixel buffer is reserved. A JPEG
/// is decoded into the memory of `pixels`.
fn decode_bytes(bytes: &[u8], size: (u32, u32), path: &Path, pixels: Vec<u8>) -> Result<RgbImage, DataError> {
    if jpeg::is_jpeg(bytes) { jpeg::decode(bytes, size, path, pixels) } else { decode_other(bytes, size, path) }
}

/// PNG, the other format that datasets and writers use.
fn decode_other(bytes: &[u8], want: (u32, u32), path: &Path) -> Result<RgbImage, DataError> {
    let bad = |why: String| DataError::Image { why, path: path.to_owned() };
    let reader = || image::ImageReader::new(std::io::Cursor::new(bytes)).with_guessed_format();
    let got = reader()
        .map_err(|error| bad(error.to_string()))?
        .into_dimensions()
        .map_err(|_| bad("neither a JPEG nor a PNG".to_owned()))?;
    if got != want {
        return Err(DataError::ImageSize { got, want, path: path.to_owned() });
    }
    let decoded = reader().map_err(|error| bad(error.to_string()))?.decode();
    Ok(decoded.map_err(|error| bad(error.to_string()))?.to_rgb8())
}

fn inspect_file(file: &StoredFile, size: (u32, u32)) -> Result<(), DataError> {
    let (head, tail) = file.ends(64 * 1024)?;
    if looks_whole(&head, tail, size) {
        return Ok(());
    }
    // Long application segments, trailing bytes, other formats and every real fault: decode and say it exactly.
    decode_bytes(&file.bytes()?, size, file.path(), Vec::new()).map(drop)
}

fn inspect_bytes(bytes: &[u8], size: (u32, u32), path: &Path) -> Result<(), DataError> {
    let tail = bytes.last_chunk().copied().unwrap_or_default();
    if looks_whole(bytes, tail, size) { Ok(()) } else { decode_bytes(bytes, size, path, Vec::new()).map(drop) }
}

fn looks_whole(head: &[u8], tail: [u8; 2], size: (u32, u32)) -> bool {
    tail == [0xFF, 0xD9] && jpeg::outline(head, true).is_ok_and(|outline| outline.size == size)
}

#[cfg(test)]
mod tests {
    use image::{ImageEncoder, Rgb};

    use super::*;

    fn jpeg_bytes(width: u32, height: u32) -> Vec<u8> {
        let picture = RgbImage::from_fn(width, height, |x, y| Rgb([(x * 5) as u8, (y * 7) as u8, ((x ^ y) * 3) as u8]));
        let mut bytes = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 95)
            .write_image(picture.as_raw(), width, height, image::ExtendedColorType::Rgb8)
            .unwrap();
        bytes
    }

    fn source(folder: &Path, name: &str, bytes: &[u8], size: (u32, u32)) -> ImageSource {
        let path = folder.join(name);
        std::fs::write(&path, bytes).unwrap();
        ImageSource::File { file: path.into(), size }
    }

    #[test]
    fn every_truncation_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let bytes = jpeg_bytes(48, 32);
        let edit = ImageEdit::identity(48, 32);
        assert!(source(folder.path(), "whole.jpg", &bytes, (48, 32)).load(&edit).is_ok());
        for length in 0..bytes.len() {
            let cut = source(folder.path(), "cut.jpg", &bytes[..length], (48, 32));
            let error = cut.load(&edit).unwrap_err();
            assert!(matches!(error, DataError::Image { .. }), "{length} of {} bytes gave {error:?}", bytes.len());
            assert!(error.to_string().ends_with("cut.jpg"), "{error}");
            assert!(cut.inspect().is_err());
        }
    }

    #[test]
    fn a_cut_scan_with_an_end_marker_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let bytes = jpeg_bytes(64, 64);
        let scan = bytes.windows(2).position(|w| w == [0xFF, 0xDA]).unwrap() + 14;
        for length in (scan..bytes.len() - 40).filter(|length| bytes[length - 1] != 0xFF) {
            let patched = [&bytes[..length], &[0xFF, 0xD9]].concat();
            let error = source(folder.path(), "patched.jpg", &patched, (64, 64)).load(&ImageEdit::identity(64, 64));
            assert!(matches!(error, Err(DataError::Image { .. })), "{length} of {} bytes: {error:?}", bytes.len());
        }
    }

    #[test]
    fn flat_and_grey_pictures_are_whole() {
        let folder = tempfile::tempdir().unwrap();
        for (width, height) in [(1, 1), (8, 8), (17, 9), (640, 400)] {
            let flat = RgbImage::from_pixel(width, height, Rgb([20, 120, 220]));
            let mut bytes = Vec::new();
            let encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, 50);
            encoder.write_image(flat.as_raw(), width, height, image::ExtendedColorType::Rgb8).unwrap();
            let picture = source(folder.path(), "flat.jpg", &bytes, (width, height));
            let loaded = picture.load(&ImageEdit::identity(width, height)).unwrap();
            assert!(loaded.pixels().all(|pixel| pixel.0.iter().zip([20, 120, 220]).all(|(a, b)| a.abs_diff(b) < 9)));
            let grey = image::GrayImage::from_pixel(width, height, image::Luma([77]));
            let path = folder.path().join("grey.jpg");
            grey.save(&path).unwrap();
            let loaded = ImageSource::File { file: path.into(), size: (width, height) }
                .load(&ImageEdit::identity(width, height))
                .unwrap();
            assert!(loaded.pixels().all(|pixel| pixel.0.iter().all(|value| value.abs_diff(77) < 3)));
        }
    }

    #[test]
    fn trailing_bytes_after_the_end_are_allowed() {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = jpeg_bytes(16, 16);
        bytes.extend([0; 37]);
        let picture = source(folder.path(), "tail.jpg", &bytes, (16, 16));
        picture.inspect().unwrap();
        picture.load(&ImageEdit::identity(16, 16)).unwrap();
    }

    #[test]
    fn nothing_of_the_picture_before_shows() {
        let folder = tempfile::tempdir().unwrap();
        let sizes = [(64, 48), (16, 16), (64, 48), (80, 40), (17, 9)];
        for (width, height) in sizes {
            let bytes = jpeg_bytes(width, height);
            let picture = source(folder.path(), "a.jpg", &bytes, (width, height));
            let edit = ImageEdit::identity(width, height);
            assert_eq!(picture.load(&edit).unwrap(), picture.decode().unwrap());
            assert!(source(folder.path(), "cut.jpg", &bytes[..bytes.len() / 2], (width, height)).load(&edit).is_err());
        }
    }

    #[test]
    fn sizes_are_checked_before_decoding() {
        let folder = tempfile::tempdir().unwrap();
        let mut bytes = jpeg_bytes(16, 16);
        let frame = bytes.windows(2).position(|w| w == [0xFF, 0xC0]).unwrap();
        bytes[frame + 5..frame + 9].copy_from_slice(&[0xFF, 0xDC, 0xFF, 0xDC]);
        let error = source(folder.path(), "huge.jpg", &bytes, (16, 16)).load(&ImageEdit::identity(16, 16)).unwrap_err();
        assert!(matches!(error, DataError::ImageSize { got: (65500, 65500), want: (16, 16), .. }), "{error:?}");
    }

    #[test]
    fn png_and_grey_files_load_and_other_files_do_not() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("grey.png");
        image::GrayImage::from_fn(9, 5, |x, y| image::Luma([(x + 10 * y) as u8])).save(&path).unwrap();
        let picture = ImageSource::File { file: path.into(), size: (9, 5) }.load(&ImageEdit::identity(9, 5)).unwrap();
        assert_eq!(picture.get_pixel(3, 4), &Rgb([43, 43, 43]));
        let text = source(folder.path(), "text.jpg", b"hello there", (9, 5));
        assert!(matches!(text.load(&ImageEdit::identity(9, 5)), Err(DataError::Image { .. })));
        let absent = ImageSource::File { file: folder.path().join("absent.jpg").into(), size: (1, 1) };
        assert!(matches!(absent.load(&ImageEdit::identity(1, 1)), Err(DataError::Missing { .. })));
    }
}
