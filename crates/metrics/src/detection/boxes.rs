//! Boxes as the benchmark compares them.

use std::f64::consts::PI;

use super::DetectionClass;

/// A predicted box; positions in the world frame or any other frame that truth and prediction share, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct DetectionBox {
    /// Class.
    pub class: DetectionClass,
    /// Centre.
    pub center: [f64; 3],
    /// Width, length, height.
    pub size: [f64; 3],
    /// Turn, w x y z.
    pub rotation: [f64; 4],
    /// Over ground, m/s; NaN where undefined.
    pub velocity: [f64; 2],
    /// Name of the attribute; empty for none.
    pub attribute: String,
    /// Confidence; not read of true boxes.
    pub score: f64,
}

/// An annotated box.
#[derive(Debug, Clone, PartialEq)]
pub struct TrueBox {
    /// The box.
    pub found: DetectionBox,
    /// Lidar and radar points inside.
    pub points: u64,
}

impl DetectionBox {
    /// Between centres in the ground plane, metres.
    pub(crate) fn center_distance(&self, other: &Self) -> f64 {
        distance([self.center[0], self.center[1]], [other.center[0], other.center[1]])
    }

    /// Between velocities, m/s.
    pub(crate) fn velocity_error(&self, truth: &Self) -> f64 {
        distance(self.velocity, truth.velocity)
    }

    /// 1 - IoU of the two boxes laid on each other.
    pub(crate) fn scale_error(&self, truth: &Self) -> f64 {
        let volume = |size: [f64; 3]| size.iter().product::<f64>();
        let common: f64 = self.size.iter().zip(truth.size).map(|(a, b)| a.min(b)).product();
        1.0 - common / (volume(self.size) + volume(truth.size) - common)
    }

    /// Smallest difference of headings, radians.
    pub(crate) fn orientation_error(&self, truth: &Self, period: f64) -> f64 {
        let difference = (truth.yaw() - self.yaw() + period / 2.0).rem_euclid(period) - period / 2.0;
        (if difference > PI { difference - 2.0 * PI } else { difference }).abs()
    }

    /// 0 for the right attribute, 1 for a wrong one, NaN where the truth has none.
    pub(crate) fn attribute_error(&self, truth: &Self) -> f64 {
        match truth.attribute.as_str() {
            "" => f64::NAN,
            right => f64::from(u8::from(right != self.attribute)),
        }
    }

    /// Heading of the box's front in the ground plane, radians.
    fn yaw(&self) -> f64 {
        let [w, x, y, z] = normalised(self.rotation);
        (2.0 * (x * y + w * z)).atan2(1.0 - 2.0 * (y * y + z * z))
    }
}

/// A point in the axes of a box: the inverse of the turn `rotation` (w x y z) applied.
pub(crate) fn turned_back(rotation: [f64; 4], point: [f64; 3]) -> [f64; 3] {
    let [w, x, y, z] = normalised(rotation);
    let [a, b, c] = point;
    [
        (1.0 - 2.0 * (y * y + z * z)) * a + 2.0 * (x * y + w * z) * b + 2.0 * (x * z - w * y) * c,
        2.0 * (x * y - w * z) * a + (1.0 - 2.0 * (x * x + z * z)) * b + 2.0 * (y * z + w * x) * c,
        2.0 * (x * z + w * y) * a + 2.0 * (y * z - w * x) * b + (1.0 - 2.0 * (x * x + y * y)) * c,
    ]
}

fn normalised(q: [f64; 4]) -> [f64; 4] {
    let length = q.iter().map(|value| value * value).sum::<f64>().sqrt();
    q.map(|value| value / length)
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(yaw: f64) -> DetectionBox {
        DetectionBox {
            class: DetectionClass::Barrier,
            center: [0.0; 3],
            size: [2.0, 4.0, 1.0],
            rotation: [(yaw / 2.0).cos(), 0.0, 0.0, (yaw / 2.0).sin()],
            velocity: [f64::NAN; 2],
            attribute: String::new(),
            score: 0.0,
        }
    }

    #[test]
    fn headings_differ_modulo_the_period() {
        let error = |yaw, period| turned(yaw).orientation_error(&turned(0.1), period);
        assert!((error(0.1 + PI, 2.0 * PI) - PI).abs() < 1e-12);
        assert!(error(0.1 + PI, PI).abs() < 1e-12);
        assert!((error(-3.0, 2.0 * PI) - 3.1).abs() < 1e-12);
        assert!((error(3.3, 2.0 * PI) - (2.0 * PI - 3.2)).abs() < 1e-12);
    }

    #[test]
    fn sizes_and_frames() {
        let small = DetectionBox { size: [1.0, 4.0, 2.0], ..turned(0.0) };
        assert!((small.scale_error(&turned(0.0)) - (1.0 - 4.0 / 12.0)).abs() < 1e-12);
        let back = turned_back(turned(PI / 2.0).rotation, [0.0, 3.0, 1.0]);
        assert!((back[0] - 3.0).abs() < 1e-12 && back[1].abs() < 1e-12 && back[2] == 1.0);
        assert!(small.attribute_error(&small).is_nan() && small.velocity_error(&small).is_nan());
    }
}
