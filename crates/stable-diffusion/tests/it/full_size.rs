//! Names, shapes and counts of the published networks, without their memory; sizes of the presets.

use burn::module::Module;
use burn::tensor::Device;
use flate2::read::GzDecoder;
use nn::Init;
use serde_json::Value;
use stable_diffusion::layout::{Network, state_dict_shapes};
use stable_diffusion::{AutoencoderKL, ControlNet, Preset, UNet2DCondition};

use crate::golden::{folder, json};

fn listed(manifest: &Value) -> Vec<(String, Vec<usize>)> {
    let shape = |value: &Value| value.as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
    let entry = |p: &Value| match p.as_array() {
        Some(pair) => (pair[0].as_str().unwrap().to_owned(), shape(&pair[1])),
        None => (p["name"].as_str().unwrap().to_owned(), shape(&p["shape"])),
    };
    let mut list: Vec<_> = manifest["parameters"].as_array().unwrap().iter().map(entry).collect();
    list.sort();
    list
}

fn check<N: Network>(manifest: &Value, preset: Option<&N::Config>)
where
    N::Config: PartialEq + std::fmt::Debug,
{
    let config = N::config_from_json(manifest["config"].as_object().unwrap()).unwrap();
    let network = N::build(&config, &mut Init::lazy(0, &Device::flex()));
    let mut ours = state_dict_shapes(&network);
    ours.sort();
    let theirs = listed(manifest);
    assert_eq!(ours, theirs);
    assert_eq!(network.num_params() as u64, manifest["parameter_count"].as_u64().unwrap());
    if let Some(preset) = preset {
        let mut network = state_dict_shapes(&N::build(preset, &mut Init::lazy(0, &Device::flex())));
        network.sort();
        assert_eq!(network, theirs);
        assert_eq!(N::config_to_json(preset), N::config_to_json(&config));
    }
}

#[test]
fn published_networks_have_these_names_and_shapes() {
    let Some(folder) = folder("full_size") else { return };
    let manifest = |name: &str| -> Value {
        let path = folder.join(format!("{name}.json.gz"));
        serde_json::from_reader(GzDecoder::new(std::fs::File::open(path).unwrap())).unwrap()
    };
    check::<UNet2DCondition>(&manifest("unet_sd15"), Some(&Preset::Sd15.unet()));
    check::<UNet2DCondition>(&manifest("unet_sd21"), Some(&Preset::Sd21.unet()));
    check::<ControlNet>(&manifest("controlnet_sd15"), Some(&Preset::Sd15.controlnet(3)));
    check::<ControlNet>(&manifest("controlnet_sd21"), Some(&Preset::Sd21.controlnet(3)));
    check::<AutoencoderKL>(&manifest("vae"), Some(&Preset::Sd15.vae()));
}

#[test]
fn small_networks_have_these_names_and_shapes() {
    for case in ["unet_sd15", "unet_sd21", "unet_sd21_in8"] {
        let Some(folder) = folder(case) else { return };
        check::<UNet2DCondition>(&json(&folder.join("manifest.json")), None);
    }
    for case in ["controlnet_3", "controlnet_19"] {
        let Some(folder) = folder(case) else { return };
        check::<ControlNet>(&json(&folder.join("manifest.json")), None);
    }
    let Some(folder) = folder("vae") else { return };
    check::<AutoencoderKL>(&json(&folder.join("manifest.json")), None);
}

#[test]
fn presets_have_their_sizes() {
    let count = |preset: Preset| {
        let mut init = Init::lazy(0, &Device::flex());
        let unet = UNet2DCondition::new(&preset.unet().checked().unwrap(), &mut init);
        let vae = AutoencoderKL::new(&preset.vae().checked().unwrap(), &mut init);
        let control = ControlNet::new(&preset.controlnet(3).checked().unwrap(), &mut init);
        assert_eq!(preset.vae().factor(), control.config().factor(), "{preset:?}: condition and picture have one size");
        [unet.num_params(), vae.num_params(), control.num_params()]
    };
    let sizes = Preset::ALL.map(|preset| (preset, count(preset)));
    eprintln!("{sizes:?}");
    assert_eq!(sizes[3].1, [859_520_964, 83_653_863, 361_279_120]);
    assert_eq!(sizes[4].1, [865_910_724, 83_653_863, 364_228_240]);
    assert_eq!((sizes[2].1[0] as f64 / 1e5).round(), 890.0);
    assert_eq!((sizes[1].1[0] as f64 / 1e4).round(), 149.0);
    assert_eq!((sizes[1].1[1] as f64 / 1e4).round(), 32.0);
    assert_eq!((sizes[0].1[0] as f64 / 1e4).round(), 5.0);
}

#[test]
fn skips_are_made_in_this_order() {
    let expected = [320, 320, 320, 320, 640, 640, 640, 1280, 1280, 1280, 1280, 1280];
    assert_eq!(Preset::Sd15.unet().encoder.skip_channels(), expected);
}
