//! Camera names, axes and calibration, the same in both releases.

use std::path::Path;

use geometry::glam::{DMat3, DMat4, DQuat, DVec3};
use geometry::{CameraRig, GeometryError, Intrinsics, Lens, RigCamera, Rigid};

use crate::DataError;

/// Names in the order of their numbers, which begin at 1 (`CameraName` of `dataset.proto`). Perception cars have the first five.
pub(crate) const CHANNELS: [&str; 8] =
    ["FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT", "REAR_LEFT", "REAR", "REAR_RIGHT"];

/// Greatest deviation of a stored pose from a rotation with a shift: files hold them as 32-bit floats at worst.
const MAX_DEVIATION: f64 = 1e-3;

/// The name of a camera number.
pub(crate) fn channel(number: i64) -> Option<&'static str> {
    CHANNELS.get(usize::try_from(number.checked_sub(1)?).ok()?).copied()
}

/// The number of a camera name.
pub(crate) fn number(channel: &str) -> Option<i64> {
    CHANNELS.iter().position(|name| *name == channel).map(|index| index as i64 + 1)
}

/// The turn from our camera axes (x right, y down, z forward) to those of the files (x forward, y left, z up).
pub(crate) fn waymo_from_cam() -> Rigid {
    // Columns: our x, y, z in the files' axes.
    let turn = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    Rigid::new(DQuat::from_mat3(&turn), DVec3::ZERO)
}

/// A pose from 16 numbers, rows first.
///
/// # Errors
/// Another count, numbers that are not finite, a matrix that is not a rotation with a shift.
pub(crate) fn pose(what: &'static str, numbers: &[f64]) -> Result<Rigid, GeometryError> {
    let numbers: [f64; 16] =
        numbers.try_into().map_err(|_| GeometryError::Count { what, got: numbers.len(), want: 16 })?;
    if numbers.iter().any(|number| !number.is_finite()) {
        return Err(GeometryError::NotFinite { what });
    }
    let matrix = DMat4::from_cols_array(&numbers).transpose();
    let turn = DMat3::from_mat4(matrix);
    let unit = turn.transpose() * turn - DMat3::IDENTITY;
    let last_row = matrix.row(3).to_array().into_iter().zip([0.0, 0.0, 0.0, 1.0]).map(|(got, want)| got - want);
    let mut deviation = unit.to_cols_array().into_iter().chain(last_row).fold(0.0, |most: f64, v| most.max(v.abs()));
    if deviation <= MAX_DEVIATION && turn.determinant() < 0.0 {
        deviation = 2.0;
    }
    if deviation > MAX_DEVIATION {
        return Err(GeometryError::NotRigid { what, deviation });
    }
    Ok(Rigid::from_mat4(&matrix))
}

/// The 16 numbers of a pose, rows first.
pub(crate) fn pose_numbers(pose: &Rigid) -> [f64; 16] {
    pose.to_mat4().transpose().to_cols_array()
}

/// One camera as the files describe it: `[f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3]` in OpenCV's pixel convention, the pose in the
/// files' axes, and the size.
pub(super) struct StoredCamera<'a> {
    pub number: i64,
    pub intrinsic: &'a [f64],
    pub vehicle_from_camera: &'a [f64],
    pub size: (i64, i64),
}

impl StoredCamera<'_> {
    /// In our conventions. All-zero coefficients are a pinhole.
    pub fn rig_camera(&self, path: &Path) -> Result<RigCamera, DataError> {
        let channel = channel(self.number).ok_or_else(|| unknown_camera(&self.number.to_string(), path))?;
        let calibration = |source| DataError::Calibration { row: channel.to_owned(), source, path: path.to_owned() };
        let got = self.intrinsic.len();
        let [fx, fy, cx, cy, k1, k2, p1, p2, k3]: [f64; 9] = self
            .intrinsic
            .try_into()
            .map_err(|_| calibration(GeometryError::Count { what: "camera intrinsic", got, want: 9 }))?;
        let side = |what: &'static str, value: i64| {
            let wrong = GeometryError::NotPositive { what, value: value as f64 };
            u32::try_from(value).map_err(|_| calibration(wrong))
        };
        let size = (side("picture width", self.size.0)?, side("picture height", self.size.1)?);
        let intrinsics = Intrinsics { fx, fy, cx: cx + 0.5, cy: cy + 0.5, width: size.0, height: size.1 };
        let coefficients = [k1, k2, p1, p2, k3];
        let lens = if coefficients.iter().all(|v| *v == 0.0) {
            Lens::Pinhole
        } else {
            Lens::BrownConrady { k: [k1, k2, k3], p: [p1, p2] }
        };
        let vehicle_from_camera = pose("camera pose", self.vehicle_from_camera).map_err(calibration)?;
        let ego_from_cam = vehicle_from_camera * waymo_from_cam();
        let camera = RigCamera { channel: channel.to_owned(), intrinsics, lens, ego_from_cam };
        camera.camera().map_err(calibration)?;
        Ok(camera)
    }
}

/// The cameras in rig order: the open chain from left to right.
///
/// # Errors
/// [`DataError::DuplicateToken`] for two of one name.
pub(super) fn in_rig_order(cameras: Vec<RigCamera>, path: &Path) -> Result<Vec<RigCamera>, DataError> {
    for (at, camera) in cameras.iter().enumerate() {
        if cameras.iter().skip(at + 1).any(|other| other.channel == camera.channel) {
            let (table, token) = ("camera_calibration", camera.channel.clone());
            return Err(DataError::DuplicateToken { table, token, path: path.to_owned() });
        }
    }
    let rig = CameraRig { cameras };
    let order = rig.rig_order().map_err(|source| DataError::Calibration {
        row: "of all cameras".to_owned(),
        source,
        path: path.to_owned(),
    })?;
    let mut slots: Vec<Option<RigCamera>> = rig.cameras.into_iter().map(Some).collect();
    Ok(order.into_iter().filter_map(|index| slots.get_mut(index)?.take()).collect())
}

pub(super) fn unknown_camera(name: &str, path: &Path) -> DataError {
    DataError::Column {
        column: "camera name".to_owned(),
        why: format!("{name:?} is none of {}", CHANNELS.join(", ")),
        path: path.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_and_numbers_belong_together() {
        assert_eq!((channel(1), channel(5), channel(8)), (Some("FRONT"), Some("SIDE_RIGHT"), Some("REAR_RIGHT")));
        assert_eq!((channel(0), channel(9), channel(-1), channel(i64::MIN)), (None, None, None, None));
        assert!(CHANNELS.iter().all(|name| channel(number(name).unwrap()) == Some(name)));
    }

    #[test]
    fn axes_are_permuted() {
        let waymo_from_cam = waymo_from_cam();
        assert!((waymo_from_cam * DVec3::Z - DVec3::X).length() < 1e-15, "forward");
        assert!((waymo_from_cam * DVec3::X - DVec3::NEG_Y).length() < 1e-15, "right");
        assert!((waymo_from_cam * DVec3::Y - DVec3::NEG_Z).length() < 1e-15, "down");
    }

    #[test]
    fn poses_are_rotations_with_a_shift() {
        let world_from_ego = Rigid::from_yaw(0.7, DVec3::new(-25_204.7, 42_393.2, -160.0));
        let numbers = pose_numbers(&world_from_ego);
        assert_eq!((numbers[3], numbers[7], numbers[15]), (-25_204.7, 42_393.2, 1.0));
        let read = pose("pose", &numbers).unwrap();
        assert!(read.angle_to(&world_from_ego) < 1e-15 && read.translation == world_from_ego.translation);
        let narrow = numbers.map(|number| f64::from(number as f32));
        assert!(pose("pose", &narrow).unwrap().angle_to(&world_from_ego) < 1e-7);
        assert!(matches!(pose("pose", &numbers[..12]), Err(GeometryError::Count { got: 12, want: 16, .. })));
        let change = |at: usize, value: f64| {
            let mut numbers = numbers;
            numbers[at] = value;
            pose("pose", &numbers).unwrap_err()
        };
        assert!(matches!(change(0, f64::NAN), GeometryError::NotFinite { .. }));
        assert!(matches!(change(0, 0.9), GeometryError::NotRigid { .. }));
        assert!(matches!(change(15, 0.0), GeometryError::NotRigid { .. }));
        assert!(matches!(change(10, -1.0), GeometryError::NotRigid { deviation: 2.0, .. }));
    }
}
