//! Adapters on the UNet against golden numbers.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nn::Init;
use nn::lora::{self, LoraSites};
use nn::weights::WeightFile;
use stable_diffusion::UNet2DCondition;
use stable_diffusion::layout::{
    Network, WEIGHTS_FILE, load_folder, load_weights, save_folder, state_dict_params, state_dict_shapes,
};

use crate::golden::{Golden, TOLERANCE, compare, folder, golden_weights, json, values_of};

/// Adapter gradients, of their maximum. The reference itself, in f32, lies up to 9e-5 from its twin in f64.
const GRADIENT_TOLERANCE: f64 = 1e-4;

/// UNet with golden weights, its inputs and reference outputs.
fn case(device: &Device) -> Option<(UNet2DCondition, Golden, std::path::PathBuf)> {
    let folder = folder("../lora")?;
    let config = json(&folder.join("config.json"));
    let config = UNet2DCondition::config_from_json(config.as_object().unwrap()).unwrap();
    let unet = golden_weights(UNet2DCondition::new(&config, &mut Init::lazy(0, device)));
    Some((unet, Golden::open(&folder.join("io.safetensors")), folder))
}

fn forward(unet: &UNet2DCondition, golden: &Golden) -> Tensor<4> {
    let device = unet.conv_in.weight.device();
    let context = golden.tensor("encoder_hidden_states", &device);
    unet.forward(golden.tensor("sample", &device), &golden.timesteps(), context)
}

#[test]
fn outputs_equal_the_reference() {
    let Some((base, golden, folder)) = case(&Device::flex()) else { return };
    let report = |name: &str, off: f64| eprintln!("{name}: off by {off:.1e}");
    let without = forward(&base, &golden);
    report("base", golden.check("output_base", without.clone(), TOLERANCE));
    let file = |layout: &str| folder.join(layout).join("pytorch_lora_weights.safetensors");

    let mut plain = lora::load(base.clone(), "style", &file("plain"), "unet").unwrap();
    report("plain", golden.check("output_loaded_plain", forward(&plain, &golden), TOLERANCE));
    lora::set_weight(&mut plain, "style", 2.0).unwrap();
    report("plain, alpha 8", golden.check("output_adapter", forward(&plain, &golden), TOLERANCE));

    let mut unet = lora::load(base, "style", &file("with_metadata"), "unet").unwrap();
    report("with metadata", golden.check("output_loaded_with_metadata", forward(&unet, &golden), TOLERANCE));
    lora::set_weight(&mut unet, "style", 0.5).unwrap();
    report("weight 0.5", golden.check("output_adapter_weight_0.5", forward(&unet, &golden), TOLERANCE));
    lora::set_weight(&mut unet, "style", 0.0).unwrap();
    assert_eq!(values_of(forward(&unet, &golden)), values_of(without));
    lora::set_weight(&mut unet, "style", 1.0).unwrap();
    let unmerged = values_of(forward(&unet, &golden));
    lora::merge(&mut unet);
    report("merged", golden.check("output_merged", forward(&unet, &golden), TOLERANCE));
    lora::unmerge(&mut unet);
    assert_eq!(values_of(forward(&unet, &golden)), unmerged);
}

#[test]
fn gradients_equal_the_reference() {
    let device = Device::flex().autodiff();
    let Some((base, golden, folder)) = case(&device) else { return };
    let path = folder.join("with_metadata/pytorch_lora_weights.safetensors");
    let mut unet = lora::load(base, "style", &path, "unet").unwrap();
    let loss = (forward(&unet, &golden) - golden.tensor("target", &device)).square().mean();
    compare("loss", &values_of(loss.clone()), &golden.host("loss").data, 1e-5);
    let gradients = GradientsParams::from_grads(loss.backward(), &unet);

    let (mut checked, mut squares, mut adapters, mut worst) = (0, 0.0, 0, 0.0_f64);
    unet.visit_sites("", &mut |site| {
        for adapter in &site.lora.stack {
            for (id, factor) in [(adapter.down.id, "down"), (adapter.up.id, "up")] {
                let got = values_of(gradients.get::<2>(id).unwrap());
                squares += got.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>();
                adapters += 1;
                let name = format!("grad/unet.{}.lora.{factor}.weight", site.path);
                if golden.names("grad/unet.").iter().any(|known| name.ends_with(known)) {
                    let want = &golden.host(&name).data;
                    let scale = want.iter().fold(0.0_f32, |scale, v| scale.max(v.abs()));
                    let off = got.iter().zip(want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                    worst = worst.max(f64::from(off / scale));
                    checked += 1;
                }
            }
        }
    });
    let norm = f64::from(golden.host("grad_norm_all_lora").data[0]);
    eprintln!("gradients off by {worst:.1e} of their maxima, norm {} for {norm}", squares.sqrt());
    assert!(worst <= GRADIENT_TOLERANCE, "{worst}");
    assert!((squares.sqrt() / norm - 1.0).abs() < 1e-5, "{} for {norm}", squares.sqrt());
    // The frozen network has none.
    assert_eq!((checked, gradients.len()), (6, adapters));
}

#[test]
fn a_folder_holds_the_base_alone() {
    let Some((base, _, folder)) = case(&Device::flex()) else { return };
    let path = folder.join("with_metadata/pytorch_lora_weights.safetensors");
    let unet = lora::load(base.clone(), "style", &path, "unet").unwrap();
    assert!(unet.num_params() > base.num_params());
    let saved = tempfile::tempdir().unwrap();
    save_folder(&unet, saved.path()).unwrap();
    let again: UNet2DCondition = load_folder(saved.path(), &Device::flex()).unwrap();
    assert_eq!(state_dict_params(&again).unwrap(), state_dict_params(&base).unwrap());
    // Weights also load under an adapter that is there already.
    let file = WeightFile::open(saved.path().join(WEIGHTS_FILE)).unwrap();
    assert_eq!(load_weights(unet.clone(), &file).unwrap().num_params(), unet.num_params());
}

#[test]
fn every_layer_of_the_state_dict_is_a_site() {
    let Some((mut unet, ..)) = case(&Device::flex()) else { return };
    let shapes = state_dict_shapes(&unet).into_iter();
    let mut wanted: Vec<_> = shapes.filter(|(_, shape)| shape.len() > 1).collect();
    let mut sites = Vec::new();
    unet.visit_sites("", &mut |site| sites.push((format!("{}.weight", site.path), site.weight.shape())));
    wanted.sort();
    sites.sort();
    assert_eq!(sites, wanted);
    assert!(unet.num_params() > 0);
}
