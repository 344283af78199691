//! `points3D.bin`: the sparse points and the pictures that see them.

use super::bytes::Bytes;
use super::{Detail, check_unique};
use crate::DataError;
use crate::store::StoredFile;

/// A picture's feature that shows a point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrackElement {
    /// Row of `images.bin`.
    pub image_id: u32,
    /// Index into that picture's features.
    pub point2d_index: u32,
}

/// A row of `points3D.bin`.
#[derive(Debug, Clone, PartialEq)]
pub struct Point3d {
    /// What features name it by.
    pub id: u64,
    /// World position in the model's unit, finite.
    pub xyz: [f64; 3],
    /// Colour.
    pub rgb: [u8; 3],
    /// Mean reprojection error, px; -1 where it was not computed.
    pub error: f64,
    /// Who sees it; empty when read without tracks.
    pub track: Vec<TrackElement>,
}

/// image id, feature index.
const TRACK_ELEMENT_BYTES: u64 = 2 * 4;
/// id, position, colour, error, a count of zero.
const SMALLEST_POINT: u64 = 8 + 3 * 8 + 3 + 8 + 8;

/// Reads `points3D.bin`.
///
/// # Errors
/// See [`super::Model::read`].
pub fn read_points(file: &StoredFile, detail: Detail) -> Result<Vec<Point3d>, DataError> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count("points", SMALLEST_POINT)?;
    let mut points = Vec::with_capacity(count);
    for _ in 0..count {
        points.push(read_point(&mut bytes, detail)?);
    }
    bytes.finish()?;
    check_unique("points3D", points.iter().map(|point| (point.id, point.id.to_string())), bytes.path())?;
    Ok(points)
}

fn read_point(bytes: &mut Bytes, detail: Detail) -> Result<Point3d, DataError> {
    let at = bytes.at();
    let (id, xyz) = (bytes.u64()?, bytes.f64s::<3>()?);
    if xyz.iter().any(|value| !value.is_finite()) {
        return Err(bytes.format(at, format_args!("point {id} has a position that is no number")));
    }
    let mut point = Point3d { id, xyz, rgb: bytes.u8s()?, error: bytes.f64()?, track: Vec::new() };
    let count = bytes.count("track elements", TRACK_ELEMENT_BYTES)?;
    match detail {
        Detail::WithoutTracks => bytes.skip(count, TRACK_ELEMENT_BYTES)?,
        Detail::Whole => {
            point.track.reserve_exact(count);
            for _ in 0..count {
                point.track.push(TrackElement { image_id: bytes.u32()?, point2d_index: bytes.u32()? });
            }
        }
    }
    Ok(point)
}

/// The bytes of `points3D.bin`.
pub fn write_points(points: &[Point3d]) -> Vec<u8> {
    let mut out = (points.len() as u64).to_le_bytes().to_vec();
    for point in points {
        out.extend(point.id.to_le_bytes());
        point.xyz.iter().for_each(|value| out.extend(value.to_le_bytes()));
        out.extend(point.rgb);
        out.extend(point.error.to_le_bytes());
        out.extend((point.track.len() as u64).to_le_bytes());
        for element in &point.track {
            out.extend(element.image_id.to_le_bytes());
            out.extend(element.point2d_index.to_le_bytes());
        }
    }
    out
}
