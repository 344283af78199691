//! Cameras for the tests.

use geometry::{Camera, Intrinsics, Lens, Rigid};
use glam::{DMat3, DQuat, DVec3};

/// A camera of 72 degrees with the given lens.
pub fn camera(width: u32, height: u32, lens: Lens) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    let intrinsics = Intrinsics { fx: 0.69 * w, fy: 0.69 * w, cx: 0.5 * w, cy: 0.52 * h, width, height };
    Camera::new(intrinsics, lens).expect("sound camera")
}

/// Mounting pose at a height of 1.5 m, looking to `azimuth` (radians, left positive).
pub fn ego_from_cam(azimuth: f64, x: f64, y: f64) -> Rigid {
    let axes = DMat3::from_cols(DVec3::NEG_Y, DVec3::NEG_Z, DVec3::X);
    Rigid::new(DQuat::from_rotation_z(azimuth) * DQuat::from_mat3(&axes), DVec3::new(x, y, 1.5))
}

/// Three lenses: none, five coefficients, fisheye.
pub fn lenses() -> [Lens; 3] {
    [
        Lens::Pinhole,
        Lens::BrownConrady { k: [-0.32, 0.11, -0.015], p: [0.0007, -0.0004] },
        Lens::KannalaBrandt { k: [0.03, -0.02, 0.008, -0.002] },
    ]
}
