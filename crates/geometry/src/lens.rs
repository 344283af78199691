//! Lens models: directions of the camera frame to points of the normalised picture plane, and back.
//!
//! Each polynomial is one-to-one only up to some reach; beyond it far-off points fold back into the picture. Reach is measured
//! as the undistorted radius (Brown–Conrady) or as the angle from the optical axis (Kannala–Brandt).

use std::f64::consts::{FRAC_PI_2, PI};

use glam::{DMat2, DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// How directions become points of the normalised picture plane.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum Lens {
    /// No distortion.
    #[default]
    Pinhole,
    /// OpenCV's `(k1, k2, p1, p2, k3)`.
    #[doc(alias = "OPENCV")]
    BrownConrady {
        /// Radial coefficients of r², r⁴, r⁶.
        k: [f64; 3],
        /// Tangential coefficients.
        p: [f64; 2],
    },
    /// OpenCV's and COLMAP's fisheye: θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸).
    #[doc(alias = "OPENCV_FISHEYE")]
    KannalaBrandt {
        /// Coefficients of θ², θ⁴, θ⁶, θ⁸.
        k: [f64; 4],
    },
}

impl Lens {
    /// Camera-frame point to the distorted normalised plane: the bare formula, also where it folds back.
    /// `None` where the formula has no value (a pinhole or Brown–Conrady point at or behind the camera plane).
    pub fn distort(&self, point: DVec3) -> Option<DVec2> {
        match self {
            Self::Pinhole => (point.z > 0.0).then(|| point.truncate() / point.z),
            Self::BrownConrady { k, p } => (point.z > 0.0).then(|| brown_conrady(point.truncate() / point.z, *k, *p)),
            Self::KannalaBrandt { k } => {
                let radius = point.truncate().length();
                if radius < 1e-12 {
                    return (point.z > 0.0).then_some(DVec2::ZERO);
                }
                let theta = radius.atan2(point.z);
                Some(point.truncate() * (fisheye(theta, *k).0 / radius))
            }
        }
    }

    /// Unit ray of a point of the distorted plane; `None` if no ray of at most this reach maps there.
    pub(crate) fn undistort(&self, distorted: DVec2, max_reach: f64) -> Option<DVec3> {
        // A pixel on the very limit must not fail by rounding.
        let allowed = max_reach * (1.0 + 1e-9);
        match self {
            Self::Pinhole => Some(distorted.extend(1.0).normalize()),
            Self::BrownConrady { k, p } => {
                let plane = invert_brown_conrady(distorted, *k, *p, allowed)?;
                (plane.length() <= allowed).then(|| plane.extend(1.0).normalize())
            }
            Self::KannalaBrandt { k } => {
                let radius = distorted.length();
                if radius > fisheye(allowed, *k).0 {
                    return None;
                }
                let theta = invert_increasing(|t| fisheye(t, *k), radius, allowed);
                let axis = distorted.try_normalize().unwrap_or(DVec2::ZERO);
                Some((axis * theta.sin()).extend(theta.cos()))
            }
        }
    }

    /// How far out a point lies: what [`Lens::limit`] bounds.
    pub(crate) fn reach(&self, point: DVec3) -> f64 {
        let radius = point.truncate().length();
        match self {
            Self::Pinhole => 0.0,
            Self::BrownConrady { .. } if point.z > 0.0 => radius / point.z,
            Self::BrownConrady { .. } => f64::INFINITY,
            Self::KannalaBrandt { .. } => radius.atan2(point.z),
        }
    }

    /// Greatest reach that may be projected, given the picture's corners on the distorted plane.
    ///
    /// Brown–Conrady polynomials are fitted inside the picture and mean nothing beyond its corners; a fisheye stays sound in
    /// front of the camera, and behind it only as far as the picture itself sees.
    pub(crate) fn limit(&self, corners: [DVec2; 4]) -> f64 {
        let one_to_one = self.one_to_one_reach();
        let mut needed = 0.0_f64;
        for corner in corners {
            match self.undistort(corner, one_to_one) {
                Some(ray) => needed = needed.max(self.reach(ray)),
                None => return one_to_one,
            }
        }
        // 1 % beyond the corner, so that points on the border itself and half-pixel shifts project.
        let needed = 1.01 * needed;
        match self {
            Self::Pinhole => f64::INFINITY,
            Self::BrownConrady { .. } => needed.min(one_to_one),
            Self::KannalaBrandt { .. } => needed.max(FRAC_PI_2).min(one_to_one),
        }
    }

    /// Reach in front of which the radial polynomial grows.
    fn one_to_one_reach(&self) -> f64 {
        match self {
            Self::Pinhole => f64::INFINITY,
            Self::BrownConrady { k, .. } => growing_range(|r| brown_conrady_radius(r, *k), BROWN_CONRADY_MAX_RADIUS),
            Self::KannalaBrandt { k } => growing_range(|t| fisheye(t, *k), PI),
        }
    }

    /// Angle from the optical axis that belongs to a reach, radians.
    pub(crate) fn angle(&self, reach: f64) -> f64 {
        match self {
            Self::Pinhole | Self::BrownConrady { .. } => reach.atan(),
            Self::KannalaBrandt { .. } => reach,
        }
    }

    /// Whether all coefficients are finite numbers.
    pub(crate) fn is_finite(&self) -> bool {
        match self {
            Self::Pinhole => true,
            Self::BrownConrady { k, p } => k.iter().chain(p).all(|v| v.is_finite()),
            Self::KannalaBrandt { k } => k.iter().all(|v| v.is_finite()),
        }
    }
}

/// 84° from the axis: no lens described by a polynomial in tan θ reaches further.
const BROWN_CONRADY_MAX_RADIUS: f64 = 10.0;

fn brown_conrady(n: DVec2, [k1, k2, k3]: [f64; 3], [p1, p2]: [f64; 2]) -> DVec2 {
    let r2 = n.length_squared();
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    DVec2::new(
        n.x * radial + 2.0 * p1 * n.x * n.y + p2 * (r2 + 2.0 * n.x * n.x),
        n.y * radial + p1 * (r2 + 2.0 * n.y * n.y) + 2.0 * p2 * n.x * n.y,
    )
}

/// Distorted radius and its slope, tangential terms left out.
fn brown_conrady_radius(r: f64, [k1, k2, k3]: [f64; 3]) -> (f64, f64) {
    let r2 = r * r;
    let value = r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)));
    let slope = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3));
    (value, slope)
}

/// Distorted angle θ_d and its slope.
fn fisheye(theta: f64, [k1, k2, k3, k4]: [f64; 4]) -> (f64, f64) {
    let t2 = theta * theta;
    let value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
    let slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
    (value, slope)
}

/// Newton on the 2×2 system, started at the solution without tangential terms, which lies close by.
fn invert_brown_conrady(target: DVec2, k: [f64; 3], p: [f64; 2], max_radius: f64) -> Option<DVec2> {
    let radius = invert_increasing(|r| brown_conrady_radius(r, k), target.length(), max_radius);
    let mut n = target.try_normalize().unwrap_or(DVec2::ZERO) * radius;
    let mut residual = brown_conrady(n, k, p) - target;
    for _ in 0..20 {
        if residual.length() < 1e-14 {
            break;
        }
        let jacobian = brown_conrady_jacobian(n, k, p);
        if jacobian.determinant().abs() < 1e-12 {
            return None;
        }
        n -= jacobian.inverse() * residual;
        residual = brown_conrady(n, k, p) - target;
    }
    // Also false for NaN, where Newton ran away.
    (residual.length() < 1e-12).then_some(n)
}

fn brown_conrady_jacobian(n: DVec2, [k1, k2, k3]: [f64; 3], [p1, p2]: [f64; 2]) -> DMat2 {
    let r2 = n.length_squared();
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    // Twice the derivative of `radial` by r².
    let slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3));
    let cross = n.x * n.y * slope + 2.0 * (p1 * n.x + p2 * n.y);
    let dx = radial + n.x * n.x * slope + 2.0 * p1 * n.y + 6.0 * p2 * n.x;
    let dy = radial + n.y * n.y * slope + 6.0 * p1 * n.y + 2.0 * p2 * n.x;
    DMat2::from_cols_array_2d(&[[dx, cross], [cross, dy]])
}

/// Where an increasing function (value, slope) takes a value on `0..=high`: Newton, kept inside a shrinking bracket.
fn invert_increasing(f: impl Fn(f64) -> (f64, f64), target: f64, high: f64) -> f64 {
    let (mut low, mut high) = (0.0, high);
    let mut x = target.min(high);
    for _ in 0..100 {
        let (value, slope) = f(x);
        if value < target {
            low = x
        } else {
            high = x
        }
        let newton = x - (value - target) / slope;
        let next = if newton >= low && newton <= high { newton } else { 0.5 * (low + high) };
        let step = next - x;
        x = next;
        if step.abs() < 1e-15 {
            break;
        }
    }
    x
}

/// How far from zero a function (value, slope) keeps growing, at most `end`.
fn growing_range(f: impl Fn(f64) -> (f64, f64), end: f64) -> f64 {
    const STEP: f64 = 1e-3;
    let mut x = 0.0;
    while x + STEP < end && f(x + STEP).1 > 0.0 {
        x += STEP;
    }
    if x + STEP < end { x } else { end }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NUPLAN: Lens = Lens::BrownConrady { k: [-0.356123, 0.172545, -0.05231], p: [-0.00213, 0.000464] };
    const FISHEYE: Lens = Lens::KannalaBrandt { k: [-0.012, 0.0021, -0.0007, 0.0001] };

    #[test]
    fn zero_coefficients_are_a_pinhole_and_an_equidistant_fisheye() {
        let point = DVec3::new(3.0, -4.0, 5.0);
        let straight = Lens::BrownConrady { k: [0.0; 3], p: [0.0; 2] };
        assert_eq!(straight.distort(point), Lens::Pinhole.distort(point));
        let angle = Lens::KannalaBrandt { k: [0.0; 4] }.distort(point).unwrap();
        // tan θ = 5 / 5, so θ = 45°, along (0.6, -0.8).
        assert!((angle - DVec2::new(0.6, -0.8) * std::f64::consts::FRAC_PI_4).length() < 1e-15);
    }

    #[test]
    fn brown_conrady_follows_the_formula_by_hand() {
        let lens = Lens::BrownConrady { k: [0.1, 0.01, 0.001], p: [0.02, 0.03] };
        // x = 1, y = 2: r² = 5, radial = 1 + 0.5 + 0.25 + 0.125.
        let d = lens.distort(DVec3::new(2.0, 4.0, 2.0)).unwrap();
        let expected = DVec2::new(1.875 + 0.04 * 2.0 + 0.03 * 7.0, 3.75 + 0.02 * 13.0 + 0.06 * 2.0);
        assert!((d - expected).length() < 1e-14);
    }

    #[test]
    fn jacobian_agrees_with_finite_differences() {
        let (k, p, step) = ([-0.3, 0.2, -0.05], [0.02, -0.03], 1e-6);
        for n in [DVec2::new(0.4, 0.3), DVec2::new(-0.6, 0.1), DVec2::new(0.0, -0.5)] {
            let numeric = [DVec2::X, DVec2::Y].map(|axis| {
                (brown_conrady(n + axis * step, k, p) - brown_conrady(n - axis * step, k, p)) / (2.0 * step)
            });
            let analytic = brown_conrady_jacobian(n, k, p);
            assert!((analytic.x_axis - numeric[0]).length() < 1e-9);
            assert!((analytic.y_axis - numeric[1]).length() < 1e-9);
        }
    }

    #[test]
    fn radial_slopes_agree_with_finite_differences() {
        let step = 1e-6;
        for x in [0.1, 0.7, 1.3] {
            let brown = |r: f64| brown_conrady_radius(r, [-0.3, 0.2, -0.05]);
            assert!(((brown(x + step).0 - brown(x - step).0) / (2.0 * step) - brown(x).1).abs() < 1e-8);
            let angle = |t: f64| fisheye(t, [-0.1, 0.05, -0.02, 0.01]);
            assert!(((angle(x + step).0 - angle(x - step).0) / (2.0 * step) - angle(x).1).abs() < 1e-8);
        }
    }

    #[test]
    fn undistort_inverts_distort_up_to_the_fold() {
        for lens in [NUPLAN, FISHEYE] {
            let end = lens.one_to_one_reach();
            for step in 1..50 {
                // The last hundredth before the fold is ill-conditioned: the slope goes to zero there.
                let angle = lens.angle(0.98 * end * f64::from(step) / 50.0);
                for turn in 0..8 {
                    let (s, c) = (f64::from(turn) * std::f64::consts::FRAC_PI_4).sin_cos();
                    let ray = DVec3::new(c * angle.sin(), s * angle.sin(), angle.cos());
                    let back = lens.undistort(lens.distort(ray).unwrap(), end).unwrap();
                    assert!((back - ray).length() < 1e-12, "{lens:?} at {angle} rad, turn {turn}");
                }
            }
        }
    }

    #[test]
    fn a_value_beyond_the_fold_has_no_ray() {
        let end = NUPLAN.one_to_one_reach();
        assert!(end > 0.9 && end < 2.0, "the nuPlan polynomial folds back at {end}");
        assert_eq!(NUPLAN.undistort(DVec2::new(0.0, 5.0), end), None);
        let folding = Lens::KannalaBrandt { k: [-0.2, 0.0, 0.0, 0.0] };
        // Slope 1 - 0.6 θ² vanishes at 1.291.
        let end = folding.one_to_one_reach();
        assert!((end - (1.0_f64 / 0.6).sqrt()).abs() < 2e-3);
        assert_eq!(folding.undistort(DVec2::new(1.0, 0.0), end), None);
        assert!(folding.undistort(DVec2::new(0.8, 0.0), end).is_some());
    }
}
