//! Which boxes count: near enough, seen by a sensor, not parked in a rack.

use super::boxes::turned_back;
use super::{DetectionBox, DetectionClass};

/// A bicycle rack of a sample, in the frame of the boxes.
#[derive(Debug, Clone, PartialEq)]
pub struct Rack {
    /// Centre, metres.
    pub center: [f64; 3],
    /// Width, length, height, metres.
    pub size: [f64; 3],
    /// Turn, w x y z.
    pub rotation: [f64; 4],
}

impl Rack {
    fn holds(&self, point: [f64; 3]) -> bool {
        let relative = [0, 1, 2].map(|axis| point[axis] - self.center[axis]);
        let [width, length, height] = self.size;
        let inside = |(value, side): (f64, f64)| value.abs() <= side / 2.0;
        turned_back(self.rotation, relative).into_iter().zip([length, width, height]).all(inside)
    }
}

/// Whether a box is evaluated.
///
/// `ego` is the car's position in the frame of the boxes, `points` the lidar and radar points in a true box, `None` for predictions.
#[must_use]
pub fn keep_evaluated(found: &DetectionBox, ego: [f64; 3], points: Option<u64>, racks: &[Rack]) -> bool {
    let away = ((found.center[0] - ego[0]).powi(2) + (found.center[1] - ego[1]).powi(2)).sqrt();
    let may_be_parked = matches!(found.class, DetectionClass::Bicycle | DetectionClass::Motorcycle);
    away < found.class.range_m()
        && points != Some(0)
        && !(may_be_parked && racks.iter().any(|rack| rack.holds(found.center)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn range_points_and_racks() {
        let bicycle = |x: f64, y: f64| DetectionBox {
            class: DetectionClass::Bicycle,
            center: [x, y, 0.5],
            size: [0.6, 1.8, 1.2],
            rotation: [1.0, 0.0, 0.0, 0.0],
            velocity: [0.0; 2],
            attribute: String::new(),
            score: 0.5,
        };
        let half = std::f64::consts::FRAC_1_SQRT_2;
        // Turned by 90°: four metres along y.
        let racks = [Rack { center: [10.0, 0.0, 0.5], size: [1.0, 4.0, 1.0], rotation: [half, 0.0, 0.0, half] }];
        let keep = |x, y, points| keep_evaluated(&bicycle(x, y), [0.0; 3], points, &racks);
        assert!(!keep(10.0, 1.9, None) && !keep(10.4, -1.9, Some(5)) && keep(11.0, 0.0, None));
        assert!(!keep(40.0, 0.0, None) && keep(39.9, 0.0, None));
        assert!(!keep(5.0, 0.0, Some(0)) && keep(5.0, 0.0, Some(1)));
        let car = DetectionBox { class: DetectionClass::Car, ..bicycle(10.0, 0.0) };
        assert!(keep_evaluated(&car, [0.0; 3], None, &racks));
    }
}
