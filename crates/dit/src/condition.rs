//! What steers the samples, as vectors.

use burn::module::{Module, Param};
use burn::tensor::{Int, Tensor, TensorData};
use nn::{Init, Linear};

use crate::block::xavier;

/// Binary occupancy to one vector per token: the same patch filter for all height slices, a learned vector per slice, slices side by side in the
/// channels. An empty layout is not "no layout": bias and slice vectors remain.
#[derive(Module, Debug)]
pub struct LayoutEmbedding {
    /// K·p² → D/Z
    pub patch: Linear,
    /// `[Z, D/Z]`
    pub slice_code: Param<Tensor<2>>,
    patch_size: usize,
}

impl LayoutEmbedding {
    /// `slices` must divide `width`.
    pub fn new(classes: usize, slices: usize, patch: usize, width: usize, init: &mut Init) -> Self {
        let per_slice = width / slices;
        Self {
            patch: xavier(classes * patch * patch, per_slice, init),
            slice_code: init.normal([slices, per_slice], 0.02),
            patch_size: patch,
        }
    }

    /// # Shapes
    /// - occupancy: `[B, K, Z, p·h, p·w]`
    /// - output: `[B, h·w, D]`, channels (slice, channel of the slice)
    pub fn forward(&self, occupancy: Tensor<5>) -> Tensor<3> {
        let [b, k, z, rows, columns] = occupancy.dims();
        let [_, per_slice] = self.slice_code.val().dims();
        let pictures = occupancy.swap_dims(1, 2).reshape([b * z, k, rows, columns]);
        let patches = nn::layout::patches_from_image(pictures, self.patch_size);
        let [_, h, w, _] = patches.dims();
        let slices = self.patch.forward(patches).reshape([b, z, h * w, per_slice]);
        let slices = slices + self.slice_code.val().reshape([1, z, 1, per_slice]);
        slices.swap_dims(1, 2).reshape([b, h * w, z * per_slice])
    }
}

/// A learned vector per class, and one for "none".
#[derive(Module, Debug)]
pub struct LabelEmbedding {
    /// `[classes + 1, D]`
    pub table: Param<Tensor<2>>,
}

impl LabelEmbedding {
    /// N(0, 0.02²).
    pub fn new(classes: usize, width: usize, init: &mut Init) -> Self {
        Self { table: init.normal([classes + 1, width], 0.02) }
    }

    /// `[B, D]`; `None` is the vector for "none".
    ///
    /// # Panics
    /// If a label is no class.
    pub fn forward(&self, labels: &[Option<usize>]) -> Tensor<2> {
        let table = self.table.val();
        let none = table.dims()[0] - 1;
        assert!(labels.iter().flatten().all(|&label| label < none), "labels {labels:?} of {none} classes");
        let rows: Vec<i32> = labels.iter().map(|label| label.unwrap_or(none) as i32).collect();
        let rows = Tensor::<1, Int>::from_data(TensorData::new(rows, [labels.len()]), &table.device());
        table.select(0, rows)
    }
}
