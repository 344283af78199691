//! The original layout of Stable Diffusion and ControlNet: several networks in one file, each behind a prefix.
//!
//! Source: CompVis/latent-diffusion and lllyasviel/ControlNet, whose networks number their layers one after the other.

use std::collections::BTreeMap;
use std::path::Path;

use nn::weights::{HostTensor, WeightError, WeightFile, write_safetensors};

use super::folder::{Network, load_named};
use super::names::{state_dict_params, state_dict_shapes};
use crate::controlnet::ControlNet;
use crate::unet::{EncoderConfig, UNet2DCondition};
use crate::vae::AutoencoderKL;

/// A network that single files hold.
pub trait SingleFileNetwork: Network {
    /// What stands before all its names.
    const PREFIX: &'static str;

    /// The name after the prefix for one of our state-dict names.
    fn original_name(&self, name: &str) -> String;
}

/// Replaces every parameter by the file's tensor of its original name. Other networks of the file are not looked at.
///
/// # Errors
/// [`WeightError::Mismatch`] with every missing, unexpected (behind this network's prefix) and wrongly shaped name, or what
/// reading gives.
pub fn load_single_file<N: SingleFileNetwork>(network: N, file: &WeightFile) -> Result<N, WeightError> {
    let ours = state_dict_shapes(&network).into_iter();
    let ours: BTreeMap<String, String> =
        ours.map(|(name, _)| (format!("{}{}", N::PREFIX, network.original_name(&name)), name)).collect();
    // Names that stand for nothing keep their own spelling, so that the error lists what is in the file.
    let in_file = file.names().filter(|name| name.starts_with(N::PREFIX));
    let names = in_file.map(|name| (ours.get(name).cloned().unwrap_or_else(|| name.to_owned()), name.to_owned()));
    Ok(load_named(network, file, &names.collect(), &[])?.0)
}

/// A network's tensors under their names in a single file, for [`save_single_file`].
///
/// # Errors
/// [`WeightError::Readback`] when a device fails.
pub fn single_file_tensors<N: SingleFileNetwork>(network: &N) -> Result<Vec<(String, HostTensor)>, WeightError> {
    let renamed = |(name, mut tensor): (String, HostTensor)| {
        if N::was_convolution(&name) && tensor.shape.len() == 2 {
            tensor.shape.extend([1, 1]);
        }
        (format!("{}{}", N::PREFIX, network.original_name(&name)), tensor)
    };
    Ok(state_dict_params(network)?.into_iter().map(renamed).collect())
}

/// Writes the tensors of any number of networks as one file, in f32.
///
/// # Errors
/// [`WeightError`] for a name that occurs twice, or when the file system fails.
pub fn save_single_file(path: impl AsRef<Path>, tensors: &[(String, HostTensor)]) -> Result<(), WeightError> {
    write_safetensors(path, tensors, &BTreeMap::from([("format".to_owned(), "pt".to_owned())]))
}

/// The first two numbers of `rest` as in `i.resnets.j.tail`, the kind between them and the tail.
fn numbered(rest: &str) -> Option<(usize, &str, usize, &str)> {
    let mut parts = rest.splitn(4, '.');
    let level = parts.next()?.parse().ok()?;
    let kind = parts.next()?;
    let index = parts.next()?.parse().ok()?;
    Some((level, kind, index, parts.next()?))
}

/// Layers of a residual block of the UNet.
fn residual(tail: &str) -> String {
    let renames = [
        ("norm1.", "in_layers.0."),
        ("conv1.", "in_layers.2."),
        ("time_emb_proj.", "emb_layers.1."),
        ("norm2.", "out_layers.0."),
        ("conv2.", "out_layers.3."),
        ("conv_shortcut.", "skip_connection."),
    ];
    rename_start(tail, &renames)
}

fn rename_start(name: &str, renames: &[(&str, &str)]) -> String {
    let renamed = renames.iter().find_map(|(ours, theirs)| Some(format!("{theirs}{}", name.strip_prefix(ours)?)));
    renamed.unwrap_or_else(|| name.to_owned())
}

/// Names that UNet and ControlNet share.
fn encoder_name(name: &str, config: &EncoderConfig) -> Option<String> {
    let per_level = config.resnets_per_level + 1;
    if let Some((level, kind, j, tail)) = name.strip_prefix("down_blocks.").and_then(numbered) {
        let first = per_level * level + 1;
        return match kind {
            "resnets" => Some(format!("input_blocks.{}.0.{}", first + j, residual(tail))),
            "attentions" => Some(format!("input_blocks.{}.1.{tail}", first + j)),
            _ => Some(format!("input_blocks.{}.0.{}", per_level * (level + 1), tail.replace("conv.", "op."))),
        };
    }
    if let Some(rest) = name.strip_prefix("mid_block.") {
        let renames = [("resnets.0.", 0), ("attentions.0.", 1), ("resnets.1.", 2)];
        let (place, tail) = renames.iter().find_map(|(ours, place)| Some((place, rest.strip_prefix(ours)?)))?;
        return Some(format!("middle_block.{place}.{}", if *place == 1 { tail.to_owned() } else { residual(tail) }));
    }
    let renames = [
        ("conv_in.", "input_blocks.0.0."),
        ("time_embedding.linear_1.", "time_embed.0."),
        ("time_embedding.linear_2.", "time_embed.2."),
    ];
    renames.iter().find_map(|(ours, theirs)| Some(format!("{theirs}{}", name.strip_prefix(ours)?)))
}

impl SingleFileNetwork for UNet2DCondition {
    const PREFIX: &'static str = "model.diffusion_model.";

    fn original_name(&self, name: &str) -> String {
        let config = &self.config().encoder;
        let per_level = config.resnets_per_level + 1;
        if let Some((level, kind, j, tail)) = name.strip_prefix("up_blocks.").and_then(numbered) {
            let first = per_level * level;
            return match kind {
                "resnets" => format!("output_blocks.{}.0.{}", first + j, residual(tail)),
                "attentions" => format!("output_blocks.{}.1.{tail}", first + j),
                _ => {
                    // Stands behind the residual block and, where there is one, the transformer.
                    let place = 1 + usize::from(config.attention_levels[config.levels() - 1 - level]);
                    format!("output_blocks.{}.{place}.{tail}", first + per_level - 1)
                }
            };
        }
        let encoder = encoder_name(name, config);
        encoder.unwrap_or_else(|| rename_start(name, &[("conv_norm_out.", "out.0."), ("conv_out.", "out.2.")]))
    }
}

impl SingleFileNetwork for ControlNet {
    const PREFIX: &'static str = "control_model.";

    fn original_name(&self, name: &str) -> String {
        let blocks = self.controlnet_cond_embedding.blocks.len();
        if let Some(rest) = name.strip_prefix("controlnet_cond_embedding.") {
            // Every convolution but the last is followed by a SiLU, which has a number too.
            let (place, tail) = match rest.strip_prefix("blocks.").and_then(|rest| rest.split_once('.')) {
                Some((k, tail)) => (2 * (k.parse::<usize>().unwrap_or_default() + 1), tail),
                None => match rest.strip_prefix("conv_in.") {
                    Some(tail) => (0, tail),
                    None => (2 * (blocks + 1), rest.trim_start_matches("conv_out.")),
                },
            };
            return format!("input_hint_block.{place}.{tail}");
        }
        if let Some((index, tail)) = name.strip_prefix("controlnet_down_blocks.").and_then(|rest| rest.split_once('.'))
        {
            return format!("zero_convs.{index}.0.{tail}");
        }
        let encoder = encoder_name(name, &self.config().encoder);
        encoder.unwrap_or_else(|| rename_start(name, &[("controlnet_mid_block.", "middle_block_out.0.")]))
    }
}

impl SingleFileNetwork for AutoencoderKL {
    const PREFIX: &'static str = "first_stage_model.";

    fn original_name(&self, name: &str) -> String {
        let levels = self.config().block_channels.len();
        let Some((side, rest)) = name.split_once('.').filter(|(side, _)| ["encoder", "decoder"].contains(side)) else {
            return name.to_owned();
        };
        let (down, up) = (rest.strip_prefix("down_blocks."), rest.strip_prefix("up_blocks."));
        if let Some((level, kind, j, tail)) = down.or(up).and_then(numbered) {
            // Levels of the decoder count from the finest there.
            let (way, level, resize) =
                if down.is_some() { ("down", level, "downsample") } else { ("up", levels - 1 - level, "upsample") };
            return match kind {
                "resnets" => {
                    format!("{side}.{way}.{level}.block.{j}.{}", tail.replace("conv_shortcut.", "nin_shortcut."))
                }
                _ => format!("{side}.{way}.{level}.{resize}.{tail}"),
            };
        }
        let renames = [
            ("mid_block.resnets.0.", "mid.block_1."),
            ("mid_block.resnets.1.", "mid.block_2."),
            ("mid_block.attentions.0.group_norm.", "mid.attn_1.norm."),
            ("mid_block.attentions.0.to_q.", "mid.attn_1.q."),
            ("mid_block.attentions.0.to_k.", "mid.attn_1.k."),
            ("mid_block.attentions.0.to_v.", "mid.attn_1.v."),
            ("mid_block.attentions.0.to_out.0.", "mid.attn_1.proj_out."),
            ("conv_norm_out.", "norm_out."),
        ];
        format!("{side}.{}", rename_start(rest, &renames))
    }
}
