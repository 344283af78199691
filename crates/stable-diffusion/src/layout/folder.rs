//! A network's folder: `config.json` beside `diffusion_pytorch_model.safetensors`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use nn::Init;
use nn::weights::{Mismatch, WeightError, WeightFile, write_safetensors, write_text};
use serde_json::{Map, Value};

use super::json;
use super::names::{fill_by_state_dict_name, state_dict_params, state_dict_shapes};
use crate::controlnet::{ControlNet, ControlNetConfig};
use crate::unet::{UNet2DCondition, UNetConfig};
use crate::vae::{AutoencoderKL, VaeConfig};

/// Sizes of the network.
pub const CONFIG_FILE: &str = "config.json";

/// Weights of the network.
pub const WEIGHTS_FILE: &str = "diffusion_pytorch_model.safetensors";

/// Files that may hold the weights, in order of preference; the last two are torch's own.
const READ_FILES: [&str; 4] = [
    WEIGHTS_FILE,
    "diffusion_pytorch_model.fp16.safetensors",
    "diffusion_pytorch_model.bin",
    "diffusion_pytorch_model.fp16.bin",
];

/// Modules of cross-view attention, for [`load_weights_beside`].
pub const CROSS_VIEW_MODULES: [&str; 3] = ["norm4", "attn4", "connector"];

/// Why a folder was not read or written. The path stands last.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The operating system refused.
    #[error("{source}: {}", path.display())]
    Io {
        /// What the system said.
        source: std::io::Error,
        /// The file or folder.
        path: PathBuf,
    },
    /// The config is no JSON, or describes a network that is not supported.
    #[error("{reason}: {}", path.display())]
    Config {
        /// What is wrong.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// The weights cannot be read or do not fit the config.
    #[error(transparent)]
    Weights(#[from] WeightError),
}

/// A network that has a folder layout.
pub trait Network: Module {
    /// Its sizes.
    type Config: Clone;

    /// Fresh weights for checked sizes.
    fn build(config: &Self::Config, init: &mut Init) -> Self;

    /// What it was built from.
    fn sizes(&self) -> &Self::Config;

    /// Sizes from the entries of a `config.json`.
    ///
    /// # Errors
    /// A text that names the entry.
    fn config_from_json(map: &Map<String, Value>) -> Result<Self::Config, String>;

    /// The entries of a `config.json`.
    fn config_to_json(config: &Self::Config) -> Map<String, Value>;

    /// The name of ours that stands for `name` in older files.
    fn current_name(name: &str) -> String {
        name.to_owned()
    }

    /// Whether older files store this matrix as a 1×1 convolution.
    fn was_convolution(_name: &str) -> bool {
        false
    }
}

impl Network for AutoencoderKL {
    type Config = VaeConfig;

    fn build(config: &VaeConfig, init: &mut Init) -> Self {
        Self::new(config, init)
    }

    fn sizes(&self) -> &VaeConfig {
        self.config()
    }

    fn config_from_json(map: &Map<String, Value>) -> Result<VaeConfig, String> {
        json::read_vae(map).map_err(|error| error.to_string())
    }

    fn config_to_json(config: &VaeConfig) -> Map<String, Value> {
        json::write_vae(config)
    }

    fn current_name(name: &str) -> String {
        let renames = [("query", "to_q"), ("key", "to_k"), ("value", "to_v"), ("proj_attn", "to_out.0")];
        let rename = |segment| renames.iter().find(|(old, _)| *old == segment).map_or(segment, |(_, new)| *new);
        name.split('.').map(rename).collect::<Vec<_>>().join(".")
    }

    fn was_convolution(name: &str) -> bool {
        name.contains(".attentions.") && !name.contains(".group_norm.") && name.ends_with(".weight")
    }
}

impl Network for UNet2DCondition {
    type Config = UNetConfig;

    fn build(config: &UNetConfig, init: &mut Init) -> Self {
        Self::new(config, init)
    }

    fn sizes(&self) -> &UNetConfig {
        self.config()
    }

    fn config_from_json(map: &Map<String, Value>) -> Result<UNetConfig, String> {
        json::read_unet(map).map_err(|error| error.to_string())
    }

    fn config_to_json(config: &UNetConfig) -> Map<String, Value> {
        json::write_unet(config)
    }
}

impl Network for ControlNet {
    type Config = ControlNetConfig;

    fn build(config: &ControlNetConfig, init: &mut Init) -> Self {
        Self::new(config, init)
    }

    fn sizes(&self) -> &ControlNetConfig {
        self.config()
    }

    fn config_from_json(map: &Map<String, Value>) -> Result<ControlNetConfig, String> {
        json::read_controlnet(map).map_err(|error| error.to_string())
    }

    fn config_to_json(config: &ControlNetConfig) -> Map<String, Value> {
        json::write_controlnet(config)
    }
}

/// Builds a network from its folder.
///
/// # Errors
/// [`FolderError`]: unreadable files, unsupported config entries, weights that do not fit.
pub fn load_folder<N: Network>(folder: impl AsRef<Path>, device: &Device) -> Result<N, FolderError> {
    let (config, file) = open_folder::<N>(folder)?;
    // First values would only be replaced; and no memory is taken before the file's shapes are known to be the config's.
    Ok(load_weights(N::build(&config, &mut Init::lazy(0, device)), &file)?)
}

/// Sizes and weight file of a network's folder.
///
/// # Errors
/// [`FolderError`]: unreadable files, unsupported config entries.
pub fn open_folder<N: Network>(folder: impl AsRef<Path>) -> Result<(N::Config, WeightFile), FolderError> {
    let folder = folder.as_ref();
    let config = read_config::<N>(&folder.join(CONFIG_FILE))?;
    let found = READ_FILES.map(|name| folder.join(name)).into_iter().find(|path| path.exists());
    Ok((config, WeightFile::open(found.unwrap_or_else(|| folder.join(WEIGHTS_FILE)))?))
}

fn read_config<N: Network>(path: &Path) -> Result<N::Config, FolderError> {
    let bytes = std::fs::read(path).map_err(|source| FolderError::Io { source, path: path.to_path_buf() })?;
    let refuse = |reason: String| FolderError::Config { reason, path: path.to_path_buf() };
    let map: Map<String, Value> = serde_json::from_slice(&bytes).map_err(|error| refuse(error.to_string()))?;
    N::config_from_json(&map).map_err(refuse)
}

/// Replaces every parameter by the file's tensor of its state-dict name; f16 and bf16 are widened.
///
/// # Errors
/// [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name, or what reading gives.
pub fn load_weights<N: Network>(network: N, file: &WeightFile) -> Result<N, WeightError> {
    Ok(load_weights_beside(network, file, &[])?.0)
}

/// As [`load_weights`], for a network that has more modules than the file's: parameters with one of `new_modules` in their
/// path (such as [`CROSS_VIEW_MODULES`]) keep their first values when the file lacks them. Returns their names too.
///
/// # Errors
/// As [`load_weights`]; a parameter of any other module may not be missing.
pub fn load_weights_beside<N: Network>(
    network: N,
    file: &WeightFile,
    new_modules: &[&str],
) -> Result<(N, Vec<String>), WeightError> {
    let names = file.names().map(|name| (N::current_name(name), name.to_owned())).collect();
    load_named(network, file, &names, new_modules)
}

/// Loads, given the file's name for each state-dict name.
pub(super) fn load_named<N: Network>(
    network: N,
    file: &WeightFile,
    names: &BTreeMap<String, String>,
    new_modules: &[&str],
) -> Result<(N, Vec<String>), WeightError> {
    let wanted: BTreeMap<_, _> = state_dict_shapes(&network).into_iter().collect();
    let shape = |ours: &str, theirs: &str| {
        let found = file.shape(theirs).unwrap_or_default();
        match (wanted.get(ours).map(Vec::as_slice), found) {
            (Some([rows, columns]), [r, c, 1, 1]) if N::was_convolution(ours) && (rows, columns) == (r, c) => {
                vec![*r, *c]
            }
            _ => found.to_vec(),
        }
    };
    let found = names.iter().map(|(ours, theirs)| (ours.clone(), shape(ours, theirs))).collect();
    let mut mismatch = Mismatch::between(&wanted, &found);
    let is_new = |(name, _): &mut (String, Vec<usize>)| name.split('.').any(|segment| new_modules.contains(&segment));
    let kept: Vec<String> = mismatch.missing.extract_if(.., is_new).map(|(name, _)| name).collect();
    if !mismatch.is_empty() {
        return Err(WeightError::Mismatch(Box::new(mismatch)).in_file(file.path()));
    }
    let network = fill_by_state_dict_name(network, |name, _| match names.get(name) {
        Some(name) => Ok(Some(file.tensor(name)?.data)),
        None => Ok(None),
    })?;
    Ok((network, kept))
}

/// Writes a network's folder, created when absent; weights in f32.
///
/// # Errors
/// [`FolderError`] when a device or the file system fails.
pub fn save_folder<N: Network>(network: &N, folder: impl AsRef<Path>) -> Result<(), FolderError> {
    let folder = folder.as_ref();
    let io = |path: &Path| {
        let path = path.to_path_buf();
        move |source| FolderError::Io { source, path }
    };
    std::fs::create_dir_all(folder).map_err(io(folder))?;
    // Readers of other houses ask for this entry.
    let metadata = BTreeMap::from([("format".to_owned(), "pt".to_owned())]);
    write_safetensors(folder.join(WEIGHTS_FILE), &state_dict_params(network)?, &metadata)?;
    let path = folder.join(CONFIG_FILE);
    let text = format!("{:#}\n", Value::Object(N::config_to_json(network.sizes())));
    write_text(&path, &text).map_err(io(&path))
}
