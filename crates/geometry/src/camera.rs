//! Cameras: intrinsics and a lens, from camera-frame points to pixels and back.
//!
//! Pixels are continuous with centres at +0.5; files in OpenCV's convention (integer centres) get +0.5 on cx, cy in their reader.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::{GeometryError, Lens};

/// Focal lengths, principal point and picture size, in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Horizontal focal length, px. Negative after a horizontal flip of the picture.
    pub fx: f64,
    /// Vertical focal length, px.
    pub fy: f64,
    /// Principal point, px from the left edge of the left-most pixel.
    pub cx: f64,
    /// Principal point, px from the upper edge of the top pixel.
    pub cy: f64,
    /// Picture width, px.
    pub width: u32,
    /// Picture height, px.
    pub height: u32,
}

impl Intrinsics {
    /// Checks what every reader must check.
    ///
    /// # Errors
    /// Non-finite numbers, zero focal lengths, an empty picture.
    pub fn checked(self) -> Result<Self, GeometryError> {
        if [self.fx, self.fy, self.cx, self.cy].iter().any(|v| !v.is_finite()) {
            return Err(GeometryError::NotFinite { what: "camera matrix" });
        }
        for (what, value) in [("focal length fx", self.fx), ("focal length fy", self.fy)] {
            if value.abs() < 1e-9 {
                return Err(GeometryError::NotPositive { what, value });
            }
        }
        for (what, value) in [("picture width", self.width), ("picture height", self.height)] {
            if value == 0 {
                return Err(GeometryError::NotPositive { what, value: 0.0 });
            }
        }
        Ok(self)
    }

    /// The 3×3 camera matrix K.
    pub fn matrix(&self) -> DMat3 {
        DMat3::from_cols_array_2d(&[[self.fx, 0.0, 0.0], [0.0, self.fy, 0.0], [self.cx, self.cy, 1.0]])
    }

    /// Distorted normalised plane (Z = 1) to pixels.
    pub fn pixel_from_plane(&self, plane: DVec2) -> DVec2 {
        DVec2::new(self.fx * plane.x + self.cx, self.fy * plane.y + self.cy)
    }

    /// Pixels to the distorted normalised plane (Z = 1).
    pub fn plane_from_pixel(&self, pixel: DVec2) -> DVec2 {
        DVec2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy)
    }

    /// Whether a pixel position lies strictly inside the picture.
    pub fn contains(&self, pixel: DVec2) -> bool {
        pixel.x > 0.0 && pixel.y > 0.0 && pixel.x < f64::from(self.width) && pixel.y < f64::from(self.height)
    }

    /// Horizontal angle of view of the pinhole, radians.
    pub fn horizontal_fov(&self) -> f64 {
        let fx = self.fx.abs();
        (self.cx / fx).atan() + ((f64::from(self.width) - self.cx) / fx).atan()
    }
}

/// Intrinsics with their lens and the limit up to which the lens formula is one-to-one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Camera {
    /// Focal lengths, principal point, size.
    pub intrinsics: Intrinsics,
    /// Distortion.
    pub lens: Lens,
    /// Greatest [`Lens::reach`] that may be projected.
    max_reach: f64,
}

impl Camera {
    /// Finds the limit beyond which far-off points would fold back into the picture, so that [`Camera::project`] can refuse them.
    ///
    /// # Errors
    /// Whatever [`Intrinsics::checked`] refuses, and non-finite coefficients.
    pub fn new(intrinsics: Intrinsics, lens: Lens) -> Result<Self, GeometryError> {
        let intrinsics = intrinsics.checked()?;
        if !lens.is_finite() {
            return Err(GeometryError::NotFinite { what: "lens coefficients" });
        }
        let (w, h) = (f64::from(intrinsics.width), f64::from(intrinsics.height));
        let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)];
        let max_reach = lens.limit(corners.map(|(u, v)| intrinsics.plane_from_pixel(DVec2::new(u, v))));
        Ok(Self { intrinsics, lens, max_reach })
    }

    /// Camera-frame point (metres) to a pixel; `None` behind the camera or beyond the lens's valid range.
    /// The pixel may lie outside the picture: ask [`Intrinsics::contains`].
    pub fn project(&self, point: DVec3) -> Option<DVec2> {
        if self.lens.reach(point) > self.max_reach {
            return None;
        }
        self.lens.distort(point).map(|plane| self.intrinsics.pixel_from_plane(plane))
    }

    /// Pixel to the unit direction of its ray in the camera frame; `None` where no direction maps to that pixel.
    pub fn unproject(&self, pixel: DVec2) -> Option<DVec3> {
        self.lens.undistort(self.intrinsics.plane_from_pixel(pixel), self.max_reach)
    }

    /// Greatest angle from the optical axis that the camera can see, radians.
    pub(crate) fn max_angle(&self) -> f64 {
        self.lens.angle(self.max_reach)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTRINSICS: Intrinsics =
        Intrinsics { fx: 1545.0, fy: 1540.0, cx: 960.5, cy: 560.5, width: 1920, height: 1080 };
    const NUPLAN: Lens = Lens::BrownConrady { k: [-0.356123, 0.172545, -0.05231], p: [-0.00213, 0.000464] };

    fn camera(lens: Lens) -> Camera {
        Camera::new(INTRINSICS, lens).unwrap()
    }

    fn fisheye() -> Camera {
        let lens = Lens::KannalaBrandt { k: [-0.012, 0.0021, -0.0007, 0.0001] };
        Camera::new(Intrinsics { fx: 958.0, fy: 959.0, ..INTRINSICS }, lens).unwrap()
    }

    #[test]
    fn pinhole_follows_the_formula_by_hand() {
        let pixel = camera(Lens::Pinhole).project(DVec3::new(2.0, -1.0, 4.0)).unwrap();
        assert_eq!(pixel, DVec2::new(960.5 + 1545.0 * 0.5, 560.5 - 1540.0 * 0.25));
    }

    #[test]
    fn unproject_inverts_project_over_the_whole_picture_for_every_lens() {
        for camera in [camera(Lens::Pinhole), camera(NUPLAN), fisheye()] {
            let i = camera.intrinsics;
            for row in 0..=12 {
                for column in 0..=16 {
                    let (u, v) = (f64::from(column) / 16.0, f64::from(row) / 12.0);
                    let pixel = DVec2::new(u * f64::from(i.width), v * f64::from(i.height));
                    let ray = camera.unproject(pixel).unwrap();
                    assert!((ray.length() - 1.0).abs() < 1e-14);
                    let back = camera.project(ray * 37.0).unwrap();
                    assert!((back - pixel).length() < 1e-9, "{:?} {pixel} {back}", camera.lens);
                }
            }
        }
    }

    #[test]
    fn a_mirrored_picture_round_trips() {
        let mirrored = Intrinsics { fx: -1545.0, cx: 1920.0 - 960.5, ..INTRINSICS };
        let (plain, mirrored) = (camera(NUPLAN), Camera::new(mirrored, NUPLAN).unwrap());
        let point = DVec3::new(1.0, 0.5, 4.0);
        let (a, b) = (plain.project(point).unwrap(), mirrored.project(point).unwrap());
        assert!((a.x + b.x - 1920.0).abs() < 1e-9 && a.y == b.y);
        assert!((mirrored.unproject(b).unwrap() - point.normalize()).length() < 1e-12);
    }

    #[test]
    fn nothing_behind_the_camera_projects() {
        for camera in [camera(Lens::Pinhole), camera(NUPLAN), fisheye()] {
            for x in [-50.0, -1.0, 0.0, 1.0, 50.0] {
                assert_eq!(camera.project(DVec3::new(x, 0.3, -2.0)), None);
            }
        }
        assert_eq!(camera(Lens::Pinhole).project(DVec3::new(1.0, 1.0, 0.0)), None);
    }

    #[test]
    fn far_off_points_do_not_fold_back_into_the_picture() {
        let camera = camera(NUPLAN);
        // 60 degrees to the side: the bare formula puts it inside the picture.
        let point = DVec3::new(1.75, 0.0, 1.0);
        let folded = INTRINSICS.pixel_from_plane(NUPLAN.distort(point).unwrap());
        assert!(INTRINSICS.contains(folded), "{folded} should show the trap");
        assert_eq!(camera.project(point), None);
        // Everything that does project keeps moving outwards.
        let mut last = 0.0;
        for step in 0..1000 {
            if let Some(pixel) = camera.project(DVec3::new(f64::from(step) * 2e-3, 0.0, 1.0)) {
                assert!(pixel.x > last);
                last = pixel.x;
            }
        }
        assert!(last > 1920.0);
    }

    #[test]
    fn a_polynomial_is_not_trusted_beyond_the_picture_it_was_fitted_to() {
        // This one folds back only at 69 degrees, but its picture ends at 37.
        let camera = camera(Lens::BrownConrady { k: [-0.05, 0.0, 0.0], p: [0.0; 2] });
        let corner = camera.unproject(DVec2::new(0.0, 0.0)).unwrap();
        assert!(camera.project(corner).is_some());
        let beyond = DVec3::new(1.05 * corner.x, 1.05 * corner.y, corner.z);
        assert_eq!(camera.project(beyond), None);
    }

    #[test]
    fn a_fisheye_that_sees_behind_itself_projects_there() {
        // f · θ_d reaches 110 degrees at the left and right borders.
        let wide = Intrinsics { fx: 960.0 / 110.0_f64.to_radians(), fy: 500.0, cx: 960.0, ..INTRINSICS };
        let camera = Camera::new(wide, Lens::KannalaBrandt { k: [0.0; 4] }).unwrap();
        let angle = 100.0_f64.to_radians();
        let pixel = camera.project(DVec3::new(angle.sin(), 0.0, angle.cos())).unwrap();
        assert!((pixel.x - (960.0 + 960.0 * 100.0 / 110.0)).abs() < 1e-9);
        assert_eq!(camera.project(DVec3::new(0.0, 0.0, -1.0)), None);
    }

    #[test]
    fn unusable_numbers_are_refused() {
        let bad = [
            Intrinsics { fx: f64::NAN, ..INTRINSICS },
            Intrinsics { cy: f64::INFINITY, ..INTRINSICS },
            Intrinsics { fy: 0.0, ..INTRINSICS },
            Intrinsics { width: 0, ..INTRINSICS },
        ];
        for intrinsics in bad {
            assert!(Camera::new(intrinsics, Lens::Pinhole).is_err(), "{intrinsics:?}");
        }
        let lens = Lens::KannalaBrandt { k: [0.0, f64::NAN, 0.0, 0.0] };
        assert_eq!(
            Camera::new(INTRINSICS, lens),
            Err(GeometryError::NotFinite { what: "lens coefficients" }),
            "coefficients"
        );
    }
}
