//! Boxes with any rotation.

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use crate::{Box3d, Rigid};

/// A box that may be tilted, usually in the ego frame. [`Box3d`] is its upright form.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct OrientedBox {
    /// Geometric centre, metres.
    pub center: DVec3,
    /// Length (along its own x), width (y), height (z), metres.
    pub size: DVec3,
    /// From the box's own axes, unit.
    pub rotation: DQuat,
}

impl OrientedBox {
    /// From the box's own frame, whose origin is its centre.
    pub fn dst_from_box(&self) -> Rigid {
        Rigid { rotation: self.rotation, translation: self.center }
    }

    /// The eight corners in the order of [`Box3d::corners`].
    pub fn corners(&self) -> [DVec3; 8] {
        const SIGNS: [[f64; 3]; 8] = [
            [1.0, 1.0, 1.0],
            [1.0, -1.0, 1.0],
            [1.0, -1.0, -1.0],
            [1.0, 1.0, -1.0],
            [-1.0, 1.0, 1.0],
            [-1.0, -1.0, 1.0],
            [-1.0, -1.0, -1.0],
            [-1.0, 1.0, -1.0],
        ];
        let dst_from_box = self.dst_from_box();
        SIGNS.map(|s| dst_from_box * (DVec3::from_array(s) * self.size * 0.5))
    }

    /// Whether a point lies inside, not on a face.
    pub fn holds(&self, point: DVec3) -> bool {
        let local = self.rotation.inverse() * (point - self.center);
        local.abs().cmplt(self.size * 0.5).all()
    }

    /// The box without its tilt: only the yaw of its own x axis stays.
    pub fn upright(&self) -> Box3d {
        Box3d { center: self.center, size: self.size, yaw: self.dst_from_box().yaw() }
    }
}

impl From<Box3d> for OrientedBox {
    fn from(upright: Box3d) -> Self {
        Self { center: upright.center, size: upright.size, rotation: DQuat::from_rotation_z(upright.yaw) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_upright_box_comes_back() {
        let car = Box3d { center: DVec3::new(10.0, 2.0, 1.0), size: DVec3::new(4.0, 2.0, 1.5), yaw: 0.4 };
        let back = OrientedBox::from(car).upright();
        assert_eq!((back.center, back.size), (car.center, car.size));
        assert!((back.yaw - car.yaw).abs() < 1e-15);
        assert_eq!(OrientedBox::from(car).corners(), car.corners());
    }

    #[test]
    fn faces_do_not_belong_to_the_inside() {
        let turned = OrientedBox {
            center: DVec3::ZERO,
            size: DVec3::new(4.0, 2.0, 1.0),
            rotation: DQuat::from_rotation_y(std::f64::consts::FRAC_PI_2),
        };
        assert!(turned.holds(DVec3::new(0.0, 0.0, 1.9)) && !turned.holds(DVec3::new(1.9, 0.0, 0.0)));
        let level = OrientedBox { rotation: DQuat::IDENTITY, ..turned };
        assert!(!level.holds(DVec3::new(2.0, 0.0, 0.0)) && level.holds(DVec3::new(1.999, 0.0, 0.0)));
        assert!(!level.holds(DVec3::NAN));
    }
}
