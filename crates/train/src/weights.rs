//! Weights of any module as a safetensors file: little-endian f32 tensors named by parameter path.
//!
//! Loading is strict: every parameter must be in the file with its shape, and nothing else may be in it.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt;
use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use safetensors::tensor::{Dtype, SafeTensors, View, serialize_to_file};

use crate::TrainError;
use crate::params::{NamedTensor, NamedTensors, inner_device, list_parameters, map_parameters, named_parameters};

/// Key under which a weight file carries the text of the experiment's config.
const CONFIG_KEY: &str = "config";

/// Which parameters, by path.
pub type Keep = fn(&str) -> bool;

/// Every parameter.
pub(crate) const ALL: Keep = |_| true;

/// How stored tensors differ from a module's parameters.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct WeightDiff {
    /// Parameters that the file does not have.
    pub missing: Vec<String>,
    /// Tensors of the file that the module does not have.
    pub unexpected: Vec<String>,
    /// Path, shape in the module, shape in the file.
    pub wrong_shape: Vec<(String, Vec<usize>, Vec<usize>)>,
}

impl WeightDiff {
    /// Compares names and shapes of the parameters whose path `keep` accepts.
    pub(crate) fn between<M: Module>(module: &M, stored: &NamedTensors, keep: Keep) -> Self {
        let mut diff = Self::default();
        let mut unexpected: std::collections::BTreeSet<&String> = stored.keys().collect();
        for info in list_parameters(module).into_iter().filter(|info| keep(&info.path)) {
            unexpected.remove(&info.path);
            match stored.get(&info.path) {
                None => diff.missing.push(info.path),
                Some(tensor) if tensor.shape != info.shape => {
                    diff.wrong_shape.push((info.path, info.shape, tensor.shape.clone()));
                }
                Some(_) => {}
            }
        }
        diff.unexpected = unexpected.into_iter().cloned().collect();
        diff
    }

    /// Whether file and module fit.
    pub fn is_empty(&self) -> bool {
        self.missing.is_empty() && self.unexpected.is_empty() && self.wrong_shape.is_empty()
    }

    pub(crate) fn into_result(self, path: &Path) -> Result<(), TrainError> {
        if self.is_empty() { Ok(()) } else { Err(TrainError::WeightMismatch { diff: self, path: path.to_path_buf() }) }
    }
}

impl fmt::Display for WeightDiff {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut lines = Vec::new();
        lines.extend(self.missing.iter().map(|path| format!("  missing in the file: {path}")));
        lines.extend(self.unexpected.iter().map(|path| format!("  unknown to the model: {path}")));
        lines.extend(self.wrong_shape.iter().map(|(path, model, file)| {
            format!("  wrong shape: {path} is {model:?} in the model, {file:?} in the file")
        }));
        f.write_str(&lines.join("\n"))
    }
}

/// Writes all float parameters of a module; `config` is kept in the file's metadata.
///
/// # Errors
/// When the file cannot be written.
pub fn save_named<M: Module>(module: &M, path: &Path, config: Option<&str>) -> Result<(), TrainError> {
    write_tensors(&named_parameters(module), path, config)
}

/// Reads a module's parameters from a file; devices and autodiff settings stay as they are.
///
/// # Errors
/// [`TrainError::WeightMismatch`] with every difference when the file holds anything but exactly this module's
/// parameters, [`TrainError::Damaged`] when it is no such file.
pub fn load_named<M: Module>(module: M, path: &Path) -> Result<M, TrainError> {
    load_part(module, path, ALL)
}

/// As [`load_named`] for the parameters whose path `keep` accepts; the others stay.
pub(crate) fn load_part<M: Module>(module: M, path: &Path, keep: Keep) -> Result<M, TrainError> {
    let Some(device) = inner_device(&module) else { return Ok(module) };
    let mut stored = read_tensors(path, &device)?;
    WeightDiff::between(&module, &stored, keep).into_result(path)?;
    Ok(map_parameters(module, |info, own| stored.remove(&info.path).map_or(own, |tensor| tensor.values)))
}

/// The config text that a weight file carries, if any.
///
/// # Errors
/// When the file cannot be read or is no safetensors file.
pub fn read_config_text(path: &Path) -> Result<Option<String>, TrainError> {
    let bytes = std::fs::read(path).map_err(TrainError::io("read", path))?;
    let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|why| TrainError::damaged(why.to_string(), path))?;
    Ok(metadata.metadata().as_ref().and_then(|entries| entries.get(CONFIG_KEY).cloned()))
}

/// Writes tensors one after the other, so that only one of them at a time is copied to the host.
pub(crate) fn write_tensors(tensors: &NamedTensors, path: &Path, config: Option<&str>) -> Result<(), TrainError> {
    let metadata = config.map(|text| HashMap::from([(CONFIG_KEY.to_string(), text.to_string())]));
    serialize_to_file(tensors.iter().map(|(name, tensor)| (name, Stored(tensor))), metadata, path).map_err(|error| {
        let source = std::io::Error::other(error.to_string());
        TrainError::Io { action: "write", source, path: path.to_path_buf() }
    })
}

/// Reads every tensor of a file onto a device.
pub(crate) fn read_tensors(path: &Path, device: &Device) -> Result<NamedTensors, TrainError> {
    let bytes = std::fs::read(path).map_err(TrainError::io("read", path))?;
    let file = SafeTensors::deserialize(&bytes).map_err(|why| TrainError::damaged(why.to_string(), path))?;
    let mut tensors = NamedTensors::new();
    for (name, view) in file.iter() {
        if view.dtype() != Dtype::F32 {
            return Err(TrainError::damaged(format!("{name} is {:?}, not F32", view.dtype()), path));
        }
        let (chunks, _) = view.data().as_chunks::<4>();
        let values: Vec<f32> = chunks.iter().map(|&chunk| f32::from_le_bytes(chunk)).collect();
        let len = values.len();
        let values = Tensor::from_data(TensorData::new(values, [len]), device);
        tensors.insert(name.to_string(), NamedTensor { shape: view.shape().to_vec(), values });
    }
    Ok(tensors)
}

/// A tensor whose bytes are fetched when the writer asks for them.
struct Stored<'a>(&'a NamedTensor);

impl View for Stored<'_> {
    fn dtype(&self) -> Dtype {
        Dtype::F32
    }

    fn shape(&self) -> &[usize] {
        &self.0.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        let data = self.0.values.clone().into_data();
        let mut bytes = Vec::with_capacity(self.data_len());
        data.iter::<f32>().for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
        Cow::Owned(bytes)
    }

    fn data_len(&self) -> usize {
        4 * self.0.shape.iter().product::<usize>()
    }
}
