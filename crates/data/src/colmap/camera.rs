//! `cameras.bin`: lens models and their parameters.

use geometry::{GeometryError, Intrinsics, Lens};

use super::bytes::Bytes;
use super::check_unique;
use crate::DataError;
use crate::store::StoredFile;

/// A lens model by COLMAP's name, with the parameters in COLMAP's order; lengths in pixels, centres of pixels at +0.5.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum CameraModel {
    /// f, cx, cy.
    SimplePinhole([f64; 3]),
    /// fx, fy, cx, cy.
    Pinhole([f64; 4]),
    /// f, cx, cy, k.
    SimpleRadial([f64; 4]),
    /// f, cx, cy, k1, k2.
    Radial([f64; 5]),
    /// fx, fy, cx, cy, k1, k2, p1, p2.
    OpenCv([f64; 8]),
    /// fx, fy, cx, cy, k1, k2, k3, k4.
    OpenCvFisheye([f64; 8]),
}

impl CameraModel {
    /// COLMAP's number of the model.
    pub fn id(&self) -> i32 {
        match self {
            Self::SimplePinhole(_) => 0,
            Self::Pinhole(_) => 1,
            Self::SimpleRadial(_) => 2,
            Self::Radial(_) => 3,
            Self::OpenCv(_) => 4,
            Self::OpenCvFisheye(_) => 5,
        }
    }

    /// The parameters in COLMAP's order.
    pub fn params(&self) -> &[f64] {
        match self {
            Self::SimplePinhole(p) => p,
            Self::Pinhole(p) | Self::SimpleRadial(p) => p,
            Self::Radial(p) => p,
            Self::OpenCv(p) | Self::OpenCvFisheye(p) => p,
        }
    }

    /// The same lens in this project's terms.
    pub fn lens(&self) -> Lens {
        match *self {
            Self::SimplePinhole(_) | Self::Pinhole(_) => Lens::Pinhole,
            Self::SimpleRadial([.., k]) => Lens::BrownConrady { k: [k, 0.0, 0.0], p: [0.0; 2] },
            Self::Radial([.., k1, k2]) => Lens::BrownConrady { k: [k1, k2, 0.0], p: [0.0; 2] },
            Self::OpenCv([.., k1, k2, p1, p2]) => Lens::BrownConrady { k: [k1, k2, 0.0], p: [p1, p2] },
            Self::OpenCvFisheye([.., k1, k2, k3, k4]) => Lens::KannalaBrandt { k: [k1, k2, k3, k4] },
        }
    }

    /// The model that holds a camera; `None` for a lens that none of the models above holds (a sixth-order radial term).
    pub fn of(intrinsics: &Intrinsics, lens: &Lens) -> Option<Self> {
        let Intrinsics { fx, fy, cx, cy, .. } = *intrinsics;
        match *lens {
            Lens::Pinhole => Some(Self::Pinhole([fx, fy, cx, cy])),
            Lens::BrownConrady { k: [k1, k2, k3], p: [p1, p2] } => {
                (k3 == 0.0).then_some(Self::OpenCv([fx, fy, cx, cy, k1, k2, p1, p2]))
            }
            Lens::KannalaBrandt { k: [k1, k2, k3, k4] } => Some(Self::OpenCvFisheye([fx, fy, cx, cy, k1, k2, k3, k4])),
        }
    }

    fn focal_center(&self) -> [f64; 4] {
        match *self {
            Self::SimplePinhole([f, cx, cy]) | Self::SimpleRadial([f, cx, cy, _]) | Self::Radial([f, cx, cy, ..]) => {
                [f, f, cx, cy]
            }
            Self::Pinhole([fx, fy, cx, cy])
            | Self::OpenCv([fx, fy, cx, cy, ..])
            | Self::OpenCvFisheye([fx, fy, cx, cy, ..]) => [fx, fy, cx, cy],
        }
    }

    /// `None` for a number that names no model above: the length of its parameters is unknown.
    fn read(id: i32, bytes: &mut Bytes) -> Option<Result<Self, DataError>> {
        Some(match id {
            0 => bytes.f64s().map(Self::SimplePinhole),
            1 => bytes.f64s().map(Self::Pinhole),
            2 => bytes.f64s().map(Self::SimpleRadial),
            3 => bytes.f64s().map(Self::Radial),
            4 => bytes.f64s().map(Self::OpenCv),
            5 => bytes.f64s().map(Self::OpenCvFisheye),
            _ => return None,
        })
    }
}

/// A row of `cameras.bin`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// What pictures name it by.
    pub id: u32,
    /// Picture width, px.
    pub width: u32,
    /// Picture height, px.
    pub height: u32,
    /// Lens and parameters.
    pub model: CameraModel,
}

impl Camera {
    /// Focal lengths, principal point and size; COLMAP's pixel centres are ours.
    pub fn intrinsics(&self) -> Intrinsics {
        let [fx, fy, cx, cy] = self.model.focal_center();
        Intrinsics { fx, fy, cx, cy, width: self.width, height: self.height }
    }

    fn check(&self) -> Result<(), GeometryError> {
        let camera = geometry::Camera::new(self.intrinsics(), self.model.lens())?;
        let Intrinsics { fx, fy, .. } = camera.intrinsics;
        match [("focal length fx", fx), ("focal length fy", fy)].into_iter().find(|(_, value)| *value <= 0.0) {
            Some((what, value)) => Err(GeometryError::NotPositive { what, value }),
            None => Ok(()),
        }
    }
}

/// id, model, width, height and the shortest list of parameters.
const SMALLEST_CAMERA: u64 = 4 + 4 + 8 + 8 + 3 * 8;

/// Reads `cameras.bin`.
///
/// # Errors
/// See [`super::Model::read`].
pub fn read_cameras(file: &StoredFile) -> Result<Vec<Camera>, DataError> {
    let mut bytes = Bytes::open(file)?;
    let count = bytes.count("cameras", SMALLEST_CAMERA)?;
    let mut cameras = Vec::with_capacity(count);
    for _ in 0..count {
        cameras.push(read_camera(&mut bytes)?);
    }
    bytes.finish()?;
    check_unique("cameras", cameras.iter().map(|camera| (camera.id, camera.id.to_string())), bytes.path())?;
    Ok(cameras)
}

fn read_camera(bytes: &mut Bytes) -> Result<Camera, DataError> {
    let at = bytes.at();
    let (id, model_id) = (bytes.u32()?, bytes.i32()?);
    let [width, height] = [bytes.u64()?, bytes.u64()?];
    let size = u32::try_from(width).ok().zip(u32::try_from(height).ok());
    let (width, height) = size.ok_or_else(|| {
        bytes.format(at, format_args!("camera {id} has pictures of {width}x{height}, which nothing can hold"))
    })?;
    let model = CameraModel::read(model_id, bytes)
        .ok_or_else(|| bytes.format(at + 4, format_args!("camera {id} has the unknown model {model_id}")))??;
    let camera = Camera { id, width, height, model };
    match camera.check() {
        Ok(()) => Ok(camera),
        Err(source) => {
            let row = format!("camera {id} at byte {at}");
            Err(DataError::Calibration { row, source, path: bytes.path().to_owned() })
        }
    }
}

/// The bytes of `cameras.bin`.
pub fn write_cameras(cameras: &[Camera]) -> Vec<u8> {
    let mut out = (cameras.len() as u64).to_le_bytes().to_vec();
    for camera in cameras {
        out.extend(camera.id.to_le_bytes());
        out.extend(camera.model.id().to_le_bytes());
        out.extend(u64::from(camera.width).to_le_bytes());
        out.extend(u64::from(camera.height).to_le_bytes());
        camera.model.params().iter().for_each(|value| out.extend(value.to_le_bytes()));
    }
    out
}
