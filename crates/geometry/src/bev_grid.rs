//! The bird's-eye-view voxel grid; the only place that states its memory order.

use glam::DVec3;
use serde::{Deserialize, Serialize};

use crate::GeometryError;

/// An axis-aligned voxel grid in the ego frame.
///
/// Memory order is (z, y, x), x fastest: row index grows with +y (row 0 is the car's right), column with +x (column 0 is behind),
/// slice with +z. Tensors over it are `[.., Z, Y, X]`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct BevGrid {
    /// Extent along ego x, metres.
    pub x_range: [f64; 2],
    /// Extent along ego y, metres.
    pub y_range: [f64; 2],
    /// Extent along ego z, metres.
    pub z_range: [f64; 2],
    /// Cells along (z, y, x).
    pub cells: [usize; 3],
}

impl BevGrid {
    /// Checks ranges and counts.
    ///
    /// # Errors
    /// Empty or non-finite ranges, zero cells.
    pub fn checked(self) -> Result<Self, GeometryError> {
        for (what, range) in
            [("grid x range", self.x_range), ("grid y range", self.y_range), ("grid z range", self.z_range)]
        {
            if !range.iter().all(|v| v.is_finite()) {
                return Err(GeometryError::NotFinite { what });
            }
            if range[1] <= range[0] {
                return Err(GeometryError::NotPositive { what, value: range[1] - range[0] });
            }
        }
        if self.cells.contains(&0) {
            return Err(GeometryError::NotPositive { what: "grid cell count", value: 0.0 });
        }
        Ok(self)
    }

    /// Cells in all.
    pub fn len(&self) -> usize {
        self.cells.iter().product()
    }

    /// Never true for a checked grid.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Lower corner, metres in ego.
    pub fn low(&self) -> DVec3 {
        DVec3::new(self.x_range[0], self.y_range[0], self.z_range[0])
    }

    /// Extent along x, y, z, metres.
    pub fn extent(&self) -> DVec3 {
        DVec3::new(self.x_range[1], self.y_range[1], self.z_range[1]) - self.low()
    }

    /// Cell size along x, y, z, metres.
    pub fn cell_size(&self) -> DVec3 {
        let [z, y, x] = self.cells;
        self.extent() / DVec3::new(x as f64, y as f64, z as f64)
    }

    /// Centre of cell (z, y, x) in ego metres.
    pub fn center(&self, z: usize, y: usize, x: usize) -> DVec3 {
        self.low() + self.cell_size() * (DVec3::new(x as f64, y as f64, z as f64) + 0.5)
    }

    /// Centres of all cells in memory order, ego metres.
    pub fn centers(&self) -> Vec<DVec3> {
        let [nz, ny, nx] = self.cells;
        let mut out = Vec::with_capacity(self.len());
        for z in 0..nz {
            for y in 0..ny {
                for x in 0..nx {
                    out.push(self.center(z, y, x));
                }
            }
        }
        out
    }

    /// Ego metres to unit coordinates (x, y, z): 0 and 1 are the outer borders.
    pub fn unit_from_ego(&self, point: DVec3) -> DVec3 {
        (point - self.low()) / self.extent()
    }

    /// The cell (z, y, x) that holds a point, if any.
    pub fn cell_of(&self, point: DVec3) -> Option<[usize; 3]> {
        let [nz, ny, nx] = self.cells;
        let scaled = self.unit_from_ego(point) * DVec3::new(nx as f64, ny as f64, nz as f64);
        let cell = scaled.floor();
        let inside = cell.cmpge(DVec3::ZERO).all() && cell.x < nx as f64 && cell.y < ny as f64 && cell.z < nz as f64;
        inside.then_some([cell.z as usize, cell.y as usize, cell.x as usize])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAPER: BevGrid =
        BevGrid { x_range: [-51.2, 51.2], y_range: [-51.2, 51.2], z_range: [-5.0, 3.0], cells: [8, 128, 128] };

    #[test]
    fn the_paper_grid_has_the_sizes_of_the_paper() {
        assert!((PAPER.cell_size() - DVec3::new(0.8, 0.8, 1.0)).length() < 1e-12);
        assert_eq!(PAPER.len(), 8 * 128 * 128);
        assert!((PAPER.center(0, 0, 0) - DVec3::new(-50.8, -50.8, -4.5)).length() < 1e-12);
        assert!((PAPER.center(7, 127, 127) - DVec3::new(50.8, 50.8, 2.5)).length() < 1e-12);
    }

    #[test]
    fn memory_order_is_z_y_x_with_x_fastest() {
        let grid = BevGrid { x_range: [0.0, 3.0], y_range: [0.0, 2.0], z_range: [0.0, 2.0], cells: [2, 2, 3] };
        let centers = grid.centers();
        assert_eq!(centers.len(), grid.len());
        assert_eq!(centers[0], DVec3::splat(0.5));
        assert_eq!(centers[1], DVec3::new(1.5, 0.5, 0.5), "the next column lies further ahead");
        assert_eq!(centers[3], DVec3::new(0.5, 1.5, 0.5), "the next row lies further left");
        assert_eq!(centers[6], DVec3::new(0.5, 0.5, 1.5), "the next slice lies higher");
    }

    #[test]
    fn every_center_lies_in_its_own_cell_and_outside_there_is_none() {
        let grid = BevGrid { cells: [3, 10, 7], ..PAPER };
        for (index, center) in grid.centers().into_iter().enumerate() {
            let [z, y, x] = grid.cell_of(center).unwrap();
            assert_eq!((z * 10 + y) * 7 + x, index);
        }
        assert_eq!(grid.cell_of(DVec3::new(51.2, 0.0, 0.0)), None);
        assert_eq!(grid.cell_of(DVec3::new(-51.2, -51.2, -5.0)), Some([0, 0, 0]));
        assert_eq!(grid.cell_of(DVec3::new(0.0, 0.0, -5.01)), None);
        assert_eq!(grid.cell_of(DVec3::new(0.0, f64::NAN, 0.0)), None);
    }

    #[test]
    fn unit_coordinates_run_from_border_to_border() {
        assert_eq!(PAPER.unit_from_ego(PAPER.low()), DVec3::ZERO);
        assert!(
            (PAPER.unit_from_ego(PAPER.center(2, 5, 9)) * DVec3::new(128.0, 128.0, 8.0) - DVec3::new(9.5, 5.5, 2.5))
                .length()
                < 1e-12
        );
    }

    #[test]
    fn unusable_grids_are_refused() {
        assert!(PAPER.checked().is_ok());
        assert!(BevGrid { x_range: [1.0, 1.0], ..PAPER }.checked().is_err());
        assert!(BevGrid { y_range: [f64::NAN, 1.0], ..PAPER }.checked().is_err());
        assert!(BevGrid { cells: [8, 0, 128], ..PAPER }.checked().is_err());
    }
}
