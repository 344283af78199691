//! Oriented boxes.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::{OrientedBox, Rigid, wrap_angle};

/// An upright oriented box, usually in the ego frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Box3d {
    /// Geometric centre, metres.
    pub center: DVec3,
    /// Length (along its heading), width, height, metres.
    pub size: DVec3,
    /// Heading about +z from +x, radians in (-pi, pi].
    pub yaw: f64,
}

impl Box3d {
    /// The eight corners in nuScenes `Box.corners` order: signs of (l/2, w/2, h/2)
    /// (+,+,+) (+,-,+) (+,-,-) (+,+,-) (-,+,+) (-,-,+) (-,-,-) (-,+,-).
    pub fn corners(&self) -> [DVec3; 8] {
        OrientedBox::from(*self).corners()
    }

    /// The same box in another frame; the tilt of `dst_from_src` turns the centre, only its yaw turns the heading.
    #[must_use]
    pub fn transformed(&self, dst_from_src: &Rigid) -> Self {
        let heading = dst_from_src.transform_vector(DVec3::new(self.yaw.cos(), self.yaw.sin(), 0.0));
        Self { center: *dst_from_src * self.center, size: self.size, yaw: wrap_angle(heading.y.atan2(heading.x)) }
    }

    /// Whether a point lies inside or on the box.
    pub fn contains(&self, point: DVec3) -> bool {
        let local = Rigid::from_yaw(self.yaw, self.center).inverse() * point;
        local.abs().cmple(self.size * 0.5).all()
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use glam::DQuat;

    use super::*;

    const CAR: Box3d = Box3d { center: DVec3::new(10.0, 2.0, 1.0), size: DVec3::new(4.0, 2.0, 1.5), yaw: 0.0 };

    #[test]
    fn corners_come_in_the_devkit_order() {
        let corners = CAR.corners();
        assert_eq!(corners[0], DVec3::new(12.0, 3.0, 1.75));
        assert_eq!(corners[1], DVec3::new(12.0, 1.0, 1.75));
        assert_eq!(corners[2], DVec3::new(12.0, 1.0, 0.25));
        assert_eq!(corners[3], DVec3::new(12.0, 3.0, 0.25));
        for i in 0..4 {
            assert_eq!(corners[i + 4], corners[i] - DVec3::new(4.0, 0.0, 0.0), "the rear follows the front");
        }
        let turned = Box3d { yaw: FRAC_PI_2, ..CAR }.corners();
        assert!((turned[0] - DVec3::new(9.0, 4.0, 1.75)).length() < 1e-12, "front left of a car that heads left");
    }

    #[test]
    fn transforming_keeps_the_size_and_wraps_the_heading() {
        let dst_from_src = Rigid::from_yaw(0.5, DVec3::new(1.0, 0.0, 0.0));
        let moved = Box3d { yaw: 3.0, ..CAR }.transformed(&dst_from_src);
        assert!((moved.yaw - (3.5 - 2.0 * PI)).abs() < 1e-12);
        assert_eq!(moved.size, CAR.size);
        for (corner, src) in moved.corners().iter().zip(Box3d { yaw: 3.0, ..CAR }.corners()) {
            assert!((*corner - dst_from_src * src).length() < 1e-12);
        }
        let back = moved.transformed(&dst_from_src.inverse());
        assert!((back.center - CAR.center).length() < 1e-12 && (back.yaw - 3.0).abs() < 1e-12);
    }

    #[test]
    fn a_tilted_frame_turns_the_heading_by_its_yaw_only() {
        let tilted = Rigid::new(DQuat::from_rotation_z(0.3) * DQuat::from_rotation_y(0.05), DVec3::ZERO);
        assert!((CAR.transformed(&tilted).yaw - 0.3).abs() < 1e-12);
    }

    #[test]
    fn contains_follows_the_heading() {
        let turned = Box3d { yaw: FRAC_PI_2, ..CAR };
        assert!(turned.contains(DVec3::new(10.9, 3.9, 1.7)));
        assert!(!turned.contains(DVec3::new(11.9, 2.0, 1.0)));
        assert!(CAR.contains(DVec3::new(11.9, 2.0, 1.0)) && !CAR.contains(DVec3::new(10.0, 2.0, 1.8)));
        assert!(CAR.contains(CAR.center) && turned.contains(CAR.center));
    }
}
