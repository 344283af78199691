//! Elementary functions that give the same bits on every machine, and the hash noise textures are made of.
//!
//! `f64::sin` and friends call the platform's C library, which differs between systems; worlds must not.

use std::f64::consts::{FRAC_PI_2, FRAC_PI_4, PI};

/// Sine and cosine, error below 1e-14 for the angles of a road network.
pub fn sin_cos(angle: f64) -> (f64, f64) {
    let quarter = (angle / FRAC_PI_2).round();
    let x = angle - quarter * FRAC_PI_2;
    let x2 = x * x;
    // Taylor series; |x| <= pi/4, so the first dropped term is below 1e-17.
    let sin = x
        * (1.0
            - x2 / 6.0
                * (1.0 - x2 / 20.0 * (1.0 - x2 / 42.0 * (1.0 - x2 / 72.0 * (1.0 - x2 / 110.0 * (1.0 - x2 / 156.0))))));
    let cos = 1.0
        - x2 / 2.0
            * (1.0
                - x2 / 12.0
                    * (1.0
                        - x2 / 30.0 * (1.0 - x2 / 56.0 * (1.0 - x2 / 90.0 * (1.0 - x2 / 132.0 * (1.0 - x2 / 182.0))))));
    match (quarter as i64).rem_euclid(4) {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Angle of the vector (x, y) in (-pi, pi], error below 1e-14.
pub fn atan2(y: f64, x: f64) -> f64 {
    if x == 0.0 && y == 0.0 {
        return 0.0;
    }
    let (ax, ay) = (x.abs(), y.abs());
    let swapped = ay > ax;
    let ratio = if swapped { ax / ay } else { ay / ax };
    // Reduction by pi/4 leaves |t| <= tan(pi/8), where the series below has converged.
    let reduced = ratio > 0.414_213_562_373_095_1;
    let t = if reduced { (ratio - 1.0) / (ratio + 1.0) } else { ratio };
    let t2 = t * t;
    let mut sum = 0.0;
    for n in (0..20).rev() {
        let term = 1.0 / f64::from(2 * n + 1);
        sum = sum * t2 + if n % 2 == 0 { term } else { -term };
    }
    let mut angle = t * sum + if reduced { FRAC_PI_4 } else { 0.0 };
    if swapped {
        angle = FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

/// Fast arc tangent for shading, error below 2e-6 rad (0.1 mm on a 60 m radius).
pub fn atan2_f32(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (low, high) = if ax < ay { (ax, ay) } else { (ay, ax) };
    let t = low / high.max(1e-20);
    let t2 = t * t;
    // Abramowitz & Stegun 4.4.49.
    let series = 1.0
        + t2 * (-0.333_331_45
            + t2 * (0.199_935_5
                + t2 * (-0.142_089
                    + t2 * (0.106_562_64
                        + t2 * (-0.075_289_64
                            + t2 * (0.042_909_614 + t2 * (-0.016_165_737 + t2 * 0.002_866_225_7)))))));
    let mut angle = t * series;
    if ay > ax {
        angle = std::f32::consts::FRAC_PI_2 - angle;
    }
    if x < 0.0 {
        angle = std::f32::consts::PI - angle;
    }
    if y < 0.0 { -angle } else { angle }
}

/// exp(-x) for x >= 0, within 1 %; only for fades.
pub fn fade_exp(x: f32) -> f32 {
    let y = 1.0 + x * (0.25 + x * (0.031_25 + x * 0.003));
    let y2 = y * y;
    1.0 / (y2 * y2)
}

/// Integer hash of two lattice coordinates and a salt.
pub fn hash2(x: i32, y: i32, salt: u32) -> u32 {
    let mut h =
        (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ salt.wrapping_mul(0xC2B2_AE3D);
    h ^= h >> 15;
    h = h.wrapping_mul(0x2C1B_3C6D);
    h ^= h >> 12;
    h = h.wrapping_mul(0x297A_2D39);
    h ^ (h >> 15)
}

/// A hash as a number in [0, 1).
pub fn unit(hash: u32) -> f32 {
    (hash >> 8) as f32 * (1.0 / 16_777_216.0)
}

/// Floor without the library call.
pub fn floor_i32(x: f32) -> i32 {
    let i = x as i32;
    if x < i as f32 { i - 1 } else { i }
}

/// Smooth value noise in [0, 1].
pub fn noise2(x: f32, y: f32, salt: u32) -> f32 {
    let (ix, iy) = (floor_i32(x), floor_i32(y));
    let (fx, fy) = (x - ix as f32, y - iy as f32);
    let (sx, sy) = (fx * fx * (3.0 - 2.0 * fx), fy * fy * (3.0 - 2.0 * fy));
    let corner = |dx: i32, dy: i32| unit(hash2(ix + dx, iy + dy, salt));
    let low = corner(0, 0) + (corner(1, 0) - corner(0, 0)) * sx;
    let high = corner(0, 1) + (corner(1, 1) - corner(0, 1)) * sx;
    low + (high - low) * sy
}

/// 0 below `low`, 1 above `high`, smooth between.
pub fn smoothstep(low: f32, high: f32, x: f32) -> f32 {
    let t = ((x - low) / (high - low)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn portable_functions_agree_with_the_library() {
        for i in -2000..2000 {
            let angle = f64::from(i) * 0.0137;
            let (sin, cos) = sin_cos(angle);
            assert!((sin - angle.sin()).abs() < 1e-13 && (cos - angle.cos()).abs() < 1e-13, "{angle}");
            let (y, x) = (f64::from(i % 61) * 0.3, f64::from(i % 47) * 0.2);
            assert!((atan2(y, x) - y.atan2(x)).abs() < 1e-13, "{y} {x}");
            assert!((f64::from(atan2_f32(y as f32, x as f32)) - y.atan2(x)).abs() < 3e-6, "{y} {x}");
        }
    }

    #[test]
    fn noise_is_continuous_and_bounded() {
        let mut last = noise2(-5.0, 0.3, 7);
        for i in 0..2000 {
            let value = noise2(-5.0 + i as f32 * 0.01, 0.3, 7);
            assert!((0.0..=1.0).contains(&value) && (value - last).abs() < 0.05);
            last = value;
        }
    }
}
