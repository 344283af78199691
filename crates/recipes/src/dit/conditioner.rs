//! Layouts to the occupancy that steers the network (section 3 of the specification).

use burn::tensor::{Device, Tensor, TensorData};
use data::layout::{Layout, LayoutClasses, LayoutError, Rasterise};
use geometry::BevGrid;
use rayon::prelude::*;

/// Classes, grid and rule: everything that gives a layout its occupancy.
#[derive(Debug, Clone, PartialEq)]
pub struct Conditioner {
    /// In channel order.
    pub classes: LayoutClasses,
    /// That of the autoencoder.
    pub grid: BevGrid,
    /// Which cells a box marks.
    pub rule: Rasterise,
}

impl Conditioner {
    /// # Shapes
    /// - output: `[B, K, Z, Y, X]`, 0 or 1
    ///
    /// # Errors
    /// The first layout that cannot be rasterised.
    pub fn occupancy(&self, layouts: &[&Layout], device: &Device) -> Result<Tensor<5>, LayoutError> {
        let [z, y, x] = self.grid.cells;
        let parts: Vec<Vec<f32>> = layouts
            .par_iter()
            .map(|layout| layout.occupancy(&self.grid, &self.classes, self.rule))
            .collect::<Result<_, LayoutError>>()?;
        let shape = [layouts.len(), self.classes.len(), z, y, x];
        Ok(Tensor::from_data(TensorData::new(parts.concat(), shape), device))
    }
}

#[cfg(test)]
mod tests {
    use data::layout::LayoutBox;
    use dit::LayoutEmbedding;
    use geometry::Box3d;
    use geometry::glam::DVec3;
    use nn::Init;

    use super::*;

    /// Cells of 2 x 1 x 1 metres: no axis can stand for another.
    const GRID: BevGrid =
        BevGrid { x_range: [-8.0, 8.0], y_range: [-6.0, 6.0], z_range: [-1.0, 3.0], cells: [4, 12, 8] };

    fn layout(x: f64, y: f64, z: f64) -> Layout {
        let shape = Box3d { center: DVec3::new(x, y, z), size: DVec3::splat(0.2), yaw: 0.0 };
        Layout { boxes: vec![LayoutBox::new("one", "truck", shape)] }
    }

    #[test]
    fn a_box_reaches_the_token_of_its_own_cell() {
        let device = Device::flex();
        let classes = LayoutClasses { names: vec!["car".to_owned(), "truck".to_owned()] };
        let conditioner = Conditioner { classes, grid: GRID, rule: Rasterise::CentresOrNearest };
        let (patch, width) = (2, 16);
        let embedding = LayoutEmbedding::new(2, 4, patch, width, &mut Init::new(1, &device));
        let nothing = Layout::default();
        // Far ahead on the right, behind on the left, beside.
        for (x, y, z) in [(7.1, -4.5, 0.6), (-6.9, 3.5, 2.5), (0.9, 5.9, -0.9)] {
            let own = layout(x, y, z);
            let occupancy = conditioner.occupancy(&[&own, &nothing], &device).unwrap();
            let numbers: Vec<f32> = occupancy.clone().into_data().iter::<f32>().collect();
            let [slice, row, column] = GRID.cell_of(DVec3::new(x, y, z)).unwrap();
            let cell = GRID.len() + (slice * 12 + row) * 8 + column;
            let set: Vec<usize> = (0..numbers.len()).filter(|at| numbers[*at] > 0.0).collect();
            assert_eq!(set, [cell], "one voxel of the second class");
            let tokens = embedding.forward(occupancy);
            let change = (tokens.clone().narrow(0, 0, 1) - tokens.narrow(0, 1, 1)).abs();
            let change: Vec<f32> = change.into_data().iter::<f32>().collect();
            let (token, per_slice) = (row / patch * (8 / patch) + column / patch, width / 4);
            for (at, value) in change.iter().enumerate() {
                let inside = at / width == token && at % width / per_slice == slice;
                assert_eq!(*value > 0.0, inside, "number {at}");
            }
        }
    }

    #[test]
    fn a_box_of_no_class_is_named() {
        let conditioner = Conditioner { classes: LayoutClasses::nuscenes(), grid: GRID, rule: Rasterise::Centres };
        let mut stranger = layout(0.0, 0.0, 0.0);
        stranger.boxes[0].class = "spaceship".to_owned();
        let error = conditioner.occupancy(&[&stranger], &Device::flex()).unwrap_err().to_string();
        assert!(error.contains("spaceship") && error.contains("one"), "{error}");
    }
}
