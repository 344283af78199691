//! Paths of our parameters and the names that diffusers gives them.

use burn::module::Module;
use nn::weights::{HostTensor, WeightError, fill_some_params, named_params, param_shapes};

/// Path segments that diffusers spells otherwise.
const RENAMED: [(&str, &str); 5] = [
    ("to_out", "to_out.0"),
    ("expand", "net.0.proj"),
    ("contract", "net.2"),
    ("downsampler", "downsamplers.0"),
    ("upsampler", "upsamplers.0"),
];

/// Path segments of ours that group parameters which lie side by side in a state dict.
const GROUPING: [&str; 2] = ["attention", "cross_view"];

/// The state-dict name of one of our parameter paths.
#[must_use]
pub fn state_dict_name(path: &str) -> String {
    // Variants of an enum stand in a path with a capital letter; a state dict has no such level.
    let is_level = |segment: &&str| !GROUPING.contains(segment) && !segment.starts_with(char::is_uppercase);
    let rename = |segment| RENAMED.iter().find(|(ours, _)| *ours == segment).map_or(segment, |(_, theirs)| *theirs);
    path.split('.').filter(is_level).map(rename).collect::<Vec<_>>().join(".")
}

/// Adapters lie beside the weights they adapt; they have files of their own ([`nn::lora::save`]).
fn is_base<T>((path, _): &(String, T)) -> bool {
    path.split('.').all(|segment| segment != "lora")
}

/// State-dict names and shapes of all parameters but adapters, without touching their values.
#[must_use]
pub fn state_dict_shapes<M: Module>(module: &M) -> Vec<(String, Vec<usize>)> {
    let base = param_shapes(module).into_iter().filter(is_base);
    base.map(|(path, shape)| (state_dict_name(&path), shape)).collect()
}

/// All parameters but adapters under their state-dict names.
///
/// # Errors
/// [`WeightError::Readback`] when a device fails.
pub fn state_dict_params<M: Module>(module: &M) -> Result<Vec<(String, HostTensor)>, WeightError> {
    let base = named_params(module)?.into_iter().filter(is_base);
    Ok(base.map(|(path, tensor)| (state_dict_name(&path), tensor)).collect())
}

/// Replaces every parameter by the values that `values(state-dict name, shape)` returns for it, if any.
///
/// # Errors
/// As [`fill_some_params`].
pub fn fill_by_state_dict_name<M: Module>(
    module: M,
    mut values: impl FnMut(&str, &[usize]) -> Result<Option<Vec<f32>>, WeightError>,
) -> Result<M, WeightError> {
    fill_some_params(module, |path, shape| values(&state_dict_name(path), shape))
}
