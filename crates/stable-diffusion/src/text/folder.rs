//! The folders `tokenizer/` and `text_encoder/` of a pipeline.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use nn::Init;
use nn::weights::{HostTensor, Mismatch, WeightError, WeightFile, write_safetensors, write_text};
use serde::Deserialize;
use serde_json::{Value, json};

use super::names::{Stored, our_names};
use super::{Activation, BytePairs, ClipTextConfig, ClipTextModel, ClipTokenizer, Padding};
use super::{TextCleaning, TextError, TextOutput};
use crate::layout::{fill_by_state_dict_name, state_dict_params, state_dict_shapes};

/// Files that may hold the weights, in order of preference.
const WEIGHT_FILES: [&str; 2] = ["model.safetensors", "model.fp16.safetensors"];

/// Where a tokenizer's folder may name its padding. The first wins: published folders of Stable Diffusion 2.1 hold
/// another one in the second.
const PADDING_FILES: [&str; 2] = ["special_tokens_map.json", "tokenizer_config.json"];

const TOKENIZER: &str = "tokenizer";

const TEXT_ENCODER: &str = "text_encoder";

/// Tokenizer and text encoder of a pipeline's folder, which must fit each other.
///
/// # Errors
/// [`TextError`]: see [`load_tokenizer`] and [`load_text_encoder`].
pub fn load_clip(root: &Path, device: &Device) -> Result<(ClipTokenizer, ClipTextModel), TextError> {
    let tokenizer = load_tokenizer(&root.join(TOKENIZER))?;
    let model = load_text_encoder(&root.join(TEXT_ENCODER), device)?;
    let (tokens, rows) = (tokenizer.pairs.vocabulary_size(), model.config().vocab_size);
    if tokens > rows {
        let reason = format!("the tokenizer has {tokens} tokens, the text encoder {rows}");
        return Err(TextError::Format { reason, path: root.to_path_buf() });
    }
    Ok((tokenizer.with_context(model.config().max_position_embeddings), model))
}

/// A tokenizer from its folder: `vocab.json`, `merges.txt`, and the padding from `special_tokens_map.json` or
/// `tokenizer_config.json` (the end token without either).
///
/// # Errors
/// [`TextError`] for files that cannot be read, or padding with a token other than the end token and number 0.
pub fn load_tokenizer(folder: &Path) -> Result<ClipTokenizer, TextError> {
    let pairs = BytePairs::from_folder(folder)?;
    let padding = read_padding(folder, &pairs)?;
    Ok(ClipTokenizer::new(pairs, TextCleaning::default(), padding))
}

fn read_padding(folder: &Path, pairs: &BytePairs) -> Result<Padding, TextError> {
    for path in PADDING_FILES.map(|name| folder.join(name)) {
        if !path.exists() {
            continue;
        }
        let entries: Value = read_json(&path)?;
        // A text, or an object that describes the token.
        let token = &entries["pad_token"];
        if let Some(token) = token.as_str().or_else(|| token["content"].as_str()) {
            let [_, end] = pairs.marks();
            return match pairs.id(token) {
                Some(id) if id == end => Ok(Padding::EndToken),
                Some(0) => Ok(Padding::Zero),
                _ => Err(TextError::Format { reason: format!("padding with {token:?} is not supported"), path }),
            };
        }
    }
    Ok(Padding::EndToken)
}

/// A text encoder from its folder: `config.json` and `model.safetensors` (or `model.fp16.safetensors`).
///
/// # Errors
/// [`TextError`] for files that cannot be read, sizes or activations that are not supported, weights that do not fit.
pub fn load_text_encoder(folder: &Path, device: &Device) -> Result<ClipTextModel, TextError> {
    let config = read_config(&folder.join("config.json"))?;
    let path = WEIGHT_FILES.map(|name| folder.join(name)).into_iter().find(|path| path.exists());
    let path = path.ok_or_else(|| TextError::Format {
        reason: format!("holds neither {}", WEIGHT_FILES.join(" nor ")),
        path: folder.to_path_buf(),
    })?;
    let model = ClipTextModel::new(&config, &mut Init::lazy(0, device));
    Ok(load_text_weights(model, &WeightFile::open(&path)?)?)
}

/// The sizes in a `config.json`; entries that change nothing here are not looked at.
#[derive(Deserialize)]
struct ConfigFile {
    vocab_size: usize,
    hidden_size: usize,
    intermediate_size: usize,
    num_hidden_layers: usize,
    num_attention_heads: usize,
    max_position_embeddings: usize,
    hidden_act: Activation,
    #[serde(default = "usual_epsilon")]
    layer_norm_eps: f64,
    projection_dim: Option<usize>,
    #[serde(default)]
    output: TextOutput,
}

fn usual_epsilon() -> f64 {
    1e-5
}

fn read_config(path: &Path) -> Result<ClipTextConfig, TextError> {
    let file: ConfigFile = read_json(path)?;
    let config = ClipTextConfig {
        vocab_size: file.vocab_size,
        hidden_size: file.hidden_size,
        intermediate_size: file.intermediate_size,
        num_hidden_layers: file.num_hidden_layers,
        num_attention_heads: file.num_attention_heads,
        max_position_embeddings: file.max_position_embeddings,
        hidden_act: file.hidden_act,
        layer_norm_eps: file.layer_norm_eps,
        projection_dim: file.projection_dim.unwrap_or(file.hidden_size),
        output: file.output,
    };
    config.checked().map_err(|error| TextError::Format { reason: error.to_string(), path: path.to_path_buf() })
}

/// Replaces every parameter by the file's; f16 and bf16 are widened. Names may be transformers' with or without
/// `text_model.`, those of a single-file checkpoint, or OpenCLIP's own.
///
/// # Errors
/// [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name, or what reading gives.
pub fn load_text_weights(model: ClipTextModel, file: &WeightFile) -> Result<ClipTextModel, WeightError> {
    let names = our_names(file, model.config().num_hidden_layers);
    let wanted = state_dict_shapes(&model).into_iter().collect();
    let found = names.iter().map(|(ours, stored)| (ours.clone(), stored_shape(file, stored))).collect();
    let mismatch = Mismatch::between(&wanted, &found);
    if !mismatch.is_empty() {
        return Err(WeightError::Mismatch(Box::new(mismatch)).in_file(file.path()));
    }
    fill_by_state_dict_name(model, |name, _| match names.get(name) {
        Some(stored) => Ok(Some(part(file.tensor(&stored.name)?, stored.third))),
        None => Ok(None),
    })
}

fn stored_shape(file: &WeightFile, stored: &Stored) -> Vec<usize> {
    let mut shape = file.shape(&stored.name).unwrap_or_default().to_vec();
    if let (Some(_), Some(rows)) = (stored.third, shape.first_mut()) {
        // A first axis that is no multiple of three keeps its length, so that the shapes differ.
        *rows = if rows.is_multiple_of(3) { *rows / 3 } else { *rows };
    }
    shape
}

fn part(tensor: HostTensor, third: Option<usize>) -> Vec<f32> {
    match third {
        None => tensor.data,
        Some(index) => {
            let length = tensor.data.len() / 3;
            tensor.data.into_iter().skip(index * length).take(length).collect()
        }
    }
}

/// Writes both folders below `root`, created when absent; weights in f32.
///
/// # Errors
/// [`TextError`] when a device or the file system fails.
pub fn save_clip(root: &Path, tokenizer: &ClipTokenizer, model: &ClipTextModel) -> Result<(), TextError> {
    let folder = create(root.join(TOKENIZER))?;
    for (name, text) in tokenizer.pairs.to_files() {
        write(&folder.join(name), &text)?;
    }
    let pad = match tokenizer.padding {
        Padding::EndToken => "<|endoftext|>",
        Padding::Zero => "!",
    };
    let marks = json!({
        "bos_token": "<|startoftext|>",
        "eos_token": "<|endoftext|>",
        "pad_token": pad,
        "unk_token": "<|endoftext|>",
    });
    write(&folder.join(PADDING_FILES[0]), &format!("{marks:#}\n"))?;
    let mut settings = marks;
    settings["model_max_length"] = json!(model.config().max_position_embeddings);
    settings["tokenizer_class"] = json!("CLIPTokenizer");
    write(&folder.join(PADDING_FILES[1]), &format!("{settings:#}\n"))?;

    let folder = create(root.join(TEXT_ENCODER))?;
    // Readers of other houses ask for this entry.
    let metadata = BTreeMap::from([("format".to_owned(), "pt".to_owned())]);
    write_safetensors(folder.join(WEIGHT_FILES[0]), &state_dict_params(model)?, &metadata)?;
    let config = serde_json::to_value(model.config()).map_err(|error| TextError::Sizes(error.to_string()))?;
    let config = with_class(config);
    write(&folder.join("config.json"), &format!("{config:#}\n"))
}

/// Adds what other tools ask for. The ids are those of published files; other tools take them for "the largest id".
fn with_class(mut config: Value) -> Value {
    config["architectures"] = json!(["CLIPTextModel"]);
    config["model_type"] = json!("clip_text_model");
    config["bos_token_id"] = json!(0);
    config["eos_token_id"] = json!(2);
    config["pad_token_id"] = json!(1);
    config
}

fn create(folder: PathBuf) -> Result<PathBuf, TextError> {
    match std::fs::create_dir_all(&folder) {
        Ok(()) => Ok(folder),
        Err(source) => Err(TextError::Io { source, path: folder }),
    }
}

fn write(path: &Path, text: &str) -> Result<(), TextError> {
    write_text(path, text).map_err(|source| TextError::Io { source, path: path.to_path_buf() })
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, TextError> {
    let bytes = std::fs::read(path).map_err(|source| TextError::Io { source, path: path.to_path_buf() })?;
    let refuse = |error: serde_json::Error| TextError::Format { reason: error.to_string(), path: path.to_path_buf() };
    serde_json::from_slice(&bytes).map_err(refuse)
}
