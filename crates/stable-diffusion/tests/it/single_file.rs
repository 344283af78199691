//! The original single-file layout: our names for its names, spot checks against published keys, round trips.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use nn::Init;
use nn::weights::{HostTensor, WeightError, WeightFile, write_safetensors};
use stable_diffusion::layout::single_file::{
    SingleFileNetwork, load_single_file, save_single_file, single_file_tensors,
};
use stable_diffusion::layout::{FolderError, load_folder, state_dict_params, state_dict_shapes};
use stable_diffusion::{AutoencoderKL, ControlNet, Preset, UNet2DCondition};

use crate::golden::{folder as golden_folder, golden_weights};

fn lazy() -> Init {
    Init::lazy(0, &Device::flex())
}

fn check_names<N: SingleFileNetwork>(network: &N, pairs: &[(&str, &str)]) {
    let names: Vec<String> = state_dict_shapes(network).into_iter().map(|(name, _)| name).collect();
    let original: BTreeSet<String> = names.iter().map(|name| network.original_name(name)).collect();
    assert_eq!(original.len(), names.len(), "two parameters with one original name");
    for (ours, theirs) in pairs {
        assert!(names.iter().any(|name| name == ours), "{ours} is no parameter");
        assert_eq!(network.original_name(ours), *theirs);
    }
}

#[test]
fn published_keys_of_the_unet() {
    let unet = UNet2DCondition::new(&Preset::Sd15.unet(), &mut lazy());
    check_names(
        &unet,
        &[
            ("conv_in.weight", "input_blocks.0.0.weight"),
            ("time_embedding.linear_1.bias", "time_embed.0.bias"),
            ("time_embedding.linear_2.weight", "time_embed.2.weight"),
            ("down_blocks.0.resnets.0.norm1.weight", "input_blocks.1.0.in_layers.0.weight"),
            ("down_blocks.0.resnets.1.conv1.weight", "input_blocks.2.0.in_layers.2.weight"),
            ("down_blocks.0.attentions.1.proj_in.weight", "input_blocks.2.1.proj_in.weight"),
            ("down_blocks.0.downsamplers.0.conv.bias", "input_blocks.3.0.op.bias"),
            ("down_blocks.1.resnets.0.conv_shortcut.weight", "input_blocks.4.0.skip_connection.weight"),
            ("down_blocks.2.downsamplers.0.conv.weight", "input_blocks.9.0.op.weight"),
            ("down_blocks.3.resnets.1.time_emb_proj.weight", "input_blocks.11.0.emb_layers.1.weight"),
            ("mid_block.resnets.0.conv2.weight", "middle_block.0.out_layers.3.weight"),
            (
                "mid_block.attentions.0.transformer_blocks.0.ff.net.0.proj.weight",
                "middle_block.1.transformer_blocks.0.ff.net.0.proj.weight",
            ),
            ("mid_block.resnets.1.norm2.bias", "middle_block.2.out_layers.0.bias"),
            ("up_blocks.0.resnets.2.conv1.bias", "output_blocks.2.0.in_layers.2.bias"),
            ("up_blocks.0.upsamplers.0.conv.weight", "output_blocks.2.1.conv.weight"),
            (
                "up_blocks.1.attentions.0.transformer_blocks.0.attn2.to_out.0.bias",
                "output_blocks.3.1.transformer_blocks.0.attn2.to_out.0.bias",
            ),
            ("up_blocks.1.upsamplers.0.conv.weight", "output_blocks.5.2.conv.weight"),
            ("up_blocks.2.upsamplers.0.conv.bias", "output_blocks.8.2.conv.bias"),
            ("up_blocks.3.attentions.2.norm.weight", "output_blocks.11.1.norm.weight"),
            ("conv_norm_out.weight", "out.0.weight"),
            ("conv_out.bias", "out.2.bias"),
        ],
    );
}

#[test]
fn published_keys_of_the_autoencoder_and_the_controlnet() {
    let vae = AutoencoderKL::new(&Preset::Sd15.vae(), &mut lazy());
    check_names(
        &vae,
        &[
            ("encoder.conv_in.weight", "encoder.conv_in.weight"),
            ("encoder.down_blocks.0.resnets.1.conv2.bias", "encoder.down.0.block.1.conv2.bias"),
            ("encoder.down_blocks.1.resnets.0.conv_shortcut.weight", "encoder.down.1.block.0.nin_shortcut.weight"),
            ("encoder.down_blocks.2.downsamplers.0.conv.weight", "encoder.down.2.downsample.conv.weight"),
            ("encoder.mid_block.attentions.0.group_norm.weight", "encoder.mid.attn_1.norm.weight"),
            ("encoder.mid_block.attentions.0.to_q.bias", "encoder.mid.attn_1.q.bias"),
            ("encoder.conv_norm_out.bias", "encoder.norm_out.bias"),
            ("decoder.mid_block.resnets.1.norm1.weight", "decoder.mid.block_2.norm1.weight"),
            ("decoder.mid_block.attentions.0.to_out.0.weight", "decoder.mid.attn_1.proj_out.weight"),
            ("decoder.up_blocks.0.resnets.2.conv1.weight", "decoder.up.3.block.2.conv1.weight"),
            ("decoder.up_blocks.0.upsamplers.0.conv.weight", "decoder.up.3.upsample.conv.weight"),
            ("decoder.up_blocks.3.resnets.0.conv_shortcut.weight", "decoder.up.0.block.0.nin_shortcut.weight"),
            ("decoder.conv_out.weight", "decoder.conv_out.weight"),
            ("quant_conv.weight", "quant_conv.weight"),
            ("post_quant_conv.bias", "post_quant_conv.bias"),
        ],
    );
    let control = ControlNet::new(&Preset::Sd15.controlnet(3), &mut lazy());
    check_names(
        &control,
        &[
            ("controlnet_cond_embedding.conv_in.weight", "input_hint_block.0.weight"),
            ("controlnet_cond_embedding.blocks.0.weight", "input_hint_block.2.weight"),
            ("controlnet_cond_embedding.blocks.5.bias", "input_hint_block.12.bias"),
            ("controlnet_cond_embedding.conv_out.weight", "input_hint_block.14.weight"),
            ("controlnet_down_blocks.11.weight", "zero_convs.11.0.weight"),
            ("controlnet_mid_block.bias", "middle_block_out.0.bias"),
            ("down_blocks.3.resnets.0.conv1.weight", "input_blocks.10.0.in_layers.2.weight"),
            ("conv_in.bias", "input_blocks.0.0.bias"),
        ],
    );
}

fn tensors<N: SingleFileNetwork>(network: &N) -> Vec<(String, HostTensor)> {
    let named = state_dict_params(network).unwrap().into_iter();
    named.map(|(name, tensor)| (format!("{}{}", N::PREFIX, network.original_name(&name)), tensor)).collect()
}

#[test]
fn several_networks_load_from_one_file() {
    let unet = golden_weights(UNet2DCondition::new(&Preset::Tiny.unet(), &mut lazy()));
    let vae = golden_weights(AutoencoderKL::new(&Preset::Tiny.vae(), &mut lazy()));
    let control = golden_weights(ControlNet::new(&Preset::Tiny.controlnet(3), &mut lazy()));
    let mut all = [tensors(&unet), tensors(&vae), tensors(&control)].concat();
    // As published: attention of the autoencoder as 1×1 convolutions, and things of no network beside.
    for (name, tensor) in &mut all {
        if name.contains("attn_1.") && !name.contains("norm") && name.ends_with("weight") {
            tensor.shape.extend([1, 1]);
        }
    }
    all.push(("alphas_cumprod".to_owned(), HostTensor::new(&[3], vec![0.9, 0.5, 0.1])));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v1.safetensors");
    write_safetensors(&path, &all, &BTreeMap::new()).unwrap();

    let file = WeightFile::open(&path).unwrap();
    let again = load_single_file(UNet2DCondition::new(&Preset::Tiny.unet(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&unet).unwrap());
    let again = load_single_file(AutoencoderKL::new(&Preset::Tiny.vae(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&vae).unwrap());
    let again = load_single_file(ControlNet::new(&Preset::Tiny.controlnet(3), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&control).unwrap());
}

#[test]
fn leftovers_behind_the_prefix_are_listed() {
    let unet = golden_weights(UNet2DCondition::new(&Preset::Debug.unet(), &mut lazy()));
    let mut all = tensors(&unet);
    all.retain(|(name, _)| !name.ends_with("out.2.bias"));
    all.push(("model.diffusion_model.extra".to_owned(), HostTensor::new(&[1], vec![0.0])));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("v1.safetensors");
    write_safetensors(&path, &all, &BTreeMap::new()).unwrap();
    let file = WeightFile::open(&path).unwrap();
    let error = load_single_file(UNet2DCondition::new(&Preset::Debug.unet(), &mut lazy()), &file).unwrap_err();
    let WeightError::Mismatch(mismatch) = error else { panic!("{error}") };
    assert_eq!(mismatch.missing, [("conv_out.bias".to_owned(), vec![4])]);
    assert_eq!(mismatch.unexpected, ["model.diffusion_model.extra"]);
    assert!(mismatch.wrong_shape.is_empty());
    assert_eq!(mismatch.path.as_deref(), Some(path.as_path()));
    assert_eq!(unet.num_params(), all.iter().map(|(_, t)| t.data.len()).sum::<usize>() + 4 - 1);
}

#[test]
fn several_networks_share_a_file_both_ways() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("all.safetensors");
    let unet = golden_weights(UNet2DCondition::new(&Preset::Debug.unet(), &mut lazy()));
    let vae = golden_weights(AutoencoderKL::new(&Preset::Debug.vae(), &mut lazy()));
    let tensors = [single_file_tensors(&unet).unwrap(), single_file_tensors(&vae).unwrap()].concat();
    save_single_file(&path, &tensors).unwrap();
    let file = WeightFile::open(&path).unwrap();
    let query = "first_stage_model.encoder.mid.attn_1.q.weight";
    assert_eq!(file.shape(query), Some(&[16, 16, 1, 1][..]), "published files hold a convolution here");
    let again = load_single_file(UNet2DCondition::new(&Preset::Debug.unet(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&unet).unwrap());
    let again = load_single_file(AutoencoderKL::new(&Preset::Debug.vae(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&vae).unwrap());
}

/// What PyTorch wrote (`tests/peers/torch_folder.py`).
fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

#[test]
fn torch_files_in_half_precision_load_from_folders_and_checkpoints() {
    let from_bin: AutoencoderKL = load_folder(fixture("vae"), &Device::flex()).unwrap();
    let parameters = state_dict_params(&from_bin).unwrap();
    let file = WeightFile::open(fixture("v1.ckpt")).unwrap();
    let from_ckpt = load_single_file(AutoencoderKL::new(from_bin.config(), &mut lazy()), &file).unwrap();
    assert_eq!(state_dict_params(&from_ckpt).unwrap(), parameters);

    let Some(root) = golden_folder("folder") else { return };
    let original: AutoencoderKL = load_folder(root.join("vae"), &Device::flex()).unwrap();
    for ((name, half), (_, whole)) in parameters.iter().zip(state_dict_params(&original).unwrap()) {
        let close = |(half, whole): (&f32, &f32)| (half - whole).abs() <= whole.abs() / 2048.0 + 3e-8;
        assert!(half.data.iter().zip(&whole.data).all(close), "{name}");
    }
}

#[test]
fn damaged_torch_files_are_refused_with_their_path() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(fixture("vae/config.json"), folder.path().join("config.json")).unwrap();
    let path = folder.path().join("diffusion_pytorch_model.bin");
    let bytes = std::fs::read(fixture("vae/diffusion_pytorch_model.fp16.bin")).unwrap();
    let load = || load_folder::<AutoencoderKL>(folder.path(), &Device::flex());
    for end in [0, 100, bytes.len() / 2, bytes.len() - 1] {
        std::fs::write(&path, &bytes[..end]).unwrap();
        let error = load().unwrap_err();
        assert!(matches!(error, FolderError::Weights(_)) && error.to_string().contains(".bin"), "{end}: {error}");
    }
    // Another network's checkpoint: all differences, the file last.
    std::fs::copy(fixture("v1.ckpt"), &path).unwrap();
    let error = load().unwrap_err().to_string();
    assert!(error.contains("first_stage_model.") && error.contains("diffusion_pytorch_model.bin"), "{error}");
}
