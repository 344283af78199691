//! Finds golden folders and reads their tensors; names and shapes come from the files.

use std::collections::BTreeMap;
use std::path::PathBuf;

use geometry::Rigid;
use geometry::glam::{DMat3, DMat4, DVec2, DVec3};
use safetensors::{Dtype, SafeTensors};

/// Tensors of one golden by name, all numbers as f64 (its integers are below 2^53).
pub struct Golden(BTreeMap<String, Tensor>);

pub struct Tensor {
    name: String,
    pub shape: Vec<usize>,
    pub values: Vec<f64>,
}

impl Golden {
    /// Reads `<golden>/<folder>/io.safetensors`. `None`, with a message, if no golden folder was named and none lies in the
    /// workspace; with `RIGSCAPE_GOLDEN` set a missing file fails.
    pub fn open(folder: &str) -> Option<Self> {
        let named = std::env::var_os("RIGSCAPE_GOLDEN").map(PathBuf::from);
        let in_workspace = || PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden");
        let path = named.clone().unwrap_or_else(in_workspace).join(folder).join("io.safetensors");
        if named.is_none() && !path.exists() {
            eprintln!("not run: {} is absent; set RIGSCAPE_GOLDEN", path.display());
            return None;
        }
        let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let read = |(name, view): (String, safetensors::tensor::TensorView)| {
            let tensor =
                Tensor { name: name.clone(), shape: view.shape().to_vec(), values: numbers(view.dtype(), view.data()) };
            (name, tensor)
        };
        Some(Self(file.tensors().into_iter().map(read).collect()))
    }

    pub fn get(&self, name: &str) -> &Tensor {
        self.find(name).unwrap_or_else(|| panic!("golden has no tensor {name}"))
    }

    pub fn find(&self, name: &str) -> Option<&Tensor> {
        self.0.get(name)
    }

    /// The only tensor below `prefix` that carries one of these names, if any.
    pub fn find_any(&self, prefix: &str, names: &[&str]) -> Option<&Tensor> {
        names.iter().find_map(|name| self.find(&format!("{prefix}/{name}")))
    }

    /// What stands before `/suffix` in the names that end in it.
    pub fn prefixes(&self, suffix: &str) -> Vec<&str> {
        let with_slash = format!("/{suffix}");
        self.0.keys().filter_map(|name| name.strip_suffix(&with_slash)).collect()
    }
}

fn numbers(dtype: Dtype, data: &[u8]) -> Vec<f64> {
    match dtype {
        Dtype::U8 => data.iter().map(|b| f64::from(*b)).collect(),
        Dtype::F64 => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
        Dtype::I64 => data.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
        other => panic!("goldens of this crate hold no {other:?}"),
    }
}

impl Tensor {
    /// Innermost rows of length `N`.
    pub fn rows<const N: usize>(&self) -> &[[f64; N]] {
        let (rows, rest) = self.values.as_chunks();
        assert!(rest.is_empty(), "{} of shape {:?} is no table of {N} columns", self.name, self.shape);
        rows
    }

    pub fn vec2s(&self) -> Vec<DVec2> {
        self.rows().iter().map(|v| DVec2::from_array(*v)).collect()
    }

    pub fn vec3s(&self) -> Vec<DVec3> {
        self.rows().iter().map(|v| DVec3::from_array(*v)).collect()
    }

    pub fn mat3s(&self) -> Vec<DMat3> {
        self.rows().iter().map(|m| DMat3::from_cols_array(m).transpose()).collect()
    }

    pub fn mat4s(&self) -> Vec<DMat4> {
        self.rows().iter().map(|m| DMat4::from_cols_array(m).transpose()).collect()
    }

    pub fn rigids(&self) -> Vec<Rigid> {
        self.mat4s().iter().map(Rigid::from_mat4).collect()
    }

    pub fn flags(&self) -> Vec<bool> {
        self.values.iter().map(|v| *v != 0.0).collect()
    }
}
