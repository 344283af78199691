//! CLIP's text encoders against golden numbers.

use burn::module::Module;
use burn::tensor::{Int, Tensor};
use flate2::read::GzDecoder;
use nn::Init;
use nn::weights::{WeightFile, param_shapes};
use serde_json::{Value, json};
use stable_diffusion::text::{
    Activation, ClipTextConfig, ClipTextModel, TextError, TextOutput, TokenBatch, load_text_encoder,
};

use super::reference::{END, check, device, golden, golden_weights, input_ids, json, manifest, values, write_folder};

/// f32 against f32 with another order of sums; the golden run itself lies 2e-6 from its f64 twin.
const TOLERANCE: f32 = 1e-4;

/// The golden encoder of one folder, loaded from files as any other; `layers` beyond those of the manifest are added.
fn encoder(case: &str, layers: usize, output: TextOutput) -> Option<(ClipTextModel, WeightFile, TokenBatch)> {
    let folder = golden(&format!("stable_diffusion/{case}"))?;
    let mut config = json(&folder.join("config.json"));
    let mut parameters = manifest(&json(&folder.join("manifest.json")));
    for layer in 3..layers {
        let more: Vec<_> = parameters
            .iter()
            .filter_map(|(name, shape)| Some((name.strip_prefix("text_model.encoder.layers.0.")?, shape.clone())))
            .map(|(end, shape)| (format!("text_model.encoder.layers.{layer}.{end}"), shape))
            .collect();
        parameters.extend(more);
    }
    config["num_hidden_layers"] = json!(layers);
    config["output"] = json!(output);
    let files = tempfile::tempdir().unwrap();
    write_folder(files.path(), &config, &golden_weights(&parameters));
    let io = folder.join("io.safetensors");
    let model = load_text_encoder(files.path(), &device()).unwrap();
    Some((model, WeightFile::open(&io).unwrap(), input_ids(&io, END)))
}

#[test]
fn clip_l_equals_the_reference() {
    let Some((model, io, tokens)) = encoder("clip_text_sd15", 3, TextOutput::Last) else { return };
    assert_eq!(model.config().hidden_act, Activation::QuickGelu);
    let out = model.forward(&tokens);
    check(&io, "last_hidden_state", out.states, TOLERANCE);
    check(&io, "pooler_output", out.pooled, TOLERANCE);
}

#[test]
fn every_layer_equals_the_reference() {
    let Some((model, io, tokens)) = encoder("clip_text_sd15", 3, TextOutput::Last) else { return };
    // Stored: the second text, every eighth token.
    let places: Vec<i32> = (0..77).step_by(8).collect();
    let places = Tensor::<1, Int>::from_ints(places.as_slice(), &device());
    let mut state = embedded(&model, &tokens);
    let mask = Tensor::<2>::ones([77, 77], &device()).triu(1).lower_elem(0.5).unsqueeze::<4>();
    for layer in 0..=model.text_model.encoder.layers.len() {
        let kept = state.clone().narrow(0, 1, 1).select(1, places.clone());
        check(&io, &format!("trace/hidden_states.{layer}"), kept, TOLERANCE);
        if let Some(layer) = model.text_model.encoder.layers.get(layer) {
            state = layer.forward(state, mask.clone());
        }
    }
}

fn embedded(model: &ClipTextModel, tokens: &TokenBatch) -> Tensor<3> {
    let tables = &model.text_model.embeddings;
    let ids = tokens.to_tensor(&device());
    let [n, l] = ids.dims();
    let rows = tables.token_embedding.weight.val().select(0, ids.reshape([n * l]));
    rows.reshape([n, l, model.config().hidden_size]) + tables.position_embedding.weight.val().unsqueeze::<3>()
}

#[test]
fn open_clip_h_equals_the_reference() {
    let Some((model, io, tokens)) = encoder("clip_text_sd21", 3, TextOutput::Last) else { return };
    assert_eq!(model.config().hidden_act, Activation::Gelu);
    let out = model.forward(&tokens);
    check(&io, "last_hidden_state", out.states.clone(), TOLERANCE);
    check(&io, "pooler_output_of_3_layers", out.pooled, TOLERANCE);
    let Some((all, ..)) = encoder("clip_text_sd21", 4, TextOutput::Last) else { return };
    check(&io, "last_hidden_state_of_all_4_layers", all.forward(&tokens).states, TOLERANCE);
    let Some((all, ..)) = encoder("clip_text_sd21", 4, TextOutput::Penultimate) else { return };
    assert_eq!(values(all.forward(&tokens).states), values(out.states));
}

#[test]
fn a_saved_pipeline_gives_the_reference() {
    let Some(folder) = golden("stable_diffusion/folder") else { return };
    let model = load_text_encoder(&folder.join("text_encoder"), &device()).unwrap();
    let io = folder.join("io.safetensors");
    let out = model.forward(&input_ids(&io, 511));
    check(&WeightFile::open(&io).unwrap(), "last_hidden_state", out.states, TOLERANCE);
}

#[test]
fn tokens_do_not_look_ahead() {
    let Some((model, _, tokens)) = encoder("clip_text_sd15", 3, TextOutput::Last) else { return };
    let mut other = tokens.ids()[..77].to_vec();
    let before = values(model.forward(&TokenBatch::new(other.clone(), 77, END)).states);
    other[40] = 320;
    let after = values(model.forward(&TokenBatch::new(other, 77, END)).states);
    let width = model.config().hidden_size;
    assert_eq!(before[..40 * width], after[..40 * width]);
    for place in 40..77 {
        assert_ne!(before[place * width..][..width], after[place * width..][..width], "place {place}");
    }
}

#[test]
fn published_encoders_have_these_names_and_shapes() {
    let Some(folder) = golden("stable_diffusion/full_size") else { return };
    for (name, preset) in [("clip_text_sd15", ClipTextConfig::sd15()), ("clip_text_sd21", ClipTextConfig::sd21())] {
        let packed = std::fs::File::open(folder.join(format!("{name}.json.gz"))).unwrap();
        let listed: Value = serde_json::from_reader(GzDecoder::new(packed)).unwrap();
        // Parameters that are never used take no memory.
        let model = ClipTextModel::new(&preset, &mut Init::lazy(0, &device()));
        assert_eq!(param_shapes(&model), manifest(&listed), "{name}");
        assert_eq!(model.num_params() as u64, listed["parameter_count"].as_u64().unwrap());
        assert!(!model.text_model.embeddings.token_embedding.weight.is_initialized());
        let ours = serde_json::to_value(preset).unwrap();
        for (key, value) in
            ours.as_object().unwrap().iter().filter(|(key, _)| !["layer_norm_eps", "output"].contains(&key.as_str()))
        {
            assert_eq!(value, &listed["config"][key], "{name}: {key}");
        }
    }
}

#[test]
fn sizes_that_build_nothing_are_refused() {
    let base = ClipTextConfig::sd15();
    let wrong = [
        ClipTextConfig { vocab_size: 0, ..base },
        ClipTextConfig { num_attention_heads: 7, ..base },
        ClipTextConfig { num_hidden_layers: 1 << 40, ..base },
        ClipTextConfig { layer_norm_eps: f64::NAN, ..base },
    ];
    for config in wrong {
        assert!(matches!(config.checked(), Err(TextError::Sizes(_))), "{config:?}");
    }
    assert!(base.checked().is_ok());
}
