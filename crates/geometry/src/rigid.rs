//! Rigid transforms in f64 and poses along a track.

use glam::{DMat3, DMat4, DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::GeometryError;

/// A rotation followed by a translation: `p_dst = rotation * p_src + translation`.
///
/// A variable of this type is named `dst_from_src`; products chain by sight: `a_from_c = a_from_b * b_from_c`.
#[doc(alias = "SE3")]
#[doc(alias = "cam_to_ego")]
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rigid {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Metres in `dst`.
    pub translation: DVec3,
}

impl Rigid {
    /// The transform that changes nothing.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation: DVec3::ZERO };

    /// From parts that are known to be sound.
    pub fn new(rotation: DQuat, translation: DVec3) -> Self {
        Self { rotation: rotation.normalize(), translation }
    }

    /// From a quaternion (w, x, y, z) and a translation as files hold them.
    ///
    /// # Errors
    /// Non-finite numbers, and a norm further than 1e-3 from 1; inside the tolerance it is normalised.
    pub fn from_wxyz(wxyz: [f64; 4], translation: [f64; 3]) -> Result<Self, GeometryError> {
        if translation.iter().any(|v| !v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "translation" });
        }
        if wxyz.iter().any(|v| !v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "rotation" });
        }
        let [w, x, y, z] = wxyz;
        let quat = DQuat::from_xyzw(x, y, z, w);
        let norm = quat.length();
        if (norm - 1.0).abs() > 1e-3 {
            return Err(GeometryError::QuaternionNorm { wxyz, norm });
        }
        Ok(Self { rotation: quat.normalize(), translation: DVec3::from_array(translation) })
    }

    /// A turn about +z (radians, counter-clockwise seen from above) and a shift.
    pub fn from_yaw(yaw_rad: f64, translation: DVec3) -> Self {
        Self { rotation: DQuat::from_rotation_z(yaw_rad), translation }
    }

    /// From a 4×4 matrix whose upper-left 3×3 is a rotation.
    pub fn from_mat4(matrix: &DMat4) -> Self {
        let rotation = DMat3::from_cols(matrix.x_axis.truncate(), matrix.y_axis.truncate(), matrix.z_axis.truncate());
        Self { rotation: DQuat::from_mat3(&rotation).normalize(), translation: matrix.w_axis.truncate() }
    }

    /// The 4×4 matrix (glam's column-major memory, mathematically row `i` column `j` as usual).
    pub fn to_mat4(&self) -> DMat4 {
        DMat4::from_rotation_translation(self.rotation, self.translation)
    }

    /// The 3×3 rotation matrix.
    pub fn rotation_matrix(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }

    /// Row-major 4×4 numbers, the layout tensors use.
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        self.to_mat4().transpose().to_cols_array_2d()
    }

    /// Quaternion as (w, x, y, z), the order every dataset file uses.
    pub fn wxyz(&self) -> [f64; 4] {
        [self.rotation.w, self.rotation.x, self.rotation.y, self.rotation.z]
    }

    /// `src_from_dst`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Maps a point of `src` into `dst`.
    pub fn transform_point(&self, point: DVec3) -> DVec3 {
        self.rotation * point + self.translation
    }

    /// Maps a direction of `src` into `dst` (no translation).
    pub fn transform_vector(&self, vector: DVec3) -> DVec3 {
        self.rotation * vector
    }

    /// Angle about +z of the image of +x, in (-pi, pi].
    pub fn yaw(&self) -> f64 {
        let x = self.rotation * DVec3::X;
        wrap_angle(x.y.atan2(x.x))
    }

    /// Angle of the turn between the two rotations, radians in [0, pi].
    pub fn angle_to(&self, other: &Self) -> f64 {
        let (a, b) = (self.rotation, other.rotation);
        2.0 * angle_between(a, if a.dot(b) < 0.0 { -b } else { b })
    }

    /// Linear translation and shortest-path slerp at `amount` in [0, 1] from `self` to `other`.
    #[must_use]
    pub fn interpolate(&self, other: &Self, amount: f64) -> Self {
        Self {
            rotation: slerp(self.rotation, other.rotation, amount),
            translation: self.translation.lerp(other.translation, amount),
        }
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;

    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: (self.rotation * rhs.rotation).normalize(),
            translation: self.transform_point(rhs.translation),
        }
    }
}

impl std::ops::Mul<DVec3> for Rigid {
    type Output = DVec3;

    fn mul(self, point: DVec3) -> DVec3 {
        self.transform_point(point)
    }
}

/// Shortest-path slerp. glam's own switches to a linear mix at a dot product of 0.9995, which costs 2e-5 rad.
fn slerp(a: DQuat, b: DQuat, amount: f64) -> DQuat {
    let b = if a.dot(b) < 0.0 { -b } else { b };
    let angle = angle_between(a, b);
    let (wa, wb) = if angle < 1e-9 {
        (1.0 - amount, amount)
    } else {
        let sin = angle.sin();
        (((1.0 - amount) * angle).sin() / sin, (amount * angle).sin() / sin)
    };
    (a * wa + b * wb).normalize()
}

/// Angle between two unit quaternions as vectors. Half chords stay exact for tiny angles, where acos(dot) loses all digits.
fn angle_between(a: DQuat, b: DQuat) -> f64 {
    2.0 * (a - b).length().atan2((a + b).length())
}

/// The angle brought into (-pi, pi].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let two_pi = std::f64::consts::TAU;
    let wrapped = angle_rad.rem_euclid(two_pi);
    if wrapped > std::f64::consts::PI { wrapped - two_pi } else { wrapped }
}

/// Poses at increasing times, interpolated between rows and never extrapolated.
#[derive(Debug, Clone)]
pub struct PoseTrack {
    timestamps_ns: Vec<i64>,
    poses: Vec<Rigid>,
    max_gap_ns: i64,
}

impl PoseTrack {
    /// From rows in any order; `max_gap_ns` is the longest interval that may be interpolated.
    pub fn new(mut rows: Vec<(i64, Rigid)>, max_gap_ns: i64) -> Self {
        rows.sort_by_key(|row| row.0);
        let (timestamps_ns, poses) = rows.into_iter().unzip();
        Self { timestamps_ns, poses, max_gap_ns }
    }

    /// The pose at one instant.
    ///
    /// # Errors
    /// [`GeometryError::NoPose`] outside the covered time or inside a gap longer than the limit.
    pub fn at(&self, timestamp_ns: i64) -> Result<Rigid, GeometryError> {
        let next = self.timestamps_ns.partition_point(|t| *t < timestamp_ns);
        if self.timestamps_ns.get(next) == Some(&timestamp_ns) {
            return Ok(self.poses[next]);
        }
        let covered = || match (self.timestamps_ns.first(), self.timestamps_ns.last()) {
            (Some(first), Some(last)) => format!("poses cover {first}..{last} ns"),
            _ => "there are no poses".to_owned(),
        };
        if next == 0 || next == self.timestamps_ns.len() {
            return Err(GeometryError::NoPose { timestamp_ns, why: covered() });
        }
        let (before, after) = (self.timestamps_ns[next - 1], self.timestamps_ns[next]);
        if after.saturating_sub(before) > self.max_gap_ns {
            let why =
                format!("the poses around it, {before} and {after} ns, are further apart than {} ns", self.max_gap_ns);
            return Err(GeometryError::NoPose { timestamp_ns, why });
        }
        let amount = (timestamp_ns - before) as f64 / (after - before) as f64;
        Ok(self.poses[next - 1].interpolate(&self.poses[next], amount))
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_2, PI};

    use super::*;

    #[test]
    fn file_order_is_w_x_y_z() {
        let quarter_turn = Rigid::from_wxyz([FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2], [0.0; 3]).unwrap();
        assert!((quarter_turn * DVec3::X - DVec3::Y).length() < 1e-15);
        assert!((quarter_turn.yaw() - FRAC_PI_2).abs() < 1e-15);
        assert!((quarter_turn.wxyz()[0] - FRAC_1_SQRT_2).abs() < 1e-15);
    }

    #[test]
    fn from_wxyz_normalises_near_units_and_refuses_the_rest() {
        let near = Rigid::from_wxyz([1.0005, 0.0, 0.0, 0.0], [1.0, 2.0, 3.0]).unwrap();
        assert_eq!(near.rotation, DQuat::IDENTITY);
        assert!(matches!(Rigid::from_wxyz([1.01, 0.0, 0.0, 0.0], [0.0; 3]), Err(GeometryError::QuaternionNorm { .. })));
        assert!(matches!(Rigid::from_wxyz([0.0; 4], [0.0; 3]), Err(GeometryError::QuaternionNorm { .. })));
        assert_eq!(
            Rigid::from_wxyz([f64::NAN, 0.0, 0.0, 0.0], [0.0; 3]),
            Err(GeometryError::NotFinite { what: "rotation" })
        );
        assert_eq!(
            Rigid::from_wxyz([1.0, 0.0, 0.0, 0.0], [0.0, f64::INFINITY, 0.0]),
            Err(GeometryError::NotFinite { what: "translation" })
        );
    }

    #[test]
    fn products_chain_and_inverses_undo() {
        let world_from_ego = Rigid::from_yaw(0.7, DVec3::new(664_439.0, 3_997_654.0, 606.0));
        let ego_from_cam = Rigid::from_wxyz([0.5, -0.5, 0.5, -0.5], [1.7, 0.1, 1.5]).unwrap();
        let point = DVec3::new(1.0, -2.0, 20.0);
        let world_from_cam = world_from_ego * ego_from_cam;
        assert!((world_from_cam * point - world_from_ego * (ego_from_cam * point)).length() < 1e-8);
        assert!((world_from_cam.inverse() * (world_from_cam * point) - point).length() < 1e-8);
        assert!((Rigid::from_mat4(&world_from_cam.to_mat4()) * point - world_from_cam * point).length() < 1e-8);
        assert_eq!(world_from_cam.to_rows()[1][3], world_from_cam.translation.y);
    }

    #[test]
    fn q_and_minus_q_turn_and_interpolate_alike() {
        let a = DQuat::from_rotation_z(0.3);
        let b = DQuat::from_rotation_z(1.1) * DQuat::from_rotation_x(0.4);
        for amount in [0.0, 0.25, 0.5, 1.0] {
            assert!(Rigid::new(a, DVec3::ZERO).angle_to(&Rigid::new(-a, DVec3::X)) < 1e-15);
            let (plain, negated) = (slerp(a, b, amount), slerp(a, -b, amount));
            assert!((plain * DVec3::X - negated * DVec3::X).length() < 1e-15);
        }
        assert!((a * DVec3::ONE - (-a) * DVec3::ONE).length() < 1e-15);
    }

    #[test]
    fn slerp_is_linear_in_the_angle_also_for_tiny_angles() {
        for total in [1e-12, 1e-6, 0.02, 1.0, 3.0] {
            let mixed = slerp(DQuat::IDENTITY, DQuat::from_rotation_z(total), 0.25);
            let angle = 2.0 * mixed.z.atan2(mixed.w);
            assert!((angle - 0.25 * total).abs() < 1e-15, "{total}");
        }
    }

    #[test]
    fn interpolation_of_headings_goes_the_short_way_round() {
        let (a, b) = (Rigid::from_yaw(3.1, DVec3::ZERO), Rigid::from_yaw(-3.1, DVec3::X));
        let middle = a.interpolate(&b, 0.5);
        assert!(PI - middle.yaw().abs() < 1e-12, "{}", middle.yaw());
        assert_eq!(middle.translation, DVec3::new(0.5, 0.0, 0.0));
    }

    #[test]
    fn angles_wrap_into_the_half_open_range() {
        assert_eq!(wrap_angle(PI), PI);
        assert_eq!(wrap_angle(-PI), PI);
        assert_eq!(wrap_angle(0.0), 0.0);
        assert!((wrap_angle(3.5) - (3.5 - 2.0 * PI)).abs() < 1e-15);
        assert!((wrap_angle(-7.0) - (2.0 * PI - 7.0)).abs() < 1e-15);
        assert_eq!(Rigid { rotation: DQuat::from_xyzw(0.0, 0.0, -1.0, 0.0), translation: DVec3::ZERO }.yaw(), PI);
    }

    #[test]
    fn a_track_interpolates_and_never_extrapolates() {
        let at = |x: f64| Rigid::from_yaw(0.1 * x, DVec3::new(x, 0.0, 0.0));
        let rows = vec![(100, at(1.0)), (0, at(0.0)), (1000, at(5.0))];
        let track = PoseTrack::new(rows, 200);
        assert_eq!(track.at(100).unwrap(), at(1.0));
        let between = track.at(25).unwrap();
        assert!((between.translation.x - 0.25).abs() < 1e-15 && (between.yaw() - 0.025).abs() < 1e-15);
        for (outside, named) in [(-1, "0..1000"), (1001, "0..1000"), (500, "100 and 1000")] {
            let error = track.at(outside).unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
        assert!(PoseTrack::new(Vec::new(), 200).at(0).is_err());
        let absurd = PoseTrack::new(vec![(i64::MIN, at(0.0)), (i64::MAX, at(1.0))], 200);
        assert!(absurd.at(0).is_err());
    }
}
