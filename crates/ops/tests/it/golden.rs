//! Reading golden files and comparing tensors with them.

use std::collections::BTreeMap;
use std::path::PathBuf;

use burn::tensor::{Bool, Device, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};

/// One stored tensor; integers and booleans are widened, f64 holds them exactly.
#[derive(Clone)]
pub struct Stored {
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

/// All tensors of one golden folder.
pub struct Golden {
    folder: PathBuf,
    tensors: BTreeMap<String, Stored>,
}

/// The folder `topic` of the golden files, or `None` (with a printed note) where this machine has none.
///
/// With `RIGSCAPE_GOLDEN` set, a missing file is a failure.
pub fn open(topic: &str) -> Option<Golden> {
    let (root, required) = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => (PathBuf::from(root), true),
        None => (PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"), false),
    };
    let folder = root.join(topic);
    if !required && !folder.exists() {
        eprintln!("golden folder `{topic}` is absent and RIGSCAPE_GOLDEN is not set: this test did not run");
        return None;
    }
    let path = folder.join("io.safetensors");
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let tensors = file.tensors().into_iter().map(|(name, view)| {
        let stored = Stored { shape: view.shape().to_vec(), values: widen(view.dtype(), view.data()) };
        (name, stored)
    });
    Some(Golden { folder, tensors: tensors.collect() })
}

fn widen(dtype: Dtype, bytes: &[u8]) -> Vec<f64> {
    match dtype {
        Dtype::F64 => bytes.as_chunks().0.iter().map(|&b| f64::from_le_bytes(b)).collect(),
        Dtype::F32 => bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b) as f64).collect(),
        Dtype::I64 => bytes.as_chunks().0.iter().map(|&b| i64::from_le_bytes(b) as f64).collect(),
        Dtype::BOOL => bytes.iter().map(|&b| b as f64).collect(),
        other => panic!("golden tensor of type {other:?}"),
    }
}

/// The device of all golden tests.
pub fn device() -> Device {
    Device::flex().autodiff()
}

impl Golden {
    pub fn get(&self, name: &str) -> &Stored {
        self.tensors.get(name).unwrap_or_else(|| panic!("no tensor {name} in {}", self.folder.display()))
    }

    pub fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    /// The stored tensor as a leaf that records its gradient.
    pub fn leaf<const D: usize>(&self, name: &str) -> Tensor<D> {
        self.tensor(name).require_grad()
    }

    /// The stored tensor as a constant.
    pub fn tensor<const D: usize>(&self, name: &str) -> Tensor<D> {
        let stored = self.get(name);
        let values: Vec<f32> = stored.values.iter().map(|&v| v as f32).collect();
        Tensor::from_data(TensorData::new(values, stored.shape.clone()), &device())
    }

    pub fn mask<const D: usize>(&self, name: &str) -> Tensor<D, Bool> {
        self.tensor::<D>(name).not_equal_elem(0.0)
    }

    pub fn text(&self, file: &str) -> String {
        std::fs::read_to_string(self.folder.join(file)).unwrap()
    }

    /// Names of the cases, the part before the last `/` of every tensor that ends with `/{tensor}` and starts with
    /// `prefix`. A golden folder without any is a failure.
    pub fn cases(&self, prefix: &str, tensor: &str) -> Vec<String> {
        let tail = format!("/{tensor}");
        let names = self.tensors.keys().filter(|name| name.starts_with(prefix));
        let cases: Vec<String> = names.filter_map(|name| name.strip_suffix(&tail).map(str::to_owned)).collect();
        assert!(!cases.is_empty(), "no case {prefix}*/{tensor} in {}", self.folder.display());
        cases
    }

    /// Compares with the stored tensor and its f64 version: `|a - b| ≤ absolute + 1e-4·|b|`.
    pub fn check<const D: usize>(&self, name: &str, actual: Tensor<D>, absolute: f64) {
        for name in [name.to_owned(), format!("{name}.f64")] {
            let expected = self.get(&name);
            assert_eq!(actual.dims().to_vec(), expected.shape, "shape of {name}");
            let actual = actual.to_data().try_to_vec::<f32>().unwrap();
            for (i, (&a, &b)) in actual.iter().zip(&expected.values).enumerate() {
                let error = (a as f64 - b).abs();
                assert!(error <= absolute + 1e-4 * b.abs(), "{name}[{i}]: {a}, expected {b}, off by {error:e}");
            }
        }
    }
}
