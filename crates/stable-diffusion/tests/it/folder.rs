//! Hugging Face folders: reading, writing, f16, older names, and everything that must be refused.

use std::collections::BTreeMap;
use std::path::Path;

use burn::module::Module;
use burn::tensor::{Device, Tensor};
use nn::Init;
use nn::weights::{HostTensor, WeightError, WeightFile, write_safetensors};
use safetensors::Dtype;
use safetensors::tensor::TensorView;
use serde_json::{Value, json};
use stable_diffusion::layout::{
    CONFIG_FILE, CROSS_VIEW_MODULES, FolderError, Network, WEIGHTS_FILE, load_folder, load_weights,
    load_weights_beside, save_folder, state_dict_params,
};
use stable_diffusion::{AutoencoderKL, ControlNet, NeighbourMerge, Preset, UNet2DCondition};

use crate::golden::{Golden, TOLERANCE, folder, golden_weights, json as read_json, noise};

fn lazy() -> Init {
    Init::lazy(0, &Device::flex())
}

fn unet() -> UNet2DCondition {
    golden_weights(UNet2DCondition::new(&Preset::Debug.unet(), &mut lazy()))
}

fn vae() -> AutoencoderKL {
    golden_weights(AutoencoderKL::new(&Preset::Debug.vae(), &mut lazy()))
}

#[test]
fn a_published_style_folder_computes_what_it_should() {
    let Some(root) = folder("folder") else { return };
    let (golden, device) = (Golden::open(&root.join("io.safetensors")), Device::flex());
    let vae: AutoencoderKL = load_folder(root.join("vae"), &Device::flex()).unwrap();
    let unet: UNet2DCondition = load_folder(root.join("unet"), &Device::flex()).unwrap();
    let text = golden.tensor::<3>("last_hidden_state", &device);
    let output = unet.forward(golden.tensor("sample", &device), &golden.timesteps(), text);
    let predicted = golden.check("unet_output", output, TOLERANCE);
    let moments = golden.check("moments", vae.moments(golden.tensor("image", &device)), TOLERANCE);
    eprintln!("folder: prediction off by {predicted:.1e}, moments by {moments:.1e}");

    // Written again and read again, nothing changes, and the config says the same.
    let copy = tempfile::tempdir().unwrap();
    save_folder(&unet, copy.path().join("unet")).unwrap();
    save_folder(&vae, copy.path().join("vae")).unwrap();
    for part in ["unet", "vae"] {
        let [original, again] = [&root, &copy.path().to_path_buf()]
            .map(|root| WeightFile::open(root.join(part).join(WEIGHTS_FILE)).unwrap().read_all().unwrap());
        assert_eq!(original, again, "{part}");
        let (original, again) =
            [&root, &copy.path().to_path_buf()].map(|root| read_json(&root.join(part).join(CONFIG_FILE))).into();
        for (key, value) in original.as_object().unwrap() {
            assert!(
                key.starts_with("_diffusers") || again[key] == *value,
                "{part}: {key} was {value}, is {}",
                again[key]
            );
        }
    }
}

#[test]
fn the_folders_decoder_computes_what_it_should() {
    let Some(root) = folder("folder") else { return };
    let (golden, device) = (Golden::open(&root.join("io.safetensors")), Device::flex());
    let vae: AutoencoderKL = load_folder(root.join("vae"), &Device::flex()).unwrap();
    let latents = golden.tensor::<4>("sample", &device);
    golden.check("decoded", vae.decode(latents), TOLERANCE);
}

fn round_trip<N: Network>(network: N)
where
    N::Config: PartialEq + std::fmt::Debug,
{
    let folder = tempfile::tempdir().unwrap();
    save_folder(&network, folder.path()).unwrap();
    let again: N = load_folder(folder.path(), &Device::flex()).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&network).unwrap());
    assert_eq!(N::config_to_json(again.sizes()), N::config_to_json(network.sizes()));
}

#[test]
fn what_is_saved_loads_to_the_bit() {
    round_trip(unet());
    round_trip(vae());
    round_trip(golden_weights(ControlNet::new(&Preset::Debug.controlnet(19), &mut lazy())));
    let mut config = Preset::Debug.unet();
    config.encoder.cross_view = Some(NeighbourMerge::Concat);
    config.encoder.panels = stable_diffusion::Panels::JointWidth;
    config.encoder.projection = stable_diffusion::ProjectionKind::Convolution;
    config.encoder.heads = stable_diffusion::AttentionHeads::Count(vec![2, 4]);
    round_trip(golden_weights(UNet2DCondition::new(&config, &mut lazy())));
}

/// Writes tensors after a change of name, shape or type.
fn write_changed(
    path: &Path,
    network: &AutoencoderKL,
    change: impl Fn(String, HostTensor) -> Option<(String, HostTensor)>,
) {
    let tensors: Vec<_> =
        state_dict_params(network).unwrap().into_iter().filter_map(|(name, tensor)| change(name, tensor)).collect();
    write_safetensors(path, &tensors, &BTreeMap::new()).unwrap();
}

#[test]
fn older_names_and_convolutions_are_accepted_in_the_autoencoder() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(WEIGHTS_FILE);
    let network = vae();
    write_changed(&path, &network, |name, tensor| {
        let old = name.replace(".to_q.", ".query.").replace(".to_k.", ".key.");
        let old = old.replace(".to_v.", ".value.").replace(".to_out.0.", ".proj_attn.");
        let squeezed = old != name && old.ends_with(".weight");
        let shape = if squeezed { [tensor.shape.as_slice(), &[1, 1]].concat() } else { tensor.shape };
        Some((old, HostTensor::new(&shape, tensor.data)))
    });
    let file = WeightFile::open(&path).unwrap();
    assert!(file.names().any(|name| name.ends_with("attentions.0.query.weight")));
    let again = load_weights(AutoencoderKL::new(&Preset::Debug.vae(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&network).unwrap());
}

#[test]
fn half_precision_is_widened() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(WEIGHTS_FILE);
    let network = vae();
    let named = state_dict_params(&network).unwrap();
    for dtype in [Dtype::F16, Dtype::BF16] {
        let bytes = |v: &f32| match dtype {
            Dtype::F16 => half::f16::from_f32(*v).to_le_bytes(),
            _ => half::bf16::from_f32(*v).to_le_bytes(),
        };
        let data: Vec<Vec<u8>> = named.iter().map(|(_, t)| t.data.iter().flat_map(bytes).collect()).collect();
        let views = named
            .iter()
            .zip(&data)
            .map(|((name, tensor), data)| (name.as_str(), TensorView::new(dtype, tensor.shape.clone(), data).unwrap()));
        safetensors::serialize_to_file(views, None, &path).unwrap();
        let file = WeightFile::open(&path).unwrap();
        let loaded = load_weights(AutoencoderKL::new(&Preset::Debug.vae(), &mut lazy()), &file).unwrap();
        for ((name, tensor), (_, original)) in state_dict_params(&loaded).unwrap().iter().zip(&named) {
            let worst = tensor.data.iter().zip(&original.data).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(worst < 0.01, "{name}: off by {worst}");
        }
        assert_ne!(state_dict_params(&loaded).unwrap(), named, "{dtype:?} rounds");
    }
}

#[test]
fn weights_that_do_not_fit_are_listed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join(WEIGHTS_FILE);
    write_changed(&path, &vae(), |name, tensor| match name.as_str() {
        "quant_conv.bias" => None,
        "decoder.conv_out.bias" => Some(("decoder.conv_last.bias".to_owned(), tensor)),
        // Only attention was ever stored as a convolution.
        "encoder.conv_norm_out.bias" => Some((name, HostTensor::new(&[tensor.shape[0], 1], tensor.data))),
        _ => Some((name, tensor)),
    });
    std::fs::write(
        folder.path().join(CONFIG_FILE),
        Value::Object(AutoencoderKL::config_to_json(&Preset::Debug.vae())).to_string(),
    )
    .unwrap();
    let error = load_folder::<AutoencoderKL>(folder.path(), &Device::flex()).unwrap_err();
    let text = error.to_string();
    let lines: Vec<_> = text.lines().map(str::trim).collect();
    let last = format!("in: {}", path.display());
    let expected = [
        "weights do not fit: 2 missing, 1 unexpected, 1 of another shape",
        "missing     decoder.conv_out.bias [3]",
        "missing     quant_conv.bias [8]",
        "unexpected  decoder.conv_last.bias",
        "shape       encoder.conv_norm_out.bias is [16, 1], the model needs [16]",
        last.as_str(),
    ];
    assert_eq!(lines, expected);
    assert!(matches!(error, FolderError::Weights(WeightError::Mismatch(_))));
}

/// What comes of a UNet's config after one entry is changed.
fn read_changed(key: &str, value: Value) -> Result<UNet2DCondition, FolderError> {
    let folder = tempfile::tempdir().unwrap();
    save_folder(&unet(), folder.path()).unwrap();
    let path = folder.path().join(CONFIG_FILE);
    let mut config = read_json(&path);
    config[key] = value;
    std::fs::write(&path, config.to_string()).unwrap();
    load_folder(folder.path(), &Device::flex())
}

#[test]
fn configs_that_ask_for_something_else_are_refused() {
    let refused = [
        ("act_fn", json!("gelu")),
        ("_class_name", json!("UNet3DConditionModel")),
        ("class_embed_type", json!("timestep")),
        ("down_block_types", json!(["CrossAttnDownBlock2D", "AttnDownBlock2D"])),
        ("up_block_types", json!(["CrossAttnUpBlock2D", "UpBlock2D"])),
        ("transformer_layers_per_block", json!(2)),
        ("mid_block_type", json!(null)),
        ("norm_eps", json!(1e-6)),
        ("flip_sin_to_cos", json!(false)),
        ("num_attention_heads", json!(4)),
        ("attention_head_dim", json!([2])),
        ("attention_head_dim", json!(3)),
        ("layers_per_block", json!([1, 1])),
        ("block_out_channels", json!([])),
        ("in_channels", json!(-4)),
        ("in_channels", json!(1u64 << 60)),
        ("layers_per_block", json!(1u64 << 40)),
        ("a_new_setting", json!(true)),
        ("panels", json!("both")),
    ];
    for (key, value) in refused {
        let error = read_changed(key, value.clone()).map(|_| ()).unwrap_err();
        assert!(matches!(error, FolderError::Config { .. }), "{key} = {value}: {error}");
        assert!(error.to_string().ends_with(CONFIG_FILE), "{error}");
    }
    let accepted = [
        ("attention_head_dim", json!([2, 2])),
        ("upcast_attention", json!(true)),
        ("sample_size", json!(96)),
        ("_name_or_path", json!("elsewhere")),
        ("a_new_setting", json!(null)),
        ("mid_block_scale_factor", json!(1.0)),
    ];
    for (key, value) in accepted {
        read_changed(key, value).unwrap();
    }
    let error = read_changed("norm_eps", json!(1e-6)).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("norm_eps is 1e-6, only 0.00001 is supported"), "{error}");
}

#[test]
fn absent_and_broken_files_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let absent = load_folder::<UNet2DCondition>(folder.path(), &Device::flex()).unwrap_err();
    assert!(matches!(&absent, FolderError::Io { path, .. } if path.ends_with(CONFIG_FILE)), "{absent}");
    for text in ["", "[]", "{}", "{\"act_fn\": "] {
        std::fs::write(folder.path().join(CONFIG_FILE), text).unwrap();
        let error = load_folder::<UNet2DCondition>(folder.path(), &Device::flex()).unwrap_err();
        assert!(matches!(&error, FolderError::Config { path, .. } if path.ends_with(CONFIG_FILE)), "{text}: {error}");
    }
    std::fs::write(
        folder.path().join(CONFIG_FILE),
        Value::Object(UNet2DCondition::config_to_json(&Preset::Debug.unet())).to_string(),
    )
    .unwrap();
    let error = load_folder::<UNet2DCondition>(folder.path(), &Device::flex()).unwrap_err();
    assert!(matches!(error, FolderError::Weights(WeightError::Io { .. })), "{error}");
}

#[test]
fn the_autoencoders_scale_comes_from_its_file() {
    let mut map = AutoencoderKL::config_to_json(&Preset::Debug.vae());
    assert_eq!(AutoencoderKL::config_from_json(&map).unwrap().scaling_factor, 1.0);
    map.insert("scaling_factor".to_owned(), json!(0.7));
    assert_eq!(AutoencoderKL::config_from_json(&map).unwrap().scaling_factor, 0.7);
    // Old files of Stable Diffusion say nothing.
    map.remove("scaling_factor");
    assert_eq!(AutoencoderKL::config_from_json(&map).unwrap().scaling_factor, 0.18215);
    for bad in [json!(0.0), json!(-1.0), json!("x")] {
        map.insert("scaling_factor".to_owned(), bad);
        assert!(AutoencoderKL::config_from_json(&map).is_err());
    }
}

#[test]
fn loading_keeps_a_network_trainable() {
    let folder = tempfile::tempdir().unwrap();
    save_folder(&unet(), folder.path()).unwrap();
    let device = Device::flex().autodiff();
    let unet: UNet2DCondition = load_folder(folder.path(), &device).unwrap();
    assert!(unet.conv_in.weight.is_require_grad());
    assert!(!unet.clone().no_grad().conv_in.weight.is_require_grad());
    let sample: Tensor<4> = noise("sample", [1, 4, 4, 4], &device);
    let loss = unet.forward(sample, &[1.0], noise("text", [1, 2, 16], &device)).sum();
    assert!(unet.conv_in.weight.grad(&loss.backward()).is_some());
}

#[test]
fn only_named_new_modules_may_be_missing() {
    let folder = tempfile::tempdir().unwrap();
    let plain = unet();
    save_folder(&plain, folder.path()).unwrap();
    let file = WeightFile::open(folder.path().join(WEIGHTS_FILE)).unwrap();
    let mut config = Preset::Debug.unet();
    config.encoder.cross_view = Some(NeighbourMerge::Sum);
    let fresh = || UNet2DCondition::new(&config, &mut lazy());
    let (loaded, kept) = load_weights_beside(fresh(), &file, &CROSS_VIEW_MODULES).unwrap();
    // Four transformers: one down, one middle, two up; norm4 2, attn4 5 and connector 2 tensors each.
    assert_eq!(kept.len(), 4 * 9);
    let params = state_dict_params(&loaded).unwrap();
    for (name, tensor) in &params {
        let connector = name.contains(".connector.");
        assert!(!connector || tensor.data.iter().all(|v| *v == 0.0), "{name}");
        assert!(!name.ends_with("attn4.to_q.weight") || tensor.data.iter().any(|v| *v != 0.0), "{name}");
    }
    let own: Vec<_> = params.into_iter().filter(|(name, _)| !kept.contains(name)).collect();
    assert_eq!(own, state_dict_params(&plain).unwrap());
    // A module that is not named, and the reverse: tensors that the network does not have.
    let error = load_weights_beside(fresh(), &file, &["norm4", "attn4"]).unwrap_err();
    assert!(matches!(error, WeightError::Mismatch(m) if m.missing.len() == 4 * 2));
    save_folder(&loaded, folder.path()).unwrap();
    let file = WeightFile::open(folder.path().join(WEIGHTS_FILE)).unwrap();
    let error = load_weights_beside(plain, &file, &CROSS_VIEW_MODULES).unwrap_err();
    assert!(matches!(error, WeightError::Mismatch(m) if m.unexpected.len() == 4 * 9));
}
