//! Names and files of published weights: diffusers' folders and the original single files.
//!
//! A folder holds `config.json` and `diffusion_pytorch_model.safetensors`. A single file holds several networks behind prefixes
//! ([`single_file`]). Both load strictly: every name and shape must fit, nothing may be left over.

mod folder;
mod json;
mod names;
pub mod single_file;

pub use folder::{
    CONFIG_FILE, CROSS_VIEW_MODULES, FolderError, Network, WEIGHTS_FILE, load_folder, load_weights,
    load_weights_beside, open_folder, save_folder,
};
pub use names::{fill_by_state_dict_name, state_dict_name, state_dict_params, state_dict_shapes};
