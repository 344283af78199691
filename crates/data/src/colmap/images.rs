//! `images.bin`: poses, names and what each picture sees.

use geometry::{GeometryError, Rigid};

use super::bytes::Bytes;
use super::{Detail, check_unique};
use crate::DataError;
use crate::store::{StoredFile, checked_name};

/// A feature in a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point2d {
    /// Pixels, centres at +0.5.
    pub xy: [f64; 2],
    /// The point of the model it shows, if any.
    pub point3d_id: Option<u64>,
}

/// A row of `images.bin`.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// What tracks name it by.
    pub id: u32,
    /// Rotation of `cam_from_world` as written: w, x, y, z, within 1e-3 of unit length.
    pub rotation_wxyz: [f64; 4],
    /// Translation of `cam_from_world`, in the model's unit. The camera's centre is -Rᵀt.
    pub translation: [f64; 3],
    /// Row of `cameras.bin`.
    pub camera_id: u32,
    /// Relative path of the picture, checked to stay below its folder.
    pub name: String,
    /// Features; empty when read without tracks.
    pub points: Vec<Point2d>,
}

impl Image {
    /// The pose, rotation normalised.
    ///
    /// # Errors
    /// Numbers that are no pose; none for a picture that was read from a file.
    pub fn cam_from_world(&self) -> Result<Rigid, GeometryError> {
        Rigid::from_wxyz(self.rotation_wxyz, self.translation)
    }
}

/// COLMAP's "no point".
const NO_POINT: u64 = u64::MAX;
/// x, y, point id.
const POINT2D_BYTES: u64 = 3 * 8;
/// id, pose, camera, an empty name, a count of zero.
const SMALLEST_IMAGE: u64 = 4 + 7 * 8 + 4 + 1 + 8;

/// Reads `images.bin`.
///
/// # Errors
/// See [`super::Model::read`].
pub fn read_images(file: &StoredFile, detail: Detail) -> Result<Vec<Image>, DataError> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count("images", SMALLEST_IMAGE)?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        images.push(read_image(&mut bytes, detail)?);
    }
    bytes.finish()?;
    check_unique("images", images.iter().map(|image| (image.id, image.id.to_string())), bytes.path())?;
    check_unique("images", images.iter().map(|image| (image.name.as_str(), image.name.clone())), bytes.path())?;
    Ok(images)
}

fn read_image(bytes: &mut Bytes, detail: Detail) -> Result<Image, DataError> {
    let at = bytes.at();
    let mut image = Image {
        id: bytes.u32()?,
        rotation_wxyz: bytes.f64s()?,
        translation: bytes.f64s()?,
        camera_id: bytes.u32()?,
        name: bytes.name()?,
        points: Vec::new(),
    };
    checked_name(&image.name, bytes.path())?;
    if let Err(source) = image.cam_from_world() {
        let row = format!("image {} at byte {at}", image.name);
        return Err(DataError::Calibration { row, source, path: bytes.path().to_owned() });
    }
    let count = bytes.count("features", POINT2D_BYTES)?;
    match detail {
        Detail::WithoutTracks => bytes.skip(count, POINT2D_BYTES)?,
        Detail::Whole => {
            image.points.reserve_exact(count);
            for _ in 0..count {
                let (xy, id) = (bytes.f64s()?, bytes.u64()?);
                image.points.push(Point2d { xy, point3d_id: (id != NO_POINT).then_some(id) });
            }
        }
    }
    Ok(image)
}

/// The bytes of `images.bin`.
pub fn write_images(images: &[Image]) -> Vec<u8> {
    let mut out = (images.len() as u64).to_le_bytes().to_vec();
    for image in images {
        out.extend(image.id.to_le_bytes());
        image.rotation_wxyz.iter().chain(&image.translation).for_each(|value| out.extend(value.to_le_bytes()));
        out.extend(image.camera_id.to_le_bytes());
        out.extend(image.name.as_bytes());
        out.push(0);
        out.extend((image.points.len() as u64).to_le_bytes());
        for point in &image.points {
            point.xy.iter().for_each(|value| out.extend(value.to_le_bytes()));
            out.extend(point.point3d_id.unwrap_or(NO_POINT).to_le_bytes());
        }
    }
    out
}
