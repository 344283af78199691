//! The camera frustum that the scene decoder samples along (BEV-VAE).

use glam::{DVec2, DVec3};
use serde::{Deserialize, Serialize};

/// Where the rays of the frustum's lattice meet the picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrustumPixels {
    /// Evenly spaced from 0.5 to size − 0.5, as the released checkpoints need.
    EndToEnd,
    /// Centres of the patches that the image decoder paints.
    PatchCentre,
}

/// Depth bins times rays of one camera; memory order (depth, row, column).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Frustum {
    /// Number of depth bins.
    pub depths: usize,
    /// Depth of one bin along camera z, metres; bin d is centred at (d + 0.5) · bin.
    pub bin_m: f64,
    /// Rows of rays.
    pub rows: usize,
    /// Columns of rays.
    pub columns: usize,
    /// Where the rays lie in the picture.
    pub pixels: FrustumPixels,
}

impl Frustum {
    /// Points in all.
    pub fn len(&self) -> usize {
        self.depths * self.rows * self.columns
    }

    /// True only for a frustum without points.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Network pixel of ray (row, column) in a picture of this size.
    pub fn ray_pixel(&self, row: usize, column: usize, width: u32, height: u32) -> DVec2 {
        let along = |index: usize, count: usize, size: u32| {
            let size = f64::from(size);
            match self.pixels {
                FrustumPixels::PatchCentre => (index as f64 + 0.5) * size / count as f64,
                // What evenly spaced values from start to end mean for one value in the released code: the start.
                FrustumPixels::EndToEnd if count == 1 => 0.5,
                FrustumPixels::EndToEnd => 0.5 + (size - 1.0) * index as f64 / (count - 1) as f64,
            }
        };
        DVec2::new(along(column, self.columns, width), along(row, self.rows, height))
    }

    /// All points as (u·z, v·z, z) in network pixels and metres, so that one 3×4 matrix takes them to ego.
    pub fn scaled_pixels(&self, width: u32, height: u32) -> Vec<DVec3> {
        let mut out = Vec::with_capacity(self.len());
        for d in 0..self.depths {
            let z = (d as f64 + 0.5) * self.bin_m;
            for row in 0..self.rows {
                for column in 0..self.columns {
                    let pixel = self.ray_pixel(row, column, width, height);
                    out.push(DVec3::new(pixel.x * z, pixel.y * z, z));
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAPER: Frustum = Frustum { depths: 60, bin_m: 1.0, rows: 32, columns: 32, pixels: FrustumPixels::EndToEnd };

    #[test]
    fn the_paper_lattice_runs_end_to_end() {
        assert_eq!(PAPER.ray_pixel(0, 0, 256, 256), DVec2::new(0.5, 0.5));
        assert!((PAPER.ray_pixel(31, 31, 256, 256) - DVec2::new(255.5, 255.5)).length() < 1e-12);
        assert!((PAPER.ray_pixel(0, 1, 256, 256).x - (0.5 + 255.0 / 31.0)).abs() < 1e-12);
    }

    #[test]
    fn patch_centres_lie_where_the_decoder_paints() {
        let ours = Frustum { pixels: FrustumPixels::PatchCentre, ..PAPER };
        assert_eq!(ours.ray_pixel(0, 0, 256, 256), DVec2::new(4.0, 4.0));
        assert_eq!(ours.ray_pixel(1, 31, 256, 256), DVec2::new(252.0, 12.0));
        assert_eq!(ours.ray_pixel(31, 0, 512, 256), DVec2::new(8.0, 252.0));
    }

    #[test]
    fn points_come_by_depth_then_row_then_column() {
        let points = PAPER.scaled_pixels(256, 256);
        assert_eq!(points.len(), PAPER.len());
        assert_eq!(points[0], DVec3::new(0.25, 0.25, 0.5));
        assert_eq!(points[32 * 32].z, 1.5);
        assert_eq!(points[PAPER.len() - 1].z, 59.5);
        let (second_column, second_row) = (points[1] / 0.5, points[32] / 0.5);
        assert!(second_column.x > 8.0 && second_column.y == 0.5);
        assert!(second_row.y > 8.0 && second_row.x == 0.5);
    }
}
