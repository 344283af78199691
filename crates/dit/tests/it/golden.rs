//! Reads a golden folder.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// The golden folder, if goldens are there at all. With `RIGSCAPE_GOLDEN` set, a missing folder is a failure.
pub fn folder() -> Option<PathBuf> {
    let root = std::env::var_os("RIGSCAPE_GOLDEN");
    if root.is_none() {
        eprintln!("did not run: no golden folder dit; set RIGSCAPE_GOLDEN");
    }
    root.map(|root| PathBuf::from(root).join("dit"))
}

pub fn json(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// All tensors of the folder, with their shapes.
pub struct Golden(HashMap<String, (Vec<usize>, Vec<f64>)>);

impl Golden {
    pub fn open(folder: &Path) -> Self {
        let path = folder.join("io.safetensors");
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        Self(
            file.iter()
                .map(|(name, view)| (name.to_owned(), (view.shape().to_vec(), decode(view.dtype(), view.data()))))
                .collect(),
        )
    }

    fn get(&self, name: &str) -> &(Vec<usize>, Vec<f64>) {
        self.0.get(name).unwrap_or_else(|| panic!("golden tensor {name} is missing"))
    }

    pub fn shape(&self, name: &str) -> &[usize] {
        &self.get(name).0
    }

    pub fn values(&self, name: &str) -> &[f64] {
        &self.get(name).1
    }

    pub fn names(&self, prefix: &str) -> Vec<String> {
        let mut names: Vec<String> = self.0.keys().filter(|name| name.starts_with(prefix)).cloned().collect();
        names.sort();
        names
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let (shape, values) = self.get(name);
        let shape: [usize; D] = shape.clone().try_into().unwrap_or_else(|s| panic!("{name} has shape {s:?}"));
        Tensor::from_data(TensorData::new(values.iter().map(|v| *v as f32).collect::<Vec<_>>(), shape), device)
    }

    /// Largest difference, in units of the larger of `least` and the reference's largest value.
    pub fn distance<const D: usize>(&self, name: &str, got: &Tensor<D>, least: f64) -> f64 {
        let (shape, want) = self.get(name);
        assert_eq!(got.dims().as_slice(), shape.as_slice(), "{name}");
        relative(&got.to_data().try_to_vec::<f32>().unwrap(), want, least)
    }
}

/// Largest difference of two lists, in units of the larger of `least` and the reference's largest value.
pub fn relative(got: &[f32], want: &[f64], least: f64) -> f64 {
    assert_eq!(got.len(), want.len());
    let scale = want.iter().fold(least, |scale, v| scale.max(v.abs()));
    let worst = got
        .iter()
        .zip(want)
        .map(|(a, b)| (f64::from(*a) - b).abs())
        .fold(0.0, |worst: f64, d| if d.is_nan() { f64::INFINITY } else { worst.max(d) });
    worst / scale
}

fn decode(dtype: Dtype, bytes: &[u8]) -> Vec<f64> {
    match dtype {
        Dtype::F32 => bytes.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
        Dtype::F64 => bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        Dtype::I64 => bytes.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
        other => panic!("golden tensors are f32, f64 or i64, not {other:?}"),
    }
}
