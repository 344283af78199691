//! Weight files of text encoders: layouts, precisions, differences, round trips.

use std::collections::BTreeMap;
use std::path::Path;

use half::{bf16, f16};
use nn::Init;
use nn::weights::{HostTensor, WeightError, WeightFile, named_params, write_safetensors};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, serialize_to_file};
use serde_json::{Value, json};
use stable_diffusion::layout::single_file::save_single_file;
use stable_diffusion::text::{
    Activation, ClipTextConfig, ClipTextModel, ClipTokenizer, Padding, TextCleaning, TextError, TextOutput, TokenBatch,
    load_clip, load_text_encoder, load_text_weights, save_clip, text_single_file_tensors,
};

use super::reference::{device, golden_weights, table, values, write_folder};

fn small_config() -> ClipTextConfig {
    ClipTextConfig {
        vocab_size: 50,
        hidden_size: 8,
        intermediate_size: 12,
        num_hidden_layers: 2,
        num_attention_heads: 2,
        max_position_embeddings: 7,
        hidden_act: Activation::Gelu,
        layer_norm_eps: 1e-5,
        projection_dim: 8,
        output: TextOutput::Last,
    }
}

fn small_model(seed: u64) -> ClipTextModel {
    ClipTextModel::new(&small_config(), &mut Init::new(seed, &device()))
}

fn small_weights() -> BTreeMap<String, HostTensor> {
    golden_weights(&nn::weights::param_shapes(&small_model(0)))
}

fn tokens() -> TokenBatch {
    TokenBatch::new(vec![1, 5, 7, 49, 49, 49, 49, 1, 2, 3, 4, 5, 6, 49], 7, 49)
}

fn states(model: &ClipTextModel) -> Vec<f32> {
    values(model.forward(&tokens()).states)
}

fn config_json() -> Value {
    serde_json::to_value(small_config()).unwrap()
}

fn load_written(tensors: &BTreeMap<String, HostTensor>, folder: &Path) -> Result<ClipTextModel, WeightError> {
    let path = folder.join("w.safetensors");
    let tensors: Vec<_> = tensors.iter().map(|(name, tensor)| (name.clone(), tensor.clone())).collect();
    write_safetensors(&path, &tensors, &BTreeMap::new()).unwrap();
    load_text_weights(small_model(1), &WeightFile::open(&path).unwrap())
}

#[test]
fn prefixes_and_buffers_do_not_matter() {
    let folder = tempfile::tempdir().unwrap();
    let weights = small_weights();
    let want = states(&load_written(&weights, folder.path()).unwrap());
    assert_ne!(want, states(&small_model(1)));
    let bare = weights.iter().map(|(name, t)| (name.replace("text_model.", ""), t.clone()));
    let with_buffer = bare.chain([("embeddings.position_ids".to_owned(), HostTensor::new(&[1, 7], vec![0.0; 7]))]);
    assert_eq!(states(&load_written(&with_buffer.collect(), folder.path()).unwrap()), want);
    let single = weights.iter().map(|(name, t)| (format!("cond_stage_model.transformer.{name}"), t.clone()));
    let others = [("model.diffusion_model.out.0.weight".to_owned(), HostTensor::new(&[1], vec![0.0]))];
    assert_eq!(states(&load_written(&single.chain(others).collect(), folder.path()).unwrap()), want);
}

/// OpenCLIP's own names, with a third layer that Stable Diffusion leaves out.
fn open_clip(weights: &BTreeMap<String, HostTensor>) -> BTreeMap<String, HostTensor> {
    let of = |name: &str| weights[&format!("text_model.{name}")].clone();
    let mut out = BTreeMap::from([
        ("token_embedding.weight".to_owned(), of("embeddings.token_embedding.weight")),
        ("positional_embedding".to_owned(), of("embeddings.position_embedding.weight")),
        ("ln_final.weight".to_owned(), of("final_layer_norm.weight")),
        ("ln_final.bias".to_owned(), of("final_layer_norm.bias")),
        ("text_projection".to_owned(), HostTensor::new(&[8, 8], vec![0.0; 64])),
        ("logit_scale".to_owned(), HostTensor::new(&[], vec![4.0])),
    ]);
    let parts = [
        ("ln_1", "layer_norm1"),
        ("ln_2", "layer_norm2"),
        ("attn.out_proj", "self_attn.out_proj"),
        ("mlp.c_fc", "mlp.fc1"),
        ("mlp.c_proj", "mlp.fc2"),
    ];
    for (layer, source) in [(0, 0), (1, 1), (2, 0)] {
        for kind in ["weight", "bias"] {
            for (theirs, ours) in parts {
                let tensor = of(&format!("encoder.layers.{source}.{ours}.{kind}"));
                out.insert(format!("transformer.resblocks.{layer}.{theirs}.{kind}"), tensor);
            }
            let fused = ["q", "k", "v"].map(|p| of(&format!("encoder.layers.{source}.self_attn.{p}_proj.{kind}")));
            let mut shape = fused[0].shape.clone();
            shape[0] *= 3;
            let data = fused.iter().flat_map(|tensor| tensor.data.clone()).collect();
            out.insert(format!("transformer.resblocks.{layer}.attn.in_proj_{kind}"), HostTensor::new(&shape, data));
        }
    }
    out
}

#[test]
fn open_clips_own_names_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let weights = small_weights();
    let want = states(&load_written(&weights, folder.path()).unwrap());
    let theirs = open_clip(&weights);
    assert_eq!(states(&load_written(&theirs, folder.path()).unwrap()), want);
    let single = theirs.iter().map(|(name, t)| (format!("cond_stage_model.model.{name}"), t.clone())).collect();
    assert_eq!(states(&load_written(&single, folder.path()).unwrap()), want);
    let mut short = theirs;
    short.retain(|name, _| !name.starts_with("transformer.resblocks.1.attn.in_proj_weight"));
    let error = load_written(&short, folder.path()).unwrap_err().to_string();
    assert!(error.contains("3 missing") && error.contains("encoder.layers.1.self_attn.k_proj.weight"), "{error}");
}

#[test]
fn every_difference_is_listed() {
    let folder = tempfile::tempdir().unwrap();
    let mut weights = small_weights();
    weights.remove("text_model.final_layer_norm.bias");
    weights.insert("text_model.extra".to_owned(), HostTensor::new(&[1], vec![0.0]));
    weights.insert("text_model.encoder.layers.0.mlp.fc1.bias".to_owned(), HostTensor::new(&[8], vec![0.0; 8]));
    let error = load_written(&weights, folder.path()).unwrap_err().to_string();
    let lines: Vec<_> = error.lines().map(str::trim).collect();
    assert_eq!(
        lines,
        [
            "weights do not fit: 1 missing, 1 unexpected, 1 of another shape",
            "missing     text_model.final_layer_norm.bias [8]",
            "unexpected  text_model.extra",
            "shape       text_model.encoder.layers.0.mlp.fc1.bias is [8], the model needs [12]",
            &format!("in: {}", folder.path().join("w.safetensors").display()),
        ]
    );
}

#[test]
fn half_precision_is_widened() {
    let folder = tempfile::tempdir().unwrap();
    let weights = small_weights();
    for (dtype, file) in [(Dtype::F16, "model.fp16.safetensors"), (Dtype::BF16, "model.safetensors")] {
        let half = |v: &f32| match dtype {
            Dtype::F16 => f16::from_f32(*v).to_le_bytes(),
            _ => bf16::from_f32(*v).to_le_bytes(),
        };
        let widened = |v: &f32| match dtype {
            Dtype::F16 => f16::from_f32(*v).to_f32(),
            _ => bf16::from_f32(*v).to_f32(),
        };
        let bytes: BTreeMap<_, Vec<u8>> =
            weights.iter().map(|(name, t)| (name, t.data.iter().flat_map(half).collect())).collect();
        let views =
            weights.iter().map(|(name, t)| (name, TensorView::new(dtype, t.shape.clone(), &bytes[name]).unwrap()));
        std::fs::write(folder.path().join("config.json"), config_json().to_string()).unwrap();
        serialize_to_file(views, None, &folder.path().join(file)).unwrap();
        let model = load_text_encoder(folder.path(), &device()).unwrap();
        let loaded: BTreeMap<_, _> = named_params(&model).unwrap().into_iter().collect();
        for (name, tensor) in &weights {
            assert_eq!(loaded[name].data, tensor.data.iter().map(widened).collect::<Vec<_>>(), "{name}");
        }
    }
}

#[test]
fn unreadable_folders_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let said = |what: &str| {
        let error = load_text_encoder(folder.path(), &device()).unwrap_err().to_string();
        assert!(error.contains(what), "{error} does not say {what:?}");
        assert!(error.contains(&folder.path().display().to_string()), "{error}");
    };
    said("No such file");
    let mut config = config_json();
    std::fs::write(folder.path().join("config.json"), config.to_string()).unwrap();
    said("holds neither model.safetensors nor model.fp16.safetensors");
    config["hidden_act"] = json!("relu");
    write_folder(folder.path(), &config, &small_weights());
    said("unknown variant `relu`");
    config["hidden_act"] = json!("gelu");
    config["num_attention_heads"] = json!(3);
    write_folder(folder.path(), &config, &small_weights());
    said("3 heads must divide width 8");
}

#[test]
fn a_saved_folder_comes_back_bit_for_bit() {
    let Some(pairs) = table() else { return };
    let root = tempfile::tempdir().unwrap();
    let config = ClipTextConfig { vocab_size: 49_408, max_position_embeddings: 77, ..small_config() };
    let model = ClipTextModel::new(&config, &mut Init::new(3, &device()));
    for padding in [Padding::EndToken, Padding::Zero] {
        let tokenizer = ClipTokenizer::new(pairs.clone(), TextCleaning::Transformers, padding);
        save_clip(root.path(), &tokenizer, &model).unwrap();
        let (again, loaded) = load_clip(root.path(), &device()).unwrap();
        assert_eq!(named_params(&loaded).unwrap(), named_params(&model).unwrap());
        assert_eq!(loaded.config(), model.config());
        let texts = ["A rainy night at 7:30, don't stop!", "Straße", ""];
        assert_eq!(again.tokenize(&texts), tokenizer.tokenize(&texts));
        assert_eq!(again.padding, padding);
    }
    let small = ClipTextModel::new(&small_config(), &mut Init::new(3, &device()));
    save_clip(root.path(), &ClipTokenizer::new(pairs, TextCleaning::Transformers, Padding::Zero), &small).unwrap();
    let error = load_clip(root.path(), &device()).unwrap_err();
    assert!(matches!(error, TextError::Format { .. }) && error.to_string().contains("49408 tokens"), "{error}");
}

#[test]
fn single_files_hold_the_encoder_in_both_styles() {
    for hidden_act in [Activation::QuickGelu, Activation::Gelu] {
        let config = ClipTextConfig { hidden_act, ..small_config() };
        let model = ClipTextModel::new(&config, &mut Init::new(3, &device()));
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("single.safetensors");
        save_single_file(&path, &text_single_file_tensors(&model).unwrap()).unwrap();
        let file = WeightFile::open(&path).unwrap();
        let fused = "cond_stage_model.model.transformer.resblocks.1.attn.in_proj_weight";
        assert_eq!(file.shape(fused).is_some(), hidden_act == Activation::Gelu);
        let again = load_text_weights(ClipTextModel::new(&config, &mut Init::new(4, &device())), &file).unwrap();
        assert_eq!(states(&again), states(&model));
    }
}
