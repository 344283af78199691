//! What can be wrong with a weight file or with the fit between weights and a module.

use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// Why weights could not be read, written or applied. The path stands last in every text that has one.
#[derive(Debug, thiserror::Error)]
pub enum WeightError {
    /// The operating system refused to open, read or write the file.
    #[error("cannot access weights: {source}: {}", path.display())]
    Io {
        /// What the system said.
        source: std::io::Error,
        /// The file.
        path: PathBuf,
    },
    /// The header is longer than the file, no JSON, or contradicts itself (shape against byte range).
    #[error("not a sound safetensors header: {reason}: {}", path.display())]
    Header {
        /// What is wrong.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// The data does not end where the header says.
    #[error("safetensors file has {found} bytes, its header describes {expected}: {}", path.display())]
    Length {
        /// Bytes the header accounts for, itself included.
        expected: u64,
        /// Bytes of the file.
        found: u64,
        /// The file.
        path: PathBuf,
    },
    /// A tensor that was asked for is not in the file.
    #[error("no tensor named {name}: {}", path.display())]
    MissingTensor {
        /// Its name.
        name: String,
        /// The file.
        path: PathBuf,
    },
    /// A tensor asked for as weights holds integers, one asked for as integers holds floats, or its type is a rarer one.
    #[error(
        "tensor {name} has element type {dtype}; weights are F64, F32, F16 or BF16, counters and indices BOOL, U8 or I8 to I64: {}",
        path.display()
    )]
    ElementType {
        /// The tensor.
        name: String,
        /// Its element type.
        dtype: String,
        /// The file.
        path: PathBuf,
    },
    /// A torch file is damaged, hostile or holds no state dict.
    #[error("not a usable torch file: {source}: {}", path.display())]
    Torch {
        /// What is wrong.
        source: TorchFault,
        /// The file.
        path: PathBuf,
    },
    /// Tensors that cannot be written: a name twice, or a header beyond the format's limit.
    #[error("cannot write safetensors: {reason}: {}", path.display())]
    Write {
        /// What is wrong.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// A rule returned another number of values than the parameter holds.
    #[error("parameter {name} of shape {shape:?} got {found} values")]
    Count {
        /// Path of the parameter.
        name: String,
        /// Its shape.
        shape: Vec<usize>,
        /// Values offered.
        found: usize,
    },
    /// A parameter's values could not be read back from its device.
    #[error("cannot read parameter {name} back from its device: {reason}")]
    Readback {
        /// Path of the parameter.
        name: String,
        /// What the backend said.
        reason: String,
    },
    /// Names or shapes of weights and module differ.
    #[error("{0}")]
    Mismatch(Box<Mismatch>),
    /// The weights are complete, but of none of the known layouts.
    #[error("unknown weight layout: {reason}: {}", path.display())]
    Layout {
        /// What was looked for.
        reason: String,
        /// The file.
        path: PathBuf,
    },
}

/// What is wrong with a torch file.
#[derive(Debug, thiserror::Error)]
pub enum TorchFault {
    /// The zip archive itself, or the sequence of pickles of an older file.
    #[error("{0}")]
    Container(String),
    /// The pickle that describes the objects.
    #[error("pickle: {0}")]
    Pickle(#[from] pickle::PickleError),
    /// One tensor of the state dict.
    #[error("tensor {name}: {reason}")]
    Tensor {
        /// Its name.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// There is no state dict where one was looked for.
    #[error("{0}")]
    StateDict(String),
}

impl WeightError {
    /// Adds the file to a [`WeightError::Mismatch`]; other errors stay as they are.
    #[must_use]
    pub fn in_file(mut self, path: &Path) -> Self {
        if let Self::Mismatch(mismatch) = &mut self {
            mismatch.path = Some(path.to_path_buf());
        }
        self
    }
}

/// Every difference between the names and shapes of a module and those of a set of weights.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Mismatch {
    /// Parameters without a tensor, with their shapes.
    pub missing: Vec<(String, Vec<usize>)>,
    /// Tensors without a parameter.
    pub unexpected: Vec<String>,
    /// Name, shape of the parameter, shape of the tensor.
    pub wrong_shape: Vec<(String, Vec<usize>, Vec<usize>)>,
    /// Where the weights come from, if from a file.
    pub path: Option<PathBuf>,
}

impl Mismatch {
    /// Compares names and shapes of a module's parameters with those of tensors.
    #[must_use]
    pub fn between(wanted: &BTreeMap<String, Vec<usize>>, found: &BTreeMap<String, Vec<usize>>) -> Self {
        let mut mismatch = Self::default();
        for (name, shape) in wanted {
            match found.get(name) {
                None => mismatch.missing.push((name.clone(), shape.clone())),
                Some(other) if other != shape => {
                    mismatch.wrong_shape.push((name.clone(), shape.clone(), other.clone()));
                }
                Some(_) => {}
            }
        }
        mismatch.unexpected.extend(found.keys().filter(|name| !wanted.contains_key(*name)).cloned());
        mismatch
    }

    /// Whether everything fits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.unexpected.is_empty() && self.wrong_shape.is_empty()
    }
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "weights do not fit: {} missing, {} unexpected, {} of another shape",
            self.missing.len(),
            self.unexpected.len(),
            self.wrong_shape.len()
        )?;
        for (name, shape) in &self.missing {
            write!(f, "\n  missing     {name} {shape:?}")?;
        }
        for name in &self.unexpected {
            write!(f, "\n  unexpected  {name}")?;
        }
        for (name, expected, found) in &self.wrong_shape {
            write!(f, "\n  shape       {name} is {found:?}, the model needs {expected:?}")?;
        }
        self.path.as_ref().map_or(Ok(()), |path| write!(f, "\n  in: {}", path.display()))
    }
}
