//! The cameras of one vehicle and which of them are neighbours.

use std::f64::consts::TAU;

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::{Camera, GeometryError, Intrinsics, Lens, Rigid, wrap_angle};

/// One camera on a vehicle.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigCamera {
    /// The channel's name in its dataset.
    pub channel: String,
    /// Focal lengths, principal point, size of the raw picture.
    pub intrinsics: Intrinsics,
    /// Lens of the raw picture.
    #[serde(default)]
    pub lens: Lens,
    /// Mounting pose.
    pub ego_from_cam: Rigid,
}

impl RigCamera {
    /// The projection model.
    ///
    /// # Errors
    /// Unusable intrinsics or lens numbers.
    pub fn camera(&self) -> Result<Camera, GeometryError> {
        Camera::new(self.intrinsics, self.lens)
    }

    /// Direction of the optical axis in ego, radians from +x, left positive.
    pub fn azimuth(&self) -> f64 {
        let axis = self.ego_from_cam.transform_vector(DVec3::Z);
        axis.y.atan2(axis.x)
    }

    /// Azimuths of the left-most and right-most directions of the picture's middle row, radians relative to the optical axis
    /// (left positive), so that the span of sight is `azimuth() + right ..= azimuth() + left`.
    ///
    /// # Errors
    /// Unusable intrinsics or lens numbers.
    pub fn horizontal_span(&self) -> Result<(f64, f64), GeometryError> {
        let camera = self.camera()?;
        let i = &self.intrinsics;
        let middle = f64::from(i.height) * 0.5;
        let angle = |u: f64| {
            let ray = camera.unproject(DVec2::new(u, middle));
            // Where the border lies beyond the lens's image circle, the circle ends the view.
            let outermost = camera.max_angle().copysign((i.cx - u) * i.fx);
            ray.map_or(outermost, |ray| -ray.x.atan2(ray.z))
        };
        let (first, last) = (angle(0.0), angle(f64::from(i.width)));
        Ok((first.max(last), first.min(last)))
    }
}

/// Which cameras see a common direction, and whether the views close a ring around the car.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjacency {
    /// For camera i, its neighbour to the left (counter-clockwise), if their views overlap.
    pub left: Vec<Option<usize>>,
    /// For camera i, its neighbour to the right (clockwise).
    pub right: Vec<Option<usize>>,
    /// True when following the right neighbours comes back to the start.
    pub closed: bool,
}

/// Ordered cameras of one vehicle; rigs are compared by value, never by a dataset's name.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraRig {
    /// The cameras in rig order.
    pub cameras: Vec<RigCamera>,
}

impl CameraRig {
    /// Number of cameras.
    pub fn len(&self) -> usize {
        self.cameras.len()
    }

    /// True for a rig without cameras.
    pub fn is_empty(&self) -> bool {
        self.cameras.is_empty()
    }

    /// Indices clockwise seen from above, starting with the camera whose optical axis is closest to straight ahead.
    pub fn clockwise_order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.len()).collect();
        let ahead = |i: &usize| self.cameras[*i].azimuth().abs();
        let Some(front) = order.iter().copied().min_by(|a, b| ahead(a).total_cmp(&ahead(b))) else {
            return order;
        };
        order.sort_by(|a, b| self.clockwise_angle(front, *a).total_cmp(&self.clockwise_angle(front, *b)));
        // Another camera of the same azimuth may have been listed before the front camera.
        let place = order.iter().position(|i| *i == front).unwrap_or(0);
        order[..=place].rotate_right(1);
        order
    }

    /// Indices in rig order: a closed ring clockwise from the front, an open chain from its left end to its right end.
    ///
    /// # Errors
    /// Unusable intrinsics or lens numbers.
    pub fn rig_order(&self) -> Result<Vec<usize>, GeometryError> {
        let mut order = self.clockwise_order();
        if self.adjacency()?.closed {
            return Ok(order);
        }
        let mut widest_gap = (f64::INFINITY, 0);
        for position in 0..order.len() {
            let before = order[(position + order.len() - 1) % order.len()];
            let overlap = self.overlap(before, order[position])?;
            if overlap < widest_gap.0 {
                widest_gap = (overlap, position);
            }
        }
        order.rotate_left(widest_gap.1);
        Ok(order)
    }

    /// Neighbours on the ring by overlap of horizontal spans: camera i and the next one clockwise are neighbours when they see a
    /// common direction. A rig without a view to the rear is an open chain.
    ///
    /// # Errors
    /// Unusable intrinsics or lens numbers.
    pub fn adjacency(&self) -> Result<Adjacency, GeometryError> {
        let n = self.len();
        let order = self.clockwise_order();
        let mut adjacency = Adjacency { left: vec![None; n], right: vec![None; n], closed: false };
        for position in 0..n {
            let (a, b) = (order[position], order[(position + 1) % n]);
            if a != b && self.overlap(a, b)? > 0.0 {
                adjacency.right[a] = Some(b);
                adjacency.left[b] = Some(a);
            }
        }
        adjacency.closed = n > 1 && adjacency.right.iter().all(Option::is_some);
        Ok(adjacency)
    }

    /// How far camera `b` is turned clockwise from camera `a`, radians in [0, 2 pi).
    fn clockwise_angle(&self, a: usize, b: usize) -> f64 {
        let angle = (self.cameras[a].azimuth() - self.cameras[b].azimuth()).rem_euclid(TAU);
        // Rounding just below zero must not wrap to a full turn.
        if angle > TAU - 1e-9 { 0.0 } else { angle }
    }

    /// Overlap in radians between the right border of camera `a` and the left border of the camera `b` clockwise of it;
    /// negative for a gap.
    ///
    /// # Errors
    /// Unusable intrinsics or lens numbers.
    pub fn overlap(&self, a: usize, b: usize) -> Result<f64, GeometryError> {
        let (first, second) = (&self.cameras[a], &self.cameras[b]);
        let (_, right) = first.horizontal_span()?;
        let (left, _) = second.horizontal_span()?;
        Ok(left - right - self.clockwise_angle(a, b))
    }

    /// The rig mounted on a frame moved by `ego_from_old`: every camera's pose is multiplied from the left.
    #[must_use]
    pub fn moved(&self, ego_from_old: &Rigid) -> Self {
        let cameras = self
            .cameras
            .iter()
            .map(|camera| RigCamera { ego_from_cam: *ego_from_old * camera.ego_from_cam, ..camera.clone() })
            .collect();
        Self { cameras }
    }

    /// All cameras turned about the ego's z axis, left positive: the paper's rotated novel views.
    #[must_use]
    pub fn rotated(&self, yaw_rad: f64) -> Self {
        self.moved(&Rigid::from_yaw(wrap_angle(yaw_rad), DVec3::ZERO))
    }
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DQuat};

    use super::*;

    /// A level pinhole camera looking along `azimuth_deg` with this horizontal field of view.
    fn camera(azimuth_deg: f64, fov_deg: f64) -> RigCamera {
        let f = 50.0 / (fov_deg.to_radians() * 0.5).tan();
        // Columns: camera x, y, z in ego.
        let forward = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
        let turn = Rigid::from_yaw(azimuth_deg.to_radians(), DVec3::new(1.0, 0.0, 1.5));
        RigCamera {
            channel: format!("at {azimuth_deg}"),
            intrinsics: Intrinsics { fx: f, fy: f, cx: 50.0, cy: 30.0, width: 100, height: 60 },
            lens: Lens::Pinhole,
            ego_from_cam: turn * Rigid::new(DQuat::from_mat3(&forward), DVec3::ZERO),
        }
    }

    fn rig(azimuths_deg: &[f64], fov_deg: f64) -> CameraRig {
        CameraRig { cameras: azimuths_deg.iter().map(|a| camera(*a, fov_deg)).collect() }
    }

    #[test]
    fn azimuth_and_span_of_a_level_camera() {
        let left = camera(90.0, 60.0);
        assert!((left.azimuth().to_degrees() - 90.0).abs() < 1e-12);
        let (from_left, to_right) = left.horizontal_span().unwrap();
        assert!((from_left.to_degrees() - 30.0).abs() < 1e-12 && (to_right.to_degrees() + 30.0).abs() < 1e-12);
        let mirrored = Intrinsics { fx: -left.intrinsics.fx, ..left.intrinsics };
        assert_eq!(RigCamera { intrinsics: mirrored, ..left }.horizontal_span().unwrap(), (from_left, to_right));
    }

    #[test]
    fn a_border_beyond_the_image_circle_ends_the_span_there() {
        let mut wide = camera(0.0, 60.0);
        wide.lens = Lens::KannalaBrandt { k: [-0.2, 0.0, 0.0, 0.0] };
        wide.intrinsics.fx = 20.0;
        wide.intrinsics.fy = 20.0;
        let (left, right) = wide.horizontal_span().unwrap();
        // θ (1 - 0.2 θ²) has its peak at sqrt(1 / 0.6).
        assert!((left - (1.0_f64 / 0.6).sqrt()).abs() < 2e-3 && (left + right).abs() < 1e-12);
    }

    #[test]
    fn order_starts_ahead_and_runs_clockwise() {
        let rig = rig(&[120.0, -120.0, 1.0, 60.0, 180.0, -60.0], 70.0);
        assert_eq!(rig.clockwise_order(), [2, 5, 1, 4, 0, 3]);
        assert_eq!(rig.rig_order().unwrap(), rig.clockwise_order());
        assert!(CameraRig { cameras: Vec::new() }.clockwise_order().is_empty());
    }

    #[test]
    fn a_stereo_pair_keeps_the_front_camera_first() {
        let rig = rig(&[0.5, 0.0, 0.0, 90.0], 60.0);
        assert_eq!(rig.clockwise_order(), [1, 2, 3, 0]);
    }

    #[test]
    fn six_wide_views_close_and_six_narrow_views_do_not() {
        let azimuths = [0.0, -60.0, -120.0, 180.0, 120.0, 60.0];
        let closed = rig(&azimuths, 64.0).adjacency().unwrap();
        assert!(closed.closed);
        assert_eq!(closed.right, [1, 2, 3, 4, 5, 0].map(Some));
        assert_eq!(closed.left, [5, 0, 1, 2, 3, 4].map(Some));
        let open = rig(&azimuths, 56.0);
        assert_eq!(open.adjacency().unwrap().right, [None; 6]);
        assert!((open.overlap(0, 1).unwrap().to_degrees() + 4.0).abs() < 1e-9);
    }

    #[test]
    fn a_rig_without_a_rear_view_is_a_chain_from_left_to_right() {
        let rig = rig(&[0.0, -50.0, 50.0, 100.0, -100.0], 60.0);
        let adjacency = rig.adjacency().unwrap();
        assert!(!adjacency.closed);
        assert_eq!(adjacency.right, [Some(1), Some(4), Some(0), Some(2), None]);
        assert_eq!(rig.rig_order().unwrap(), [3, 2, 0, 1, 4]);
    }

    #[test]
    fn two_cameras_are_neighbours_on_the_side_where_they_overlap() {
        let adjacency = rig(&[0.0, 50.0], 60.0).adjacency().unwrap();
        assert_eq!((adjacency.left, adjacency.right), (vec![Some(1), None], vec![None, Some(0)]));
        assert!(!adjacency.closed);
        let alone = rig(&[0.0], 60.0);
        assert_eq!(alone.adjacency().unwrap(), Adjacency { left: vec![None], right: vec![None], closed: false });
        assert_eq!(alone.rig_order().unwrap(), [0]);
    }

    #[test]
    fn rotating_there_and_back_restores_the_rig() {
        let original = rig(&[0.0, -60.0, 170.0], 70.0);
        let turned = original.rotated(0.5);
        assert!((turned.cameras[0].azimuth() - 0.5).abs() < 1e-12);
        assert!((turned.cameras[0].ego_from_cam.translation.y - 0.5_f64.sin()).abs() < 1e-12);
        let restored = turned.rotated(-0.5);
        for (a, b) in original.cameras.iter().zip(&restored.cameras) {
            let point = DVec3::new(3.0, -2.0, 40.0);
            assert!((a.ego_from_cam * point - b.ego_from_cam * point).length() < 1e-12);
        }
    }
}
