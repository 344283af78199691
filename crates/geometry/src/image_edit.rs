//! Affine edits of a picture that calibration has to follow: resize, crop, horizontal flip.

use glam::{DMat3, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use crate::Intrinsics;

/// Maps raw pixels to network pixels (`img_from_raw`, last row 0 0 1) together with the size that results.
///
/// Edits are applied left to right: `ImageEdit::identity(w, h).resize(..).crop(..).flip()`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ImageEdit {
    /// `p_img = img_from_raw * p_raw` in homogeneous continuous pixels (centres at +0.5).
    pub img_from_raw: DMat3,
    /// Width after the edits, px.
    pub width: u32,
    /// Height after the edits, px.
    pub height: u32,
}

impl ImageEdit {
    /// No edit of a picture of this size.
    pub fn identity(width: u32, height: u32) -> Self {
        Self { img_from_raw: DMat3::IDENTITY, width, height }
    }

    /// Stretches to the new size, aspect ratio not kept.
    #[must_use]
    pub fn resize(self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { img_from_raw: DMat3::from_diagonal(DVec3::new(sx, sy, 1.0)) * self.img_from_raw, width, height }
    }

    /// Keeps the window of the given size whose upper-left corner is (x, y); the window may reach outside.
    #[must_use]
    pub fn crop(self, x: i64, y: i64, width: u32, height: u32) -> Self {
        let shift = DMat3::from_translation(DVec2::new(-(x as f64), -(y as f64)));
        Self { img_from_raw: shift * self.img_from_raw, width, height }
    }

    /// Mirrors left and right: u → w − u.
    #[must_use]
    pub fn flip(self) -> Self {
        let w = f64::from(self.width);
        let mirror = DMat3::from_cols_array_2d(&[[-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [w, 0.0, 1.0]]);
        Self { img_from_raw: mirror * self.img_from_raw, ..self }
    }

    /// Raw pixel to network pixel.
    pub fn apply(&self, raw_px: DVec2) -> DVec2 {
        (self.img_from_raw * raw_px.extend(1.0)).truncate()
    }

    /// Network pixel to raw pixel.
    pub fn invert(&self, img_px: DVec2) -> DVec2 {
        (self.img_from_raw.inverse() * img_px.extend(1.0)).truncate()
    }

    /// The intrinsics of the edited picture; only scale, shift and mirror occur, so they stay intrinsics.
    pub fn intrinsics(&self, raw: &Intrinsics) -> Intrinsics {
        let k = self.img_from_raw * raw.matrix();
        Intrinsics {
            fx: k.x_axis.x,
            fy: k.y_axis.y,
            cx: k.z_axis.x,
            cy: k.z_axis.y,
            width: self.width,
            height: self.height,
        }
    }

    /// Row-major numbers, the layout tensors use.
    pub fn to_rows(&self) -> [[f64; 3]; 3] {
        self.img_from_raw.transpose().to_cols_array_2d()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Camera, Lens};

    const LANDSCAPE: Intrinsics = Intrinsics { fx: 1266.4, fy: 1260.1, cx: 816.8, cy: 492.0, width: 1600, height: 900 };
    const PORTRAIT: Intrinsics =
        Intrinsics { fx: 1776.0415, fy: 1776.0415, cx: 778.4906, cy: 1014.0243, width: 1550, height: 2048 };

    #[test]
    fn resizing_then_projecting_equals_projecting_then_scaling() {
        let edit = ImageEdit::identity(1600, 900).resize(400, 225);
        let point = DVec3::new(3.3, -1.2, 12.0);
        let raw = Camera::new(LANDSCAPE, Lens::Pinhole).unwrap().project(point).unwrap();
        let network = Camera::new(edit.intrinsics(&LANDSCAPE), Lens::Pinhole).unwrap().project(point).unwrap();
        assert!((network - raw / 4.0).length() < 1e-9);
        assert!((network - edit.apply(raw)).length() < 1e-9);
    }

    #[test]
    fn the_flip_is_the_matrix_of_the_specification() {
        let edit = ImageEdit::identity(256, 128).flip();
        assert_eq!(edit.to_rows(), [[-1.0, 0.0, 256.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        assert_eq!(edit.apply(DVec2::new(0.5, 3.0)), DVec2::new(255.5, 3.0), "first and last pixel centre swap");
        assert_eq!(edit.flip().img_from_raw, DMat3::IDENTITY);
    }

    #[test]
    fn edits_apply_left_to_right() {
        let edit = ImageEdit::identity(1600, 900).resize(400, 225).crop(10, -5, 300, 224).flip();
        assert_eq!((edit.width, edit.height), (300, 224));
        // (800, 400) -> (200, 100) -> (190, 105) -> (110, 105)
        assert_eq!(edit.apply(DVec2::new(800.0, 400.0)), DVec2::new(110.0, 105.0));
        assert!((edit.invert(DVec2::new(110.0, 105.0)) - DVec2::new(800.0, 400.0)).length() < 1e-12);
        let k = edit.intrinsics(&LANDSCAPE);
        assert!((k.fx + 316.6).abs() < 1e-12 && (k.fy - 315.025).abs() < 1e-12);
    }

    #[test]
    fn a_portrait_picture_survives_an_anamorphic_resize() {
        let edit = ImageEdit::identity(PORTRAIT.width, PORTRAIT.height).resize(256, 256);
        let camera = Camera::new(edit.intrinsics(&PORTRAIT), Lens::Pinhole).unwrap();
        assert!(camera.intrinsics.fx > camera.intrinsics.fy, "a portrait is stretched sideways");
        for ray in [DVec3::new(0.2, -0.4, 1.0), DVec3::new(-0.4, 0.5, 1.0), DVec3::Z] {
            let pixel = camera.project(ray * 7.0).unwrap();
            assert!(camera.intrinsics.contains(pixel));
            assert!((camera.unproject(pixel).unwrap() - ray.normalize()).length() < 1e-12);
        }
    }

    #[test]
    fn a_lens_sees_through_an_edit_unchanged() {
        let lens = Lens::BrownConrady { k: [-0.3561, 0.1725, -0.0523], p: [-0.0021, 0.0005] };
        let edit = ImageEdit::identity(1600, 900).resize(320, 180).flip();
        let point = DVec3::new(-2.0, 1.0, 6.0);
        let raw = Camera::new(LANDSCAPE, lens).unwrap().project(point).unwrap();
        let network = Camera::new(edit.intrinsics(&LANDSCAPE), lens).unwrap().project(point).unwrap();
        assert!((network - edit.apply(raw)).length() < 1e-9);
    }
}
