//! Tensor names of text encoders in released files.
//!
//! Ours are those of transformers' files. Also read: the same without `text_model.`, the text part of single-file
//! checkpoints (`cond_stage_model.`), and OpenCLIP's own names with fused query, key and value matrices.

use std::collections::BTreeMap;

use nn::weights::WeightFile;

/// A tensor of the file that holds one of ours, whole or as one of three equal parts of its first axis.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Stored {
    pub name: String,
    pub third: Option<usize>,
}

/// Where single-file checkpoints keep the text encoder.
const SINGLE_FILE: &str = "cond_stage_model.";

/// Behind [`SINGLE_FILE`], for transformers' and for OpenCLIP's names.
const INNER: [&str; 2] = ["transformer.", "model."];

/// Parts of an OpenCLIP file that make no token states.
const BESIDE: [&str; 5] = ["visual.", "text_projection", "logit_scale", "logit_bias", "attn_mask"];

/// Our names for the tensors of a file; tensors that no encoder needs are left out, unknown ones keep their names. Of
/// OpenCLIP's layers only the first `layers` are taken: Stable Diffusion 2.1 leaves the last one out.
pub(super) fn our_names(file: &WeightFile, layers: usize) -> BTreeMap<String, Stored> {
    let single = file.names().any(|name| name.starts_with(SINGLE_FILE));
    let mut ours = BTreeMap::new();
    for name in file.names() {
        let Some(inner) = (if single { name.strip_prefix(SINGLE_FILE).map(without_inner) } else { Some(name) }) else {
            continue;
        };
        for (our_name, third) in translate(inner, layers) {
            ours.insert(our_name, Stored { name: name.to_owned(), third });
        }
    }
    ours
}

fn without_inner(name: &str) -> &str {
    // OpenCLIP's own names also begin with "transformer."; theirs go on with "resblocks".
    let strip = |prefix: &&str| name.strip_prefix(*prefix).filter(|rest| !rest.starts_with("resblocks."));
    INNER.iter().find_map(strip).unwrap_or(name)
}

fn translate(name: &str, layers: usize) -> Vec<(String, Option<usize>)> {
    let whole = |name: String| vec![(name, None)];
    let bare = name.strip_prefix("text_model.").unwrap_or(name);
    if bare == "embeddings.position_ids" || BESIDE.iter().any(|prefix| bare.starts_with(prefix)) {
        return vec![];
    }
    if let Some(rest) = bare.strip_prefix("transformer.resblocks.") {
        return open_clip_layer(rest, layers).unwrap_or_else(|| whole(name.to_owned()));
    }
    let bare = match bare {
        "token_embedding.weight" => "embeddings.token_embedding.weight",
        "positional_embedding" => "embeddings.position_embedding.weight",
        "ln_final.weight" => "final_layer_norm.weight",
        "ln_final.bias" => "final_layer_norm.bias",
        other => other,
    };
    whole(format!("text_model.{bare}"))
}

fn open_clip_layer(rest: &str, layers: usize) -> Option<Vec<(String, Option<usize>)>> {
    let (index, part) = rest.split_once('.')?;
    if index.parse::<usize>().ok()? >= layers {
        return Some(vec![]);
    }
    let path = |part: &str| format!("text_model.encoder.layers.{index}.{part}");
    if let Some(kind) = part.strip_prefix("attn.in_proj_") {
        let thirds = ["q", "k", "v"].iter().enumerate();
        return Some(thirds.map(|(i, which)| (path(&format!("self_attn.{which}_proj.{kind}")), Some(i))).collect());
    }
    let renamed = [
        ("ln_1.", "layer_norm1."),
        ("ln_2.", "layer_norm2."),
        ("attn.out_proj.", "self_attn.out_proj."),
        ("mlp.c_fc.", "mlp.fc1."),
        ("mlp.c_proj.", "mlp.fc2."),
    ];
    let found = renamed.iter().find_map(|(theirs, ours)| Some((ours, part.strip_prefix(theirs)?)));
    found.map(|(ours, end)| vec![(path(&format!("{ours}{end}")), None)])
}
