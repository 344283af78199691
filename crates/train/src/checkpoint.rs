//! One checkpoint folder: `<name>.safetensors` per part and `state.json`, which is written last and lists length and
//! SHA-256 of every file. A folder without a valid state file, or with a file that differs from it, is not loaded.
//!
//! All content is a function of the run's state (no clock, no host name), so two runs that agree bit for bit write
//! equal files.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::TrainError;
use crate::files::{fingerprint, sha256, sync_file, sync_folder, write_synced};
use crate::params::{NamedTensors, named_parameters};
use crate::weights::{Keep, load_named, load_part, read_tensors, write_tensors};

pub(crate) const STATE_FILE: &str = "state.json";
/// Raised when old checkpoints can no longer be read.
const FORMAT: u32 = 1;
/// Stands in the state file for its own checksum while that is computed.
const UNSEALED: &str = "0000000000000000000000000000000000000000000000000000000000000000";

/// Where the run stands, apart from the task's own tensors.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CheckpointState {
    /// Steps done.
    pub step: u64,
    /// Position in the data: batches taken from the source.
    pub position: u64,
    /// Seed of the run; with `step` it is the whole state of the random numbers.
    pub seed: u64,
    /// SHA-256 of the experiment's resolved config text.
    pub config_sha256: String,
    /// Last validation values; `None` where a value was not finite.
    pub scalars: BTreeMap<String, Option<f64>>,
    /// The best checkpoint up to here, this one included.
    pub best: Option<Best>,
}

/// Which checkpoint has been the best so far, and by what.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// Its step.
    pub step: u64,
    /// Name of the validation scalar.
    pub scalar: String,
    /// The scalar's value there.
    pub value: f64,
}

/// The state file's content.
#[derive(Debug, Serialize, Deserialize)]
struct Manifest {
    format: u32,
    /// SHA-256 of the state file's own text with [`UNSEALED`] in this place.
    sha256: String,
    state: CheckpointState,
    values: BTreeMap<String, Value>,
    files: BTreeMap<String, FileEntry>,
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct FileEntry {
    bytes: u64,
    sha256: String,
}

/// Writes the parts of one checkpoint.
#[derive(Debug)]
pub struct CheckpointWriter {
    folder: PathBuf,
    config_text: String,
    values: BTreeMap<String, Value>,
    files: BTreeMap<String, FileEntry>,
}

impl CheckpointWriter {
    /// Writes into an existing, empty folder.
    pub(crate) fn new(folder: &Path, config_text: &str) -> Self {
        let (values, files) = (BTreeMap::new(), BTreeMap::new());
        Self { folder: folder.to_path_buf(), config_text: config_text.to_string(), values, files }
    }

    /// Stores all float parameters of a module as `<name>.safetensors`; the config text is kept in its metadata.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn module<M: Module>(&mut self, name: &str, module: &M) -> Result<(), TrainError> {
        self.tensors(name, &named_parameters(module))
    }

    /// As [`CheckpointWriter::module`] for the parameters whose path `keep` accepts.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn module_part<M: Module>(&mut self, name: &str, module: &M, keep: Keep) -> Result<(), TrainError> {
        let mut parameters = named_parameters(module);
        parameters.retain(|path, _| keep(path));
        self.tensors(name, &parameters)
    }

    /// Stores tensors as `<name>.safetensors`; the config text is kept in its metadata.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn tensors(&mut self, name: &str, tensors: &NamedTensors) -> Result<(), TrainError> {
        let file = format!("{name}.safetensors");
        let path = self.folder.join(&file);
        write_tensors(tensors, &path, Some(&self.config_text))?;
        sync_file(&path)?;
        let (bytes, sha256) = fingerprint(&path)?;
        self.files.insert(file, FileEntry { bytes, sha256 });
        Ok(())
    }

    /// Stores a small value in the state file.
    ///
    /// # Errors
    /// When the value has no JSON form.
    pub fn value(&mut self, key: &str, value: &impl Serialize) -> Result<(), TrainError> {
        let value = serde_json::to_value(value)
            .map_err(|why| TrainError::Config(format!("checkpoint value {key:?} has no JSON form: {why}")))?;
        self.values.insert(key.to_string(), value);
        Ok(())
    }

    /// Writes the state file, which makes the folder a checkpoint.
    pub(crate) fn finish(self, state: CheckpointState) -> Result<(), TrainError> {
        let path = self.folder.join(STATE_FILE);
        let manifest =
            Manifest { format: FORMAT, sha256: UNSEALED.into(), state, values: self.values, files: self.files };
        let text =
            serde_json::to_string_pretty(&manifest).map_err(|why| TrainError::damaged(why.to_string(), &path))?;
        let text = text.replacen(UNSEALED, &sha256(text.as_bytes()), 1);
        write_synced(&path, text.as_bytes())?;
        sync_folder(&self.folder)
    }
}

/// Reads a whole and undamaged checkpoint.
#[derive(Debug)]
pub struct CheckpointReader {
    folder: PathBuf,
    manifest: Manifest,
}

impl CheckpointReader {
    /// Opens a checkpoint folder and compares every file with its recorded length and checksum.
    ///
    /// # Errors
    /// [`TrainError::Damaged`] naming the file that is not as it was written.
    pub fn open(folder: &Path) -> Result<Self, TrainError> {
        let path = folder.join(STATE_FILE);
        let text = std::fs::read_to_string(&path).map_err(TrainError::io("read", &path))?;
        let bad = |why: &dyn std::fmt::Display| TrainError::damaged(why.to_string(), &path);
        let manifest: Manifest = serde_json::from_str(&text).map_err(|why| bad(&why))?;
        if manifest.sha256 != sha256(text.replacen(&manifest.sha256, UNSEALED, 1).as_bytes()) {
            return Err(bad(&"its checksum does not match its content"));
        }
        if manifest.format != FORMAT {
            return Err(bad(&format!("checkpoint format {} instead of {FORMAT}", manifest.format)));
        }
        for (name, entry) in &manifest.files {
            let path = folder.join(name);
            let (bytes, sha256) = fingerprint(&path)?;
            if bytes != entry.bytes {
                return Err(TrainError::damaged(format!("{bytes} bytes long instead of {}", entry.bytes), &path));
            }
            if sha256 != entry.sha256 {
                return Err(TrainError::damaged("its content differs from its checksum", &path));
            }
        }
        Ok(Self { folder: folder.to_path_buf(), manifest })
    }

    /// The checkpoint's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Where the run stood.
    pub fn state(&self) -> &CheckpointState {
        &self.manifest.state
    }

    /// The file of a part.
    pub fn file(&self, name: &str) -> PathBuf {
        self.folder.join(format!("{name}.safetensors"))
    }

    /// Whether the checkpoint has this part.
    pub fn has(&self, name: &str) -> bool {
        self.manifest.files.contains_key(&format!("{name}.safetensors"))
    }

    /// Loads the part `name` into a module; devices and autodiff settings stay.
    ///
    /// # Errors
    /// [`TrainError::WeightMismatch`] with every difference when the part belongs to another module.
    pub fn module<M: Module>(&self, name: &str, module: M) -> Result<M, TrainError> {
        load_named(module, &self.part(name)?)
    }

    /// As [`CheckpointReader::module`] for the parameters whose path `keep` accepts; the others stay as they are.
    ///
    /// # Errors
    /// As [`CheckpointReader::module`].
    pub fn module_part<M: Module>(&self, name: &str, module: M, keep: Keep) -> Result<M, TrainError> {
        load_part(module, &self.part(name)?, keep)
    }

    /// Loads the part `name` as tensors on a device, without autodiff.
    ///
    /// # Errors
    /// When there is no such part.
    pub fn tensors(&self, name: &str, device: &Device) -> Result<NamedTensors, TrainError> {
        read_tensors(&self.part(name)?, &device.clone().inner())
    }

    /// A small value stored with [`CheckpointWriter::value`].
    ///
    /// # Errors
    /// When there is no such value or it has another type.
    pub fn value<T: DeserializeOwned>(&self, key: &str) -> Result<T, TrainError> {
        let path = self.folder.join(STATE_FILE);
        let value = self.manifest.values.get(key);
        let value = value.ok_or_else(|| TrainError::damaged(format!("it holds no value {key:?}"), &path))?;
        serde_json::from_value(value.clone()).map_err(|why| TrainError::damaged(format!("value {key:?}: {why}"), &path))
    }

    /// The experiment's config text as the part `name` carries it.
    ///
    /// # Errors
    /// When there is no such part or it carries no text.
    pub fn config_text(&self, name: &str) -> Result<String, TrainError> {
        let path = self.part(name)?;
        crate::weights::read_config_text(&path)?.ok_or_else(|| TrainError::damaged("it carries no config text", &path))
    }

    fn part(&self, name: &str) -> Result<PathBuf, TrainError> {
        let path = self.file(name);
        if self.has(name) { Ok(path) } else { Err(TrainError::damaged("the checkpoint has no such part", &path)) }
    }
}
