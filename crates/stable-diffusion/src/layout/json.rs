//! diffusers' `config.json` for our configs and back.
//!
//! Reading takes the sizes, builds the JSON that we would write for them and compares the rest: an entry that asks for
//! something else is an error, so that no file is read as a network it does not describe.

use serde::Deserialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value, json};

use crate::config::ConfigError;
use crate::controlnet::ControlNetConfig;
use crate::cross_view::NeighbourMerge;
use crate::panels::Panels;
use crate::unet::{AttentionHeads, EncoderConfig, ProjectionKind, UNetConfig};
use crate::vae::VaeConfig;

/// The scale of files that name none: older tools did not write that of Stable Diffusion.
const DEFAULT_SCALE: f64 = 0.18215;

/// Why a `config.json` describes no network of ours.
#[derive(Debug, thiserror::Error)]
pub(super) enum JsonError {
    #[error("{0}")]
    Syntax(#[from] serde_json::Error),
    #[error("{0}")]
    Sizes(#[from] ConfigError),
    #[error("{key} is {found}, only {supported} is supported")]
    Unsupported { key: String, found: Value, supported: Value },
    #[error("unknown entry {key} = {found}")]
    Unknown { key: String, found: Value },
}

type JsonMap = Map<String, Value>;

/// Entries that change nothing that is computed in f32, or that describe other things than the network.
const INFORMATIVE: [&str; 4] =
    ["sample_size", "upcast_attention", "force_upcast", "controlnet_conditioning_channel_order"];

/// Refuses entries of `found` that differ from what we would write. `read` are those that may be spelled in several ways.
fn compare(found: &JsonMap, written: &JsonMap, read: &[&str]) -> Result<(), JsonError> {
    for (key, value) in found {
        if key.starts_with('_') && key != "_class_name" || INFORMATIVE.contains(&key.as_str()) {
            continue;
        }
        match written.get(key) {
            _ if read.contains(&key.as_str()) => {}
            // Newer tools may know more settings; those that are off are off.
            None if value.is_null() => {}
            None => return Err(JsonError::Unknown { key: key.clone(), found: value.clone() }),
            Some(ours) if same(ours, value) => {}
            Some(ours) => {
                let (found, supported) = (value.clone(), ours.clone());
                return Err(JsonError::Unsupported { key: key.clone(), found, supported });
            }
        }
    }
    Ok(())
}

/// Equality that does not tell 1 from 1.0.
fn same(a: &Value, b: &Value) -> bool {
    match (a.as_f64(), b.as_f64()) {
        (Some(a), Some(b)) => a == b,
        _ => a == b,
    }
}

fn object(value: Value) -> JsonMap {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

fn fields<T: DeserializeOwned>(map: &JsonMap) -> Result<T, JsonError> {
    Ok(T::deserialize(Value::Object(map.clone()))?)
}

#[derive(Deserialize)]
struct VaeFields {
    block_out_channels: Vec<usize>,
    layers_per_block: usize,
    latent_channels: usize,
    norm_num_groups: usize,
    scaling_factor: Option<f64>,
    sample_size: Option<usize>,
}

/// The autoencoder that a `config.json` describes.
pub(super) fn read_vae(map: &JsonMap) -> Result<VaeConfig, JsonError> {
    let f: VaeFields = fields(map)?;
    let config = VaeConfig {
        block_channels: f.block_out_channels,
        resnets_per_level: f.layers_per_block,
        norm_groups: f.norm_num_groups,
        latent_channels: f.latent_channels,
        scaling_factor: f.scaling_factor.unwrap_or(DEFAULT_SCALE),
        sample_size: f.sample_size,
    };
    let config = config.checked()?;
    compare(map, &write_vae(&config), &["scaling_factor"])?;
    Ok(config)
}

/// The `config.json` of an autoencoder.
pub(super) fn write_vae(config: &VaeConfig) -> JsonMap {
    let levels = config.block_channels.len();
    object(json!({
        "_class_name": "AutoencoderKL",
        "act_fn": "silu",
        "block_out_channels": config.block_channels,
        "down_block_types": vec!["DownEncoderBlock2D"; levels],
        "force_upcast": true,
        "in_channels": 3,
        "latent_channels": config.latent_channels,
        "latents_mean": null,
        "latents_std": null,
        "layers_per_block": config.resnets_per_level,
        "mid_block_add_attention": true,
        "norm_num_groups": config.norm_groups,
        "out_channels": 3,
        "sample_size": config.sample_size.unwrap_or(32),
        "scaling_factor": config.scaling_factor,
        "shift_factor": null,
        "up_block_types": vec!["UpDecoderBlock2D"; levels],
        "use_post_quant_conv": true,
        "use_quant_conv": true,
    }))
}

/// A number for all levels, or one per level.
#[derive(Deserialize)]
#[serde(untagged)]
enum PerLevel {
    All(usize),
    Each(Vec<usize>),
}

#[derive(Deserialize)]
struct EncoderFields {
    in_channels: usize,
    block_out_channels: Vec<usize>,
    down_block_types: Vec<String>,
    layers_per_block: usize,
    /// Holds the number of heads, whatever its name says.
    attention_head_dim: PerLevel,
    cross_attention_dim: usize,
    norm_num_groups: usize,
    #[serde(default)]
    use_linear_projection: bool,
    cross_view: Option<NeighbourMerge>,
    #[serde(default)]
    panels: Panels,
}

/// Entries of the encoder that have more than one spelling.
const SPELLED: [&str; 1] = ["attention_head_dim"];

fn read_encoder(map: &JsonMap) -> Result<EncoderConfig, JsonError> {
    let f: EncoderFields = fields(map)?;
    let heads = match f.attention_head_dim {
        PerLevel::All(count) => vec![count; f.block_out_channels.len()],
        PerLevel::Each(counts) => counts,
    };
    let projection = if f.use_linear_projection { ProjectionKind::Linear } else { ProjectionKind::Convolution };
    let config = EncoderConfig {
        in_channels: f.in_channels,
        // Other block types are found by the comparison with what we would write.
        attention_levels: f.down_block_types.iter().map(|kind| kind == ATTENTION_DOWN).collect(),
        block_channels: f.block_out_channels,
        resnets_per_level: f.layers_per_block,
        heads: AttentionHeads::Count(heads),
        context_width: f.cross_attention_dim,
        norm_groups: f.norm_num_groups,
        projection,
        cross_view: f.cross_view,
        panels: f.panels,
    };
    config.check()?;
    Ok(config)
}

const ATTENTION_DOWN: &str = "CrossAttnDownBlock2D";

fn write_encoder(config: &EncoderConfig) -> JsonMap {
    let heads: Vec<usize> = (0..config.levels()).map(|level| config.heads_of(level)).collect();
    let equal = heads.iter().all(|count| *count == heads[0]);
    let kinds = config.attention_levels.iter().map(|a| if *a { ATTENTION_DOWN } else { "DownBlock2D" });
    let mut map = object(json!({
        "act_fn": "silu",
        "addition_embed_type": null,
        "addition_embed_type_num_heads": 64,
        "addition_time_embed_dim": null,
        "attention_head_dim": if equal { json!(heads[0]) } else { json!(heads) },
        "block_out_channels": config.block_channels,
        "class_embed_type": null,
        "cross_attention_dim": config.context_width,
        "down_block_types": kinds.collect::<Vec<_>>(),
        "downsample_padding": 1,
        "encoder_hid_dim": null,
        "encoder_hid_dim_type": null,
        "flip_sin_to_cos": true,
        "freq_shift": 0,
        "in_channels": config.in_channels,
        "layers_per_block": config.resnets_per_level,
        "mid_block_scale_factor": 1,
        "mid_block_type": "UNetMidBlock2DCrossAttn",
        "norm_eps": 1e-5,
        "norm_num_groups": config.norm_groups,
        "num_attention_heads": null,
        "num_class_embeds": null,
        "only_cross_attention": false,
        "projection_class_embeddings_input_dim": null,
        "resnet_time_scale_shift": "default",
        "transformer_layers_per_block": 1,
        "upcast_attention": false,
        "use_linear_projection": config.projection == ProjectionKind::Linear,
    }));
    if let Some(merge) = config.cross_view {
        map.insert("cross_view".to_owned(), json!(merge));
    }
    if config.panels != Panels::default() {
        map.insert("panels".to_owned(), json!(config.panels));
    }
    map
}

#[derive(Deserialize)]
struct UNetFields {
    out_channels: usize,
    sample_size: Option<usize>,
}

/// The UNet that a `config.json` describes.
pub(super) fn read_unet(map: &JsonMap) -> Result<UNetConfig, JsonError> {
    let f: UNetFields = fields(map)?;
    let config = UNetConfig { encoder: read_encoder(map)?, out_channels: f.out_channels, sample_size: f.sample_size };
    let config = config.checked()?;
    compare(map, &write_unet(&config), &SPELLED)?;
    Ok(config)
}

/// The `config.json` of a UNet.
pub(super) fn write_unet(config: &UNetConfig) -> JsonMap {
    let kinds = config.encoder.attention_levels.iter().rev();
    let kinds = kinds.map(|a| if *a { "CrossAttnUpBlock2D" } else { "UpBlock2D" });
    let mut map = write_encoder(&config.encoder);
    map.extend(object(json!({
        "_class_name": "UNet2DConditionModel",
        "attention_type": "default",
        "center_input_sample": false,
        "class_embeddings_concat": false,
        "conv_in_kernel": 3,
        "conv_out_kernel": 3,
        "cross_attention_norm": null,
        "dropout": 0.0,
        "dual_cross_attention": false,
        "mid_block_only_cross_attention": null,
        "out_channels": config.out_channels,
        "resnet_out_scale_factor": 1.0,
        "resnet_skip_time_act": false,
        "reverse_transformer_layers_per_block": null,
        "sample_size": config.sample_size,
        "time_cond_proj_dim": null,
        "time_embedding_act_fn": null,
        "time_embedding_dim": null,
        "time_embedding_type": "positional",
        "timestep_post_act": null,
        "up_block_types": kinds.collect::<Vec<_>>(),
    })));
    map
}

#[derive(Deserialize)]
struct ControlFields {
    #[serde(default = "three")]
    conditioning_channels: usize,
    conditioning_embedding_out_channels: Vec<usize>,
}

/// Older files do not say that their condition is a picture in colours.
fn three() -> usize {
    3
}

/// The ControlNet that a `config.json` describes.
pub(super) fn read_controlnet(map: &JsonMap) -> Result<ControlNetConfig, JsonError> {
    let f: ControlFields = fields(map)?;
    let config = ControlNetConfig {
        encoder: read_encoder(map)?,
        condition_channels: f.conditioning_channels,
        embedding_channels: f.conditioning_embedding_out_channels,
    };
    let config = config.checked()?;
    compare(map, &write_controlnet(&config), &SPELLED)?;
    Ok(config)
}

/// The `config.json` of a ControlNet.
pub(super) fn write_controlnet(config: &ControlNetConfig) -> JsonMap {
    let mut map = write_encoder(&config.encoder);
    map.extend(object(json!({
        "_class_name": "ControlNetModel",
        "conditioning_channels": config.condition_channels,
        "conditioning_embedding_out_channels": config.embedding_channels,
        "controlnet_conditioning_channel_order": "rgb",
        "global_pool_conditions": false,
    })));
    map
}
