//! Reads one golden folder: tensors stored whole, as strided values, or as probes.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use burn::tensor::{Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// The golden folder of this name, if goldens are there at all. With `RIGSCAPE_GOLDEN` set, a missing folder is a failure.
pub fn folder(name: &str) -> Option<PathBuf> {
    match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => Some(PathBuf::from(root).join(name)),
        None => {
            let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(name);
            if path.is_dir() {
                return Some(path);
            }
            eprintln!("did not run: no golden folder {name}; set RIGSCAPE_GOLDEN");
            None
        }
    }
}

pub fn json(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// One decoded tensor.
pub struct Stored {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

pub struct Golden {
    tensors: HashMap<String, Stored>,
    index: Value,
}

impl Golden {
    pub fn open(folder: &Path, file: &str) -> Self {
        let path = folder.join(file);
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let tensors = file
            .iter()
            .map(|(name, view)| {
                let values = decode(view.dtype(), view.data());
                (name.to_owned(), Stored { shape: view.shape().to_vec(), values })
            })
            .collect();
        Self { tensors, index: json(&folder.join("index.json")) }
    }

    pub fn get(&self, name: &str) -> &Stored {
        self.tensors.get(name).unwrap_or_else(|| panic!("golden tensor {name} is missing"))
    }

    /// Compares with whatever is stored of the tensor; returns the largest absolute difference.
    pub fn check<const D: usize>(&self, name: &str, got: Tensor<D>, tolerance: f64) -> f64 {
        self.check_where(name, got, tolerance, |_| true)
    }

    /// As [`Golden::check`], for the flat positions that `counts` admits.
    pub fn check_where<const D: usize>(
        &self,
        name: &str,
        got: Tensor<D>,
        tolerance: f64,
        counts: impl Fn(usize) -> bool,
    ) -> f64 {
        let want_shape: Vec<usize> = self.index[name]["shape"]
            .as_array()
            .unwrap_or_else(|| panic!("{name} is not in index.json"))
            .iter()
            .map(|v| v.as_u64().unwrap() as usize)
            .collect();
        let got = got.inner_values();
        assert_eq!(got.len(), want_shape.iter().product::<usize>(), "{name}: element count, want {want_shape:?}");
        let stored = self.stored_values(name);
        assert!(!stored.is_empty(), "{name}: nothing stored to compare with");
        let compared = stored.iter().filter(|(i, _)| counts(*i));
        let worst = compared.map(|(i, value)| (got[*i] - value).abs()).fold(0.0, f64::max);
        assert!(worst <= tolerance, "{name}: off by {worst:e}, tolerance {tolerance:e}");
        worst
    }

    /// Flat positions and values, however the tensor is stored.
    fn stored_values(&self, name: &str) -> Vec<(usize, f64)> {
        let mut pairs = Vec::new();
        if let Some(full) = self.tensors.get(name) {
            pairs.extend(full.values.iter().copied().enumerate());
        }
        if let Some(strided) = self.tensors.get(&format!("{name}.strided")) {
            let step = self.index[name]["step"].as_u64().unwrap() as usize;
            pairs.extend(strided.values.iter().enumerate().map(|(i, value)| (i * step, *value)));
        }
        if let Some(index) = self.tensors.get(&format!("{name}.probe_index")) {
            let values = &self.get(&format!("{name}.probe_value")).values;
            pairs.extend(index.values.iter().zip(values).map(|(i, value)| (*i as usize, *value)));
        }
        pairs
    }

    /// A mask stored as bits, least significant first.
    pub fn bits(&self, name: &str, count: usize) -> Vec<bool> {
        let bytes = &self.get(name).values;
        (0..count).map(|i| (bytes[i / 8] as u8 >> (i % 8)) & 1 == 1).collect()
    }
}

pub trait HostValues {
    fn inner_values(self) -> Vec<f64>;
}

impl<const D: usize> HostValues for Tensor<D> {
    fn inner_values(self) -> Vec<f64> {
        let data: TensorData = self.into_data();
        data.iter::<f64>().collect()
    }
}

fn decode(dtype: Dtype, bytes: &[u8]) -> Vec<f64> {
    fn words<const N: usize>(bytes: &[u8], f: impl Fn([u8; N]) -> f64) -> Vec<f64> {
        bytes.chunks_exact(N).map(|chunk| f(chunk.try_into().unwrap())).collect()
    }
    match dtype {
        Dtype::F32 => words(bytes, |b| f64::from(f32::from_le_bytes(b))),
        Dtype::F64 => words(bytes, f64::from_le_bytes),
        Dtype::I32 => words(bytes, |b| f64::from(i32::from_le_bytes(b))),
        Dtype::I64 => words(bytes, |b| i64::from_le_bytes(b) as f64),
        Dtype::U8 | Dtype::BOOL => bytes.iter().map(|b| f64::from(*b)).collect(),
        other => panic!("unexpected dtype {other:?}"),
    }
}
