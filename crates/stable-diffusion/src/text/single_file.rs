//! A text encoder's tensors under the names of single-file checkpoints.

use std::collections::BTreeMap;

use nn::weights::{HostTensor, WeightError};

use super::{Activation, ClipTextModel};
use crate::layout::state_dict_params;

/// Tensors for [`save_single_file`](crate::layout::single_file::save_single_file), in the layout that published checkpoints of this
/// kind of encoder have: transformers' names for OpenAI's encoder (Stable Diffusion 1.5), OpenCLIP's own with fused query, key and
/// value matrices for the other (Stable Diffusion 2.1, without the layer that its UNet never sees).
///
/// # Errors
/// [`WeightError::Readback`] when a device fails.
pub fn text_single_file_tensors(model: &ClipTextModel) -> Result<Vec<(String, HostTensor)>, WeightError> {
    let params = state_dict_params(model)?;
    if model.config().hidden_act == Activation::QuickGelu {
        let renamed = |(name, tensor)| (format!("cond_stage_model.transformer.{name}"), tensor);
        return Ok(params.into_iter().map(renamed).collect());
    }
    let mut parts: BTreeMap<(String, usize), HostTensor> = BTreeMap::new();
    for (name, tensor) in params {
        let third = ["q_proj.", "k_proj.", "v_proj."].iter().position(|which| name.contains(which));
        parts.insert((open_clip_name(&name), third.unwrap_or(0)), tensor);
    }
    let mut whole: BTreeMap<String, HostTensor> = BTreeMap::new();
    for ((name, third), tensor) in parts {
        match whole.get_mut(&name) {
            // Query, key and value lie one below the other.
            Some(above) if third > 0 => {
                above.shape[0] += tensor.shape[0];
                above.data.extend(tensor.data);
            }
            _ => _ = whole.insert(name, tensor),
        }
    }
    Ok(whole.into_iter().map(|(name, tensor)| (format!("cond_stage_model.model.{name}"), tensor)).collect())
}

/// OpenCLIP's name of one of our parameters; query, key and value have one in common.
fn open_clip_name(name: &str) -> String {
    let name = name.strip_prefix("text_model.").unwrap_or(name);
    let renames = [
        ("encoder.layers.", "transformer.resblocks."),
        ("embeddings.token_embedding.", "token_embedding."),
        ("embeddings.position_embedding.weight", "positional_embedding"),
        ("final_layer_norm.", "ln_final."),
        ("layer_norm1.", "ln_1."),
        ("layer_norm2.", "ln_2."),
        ("self_attn.out_proj.", "attn.out_proj."),
        ("self_attn.q_proj.", "attn.in_proj_"),
        ("self_attn.k_proj.", "attn.in_proj_"),
        ("self_attn.v_proj.", "attn.in_proj_"),
        ("mlp.fc1.", "mlp.c_fc."),
        ("mlp.fc2.", "mlp.c_proj."),
    ];
    renames.iter().fold(name.to_owned(), |name, (ours, theirs)| name.replace(ours, theirs))
}
