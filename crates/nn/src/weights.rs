//! Named weights: safetensors and torch files, the parameters of a burn module by path and strict loading.
//!
//! Everything here works on host tensors. A parameter's path is the field names from the root down, joined by dots
//! (`blocks.3.attn.proj.weight`; the variant's name stands in the path of an enum).

mod element;
mod error;
mod file;
mod params;
mod safetensors_file;
mod torch;

pub use error::{Mismatch, TorchFault, WeightError};
pub use file::{WeightFile, write_text};
pub use params::{fill_params, fill_some_params, load_strict, named_params, param_shapes};
pub use safetensors_file::write_safetensors;
pub use torch::{TensorGroup, torch_groups};

/// A tensor on the host, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct HostTensor {
    /// Length of every axis; empty for a scalar.
    pub shape: Vec<usize>,
    /// `product(shape)` values.
    pub data: Vec<f32>,
}

impl HostTensor {
    /// Joins a shape and its values.
    ///
    /// # Panics
    /// When `data` does not hold `product(shape)` values.
    #[must_use]
    pub fn new(shape: &[usize], data: Vec<f32>) -> Self {
        assert_eq!(data.len(), shape.iter().product::<usize>(), "values for shape {shape:?}");
        Self { shape: shape.to_vec(), data }
    }
}
