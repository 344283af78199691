//! Checkpoints in the public code's form: read, painted with, and the published size's parameters.

use burn::tensor::Device;
use nn::Init;
use nn::golden::golden_values_with_gains;
use nn::weights::named_params;
use serde_json::Value;
use vae::official::{OfficialCheckpoint, OfficialError, is_ignored, official_name};
use vae::{BevVae, BevVaeConfig};

use crate::golden::{Golden, folder, json};
use crate::lightning::{Averaged, Named, checkpoint, compressed};
use crate::official::{TOLERANCE, config_of, images, matrices, number, parameters_match_the_manifest};

/// Every official parameter with golden values, buffers included, in the file's order.
fn golden_state(manifest: &Value) -> Vec<Named> {
    let parameters = manifest["parameters"].as_array().unwrap().iter();
    parameters
        .map(|p| {
            let shape: Vec<usize> = p["shape"].as_array().unwrap().iter().map(number).collect();
            let name = p["name"].as_str().unwrap().to_owned();
            (name.clone(), shape.clone(), golden_values_with_gains(&name, &shape, &[".scale"]))
        })
        .collect()
}

#[test]
fn a_checkpoint_of_the_golden_weights_paints_the_golden_pictures() {
    let Some(folder) = folder("bev_vae_official") else { return };
    let golden = Golden::open(&folder, "io.safetensors");
    let (cases, manifest) = (json(&folder.join("cases.json")), json(&folder.join("manifest.json")));
    let device = Device::flex();
    for case in manifest.as_object().unwrap().keys() {
        let config = config_of(&cases[case]).checked().unwrap();
        let mut average = golden_state(&manifest[case]);
        // The weights of the last step are others, so that a mistaken source shows.
        let current: Vec<Named> = average
            .iter()
            .map(|(name, shape, values)| (name.clone(), shape.clone(), vec![0.5; values.len()]))
            .collect();
        average.retain(|(name, ..)| !is_ignored(name));
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), checkpoint(&current, &Averaged::List(&average))).unwrap();
        let empty = BevVae::new(&config, &mut Init::new(0, &device));
        let opened = OfficialCheckpoint::open(file.path(), &empty).unwrap();
        assert_eq!(opened.report().taken(), average.len());
        let model = opened.averaged(empty).unwrap();
        elsewhere(&config, &current, &average);

        let batch = number(&cases[case]["batch"]);
        let (encode, decode) = matrices(&golden, case, batch, &device);
        let latent = model.encode(images(&golden, case, batch, &device), &encode).mean;
        golden.check(&format!("{case}/latent/mean"), latent.clone(), TOLERANCE);
        let worst = golden.check(&format!("{case}/dec/image/out"), model.decode(latent, &decode).images, TOLERANCE);
        eprintln!("{case}: painted with imported weights, largest difference {worst:.1e}");
    }
}

/// The same averages in other places, none, and a file that torch would not write.
fn elsewhere(config: &BevVaeConfig, current: &[Named], average: &[Named]) {
    let empty = || BevVae::new(config, &mut Init::lazy(0, &Device::flex()));
    let file = tempfile::NamedTempFile::new().unwrap();
    let open = |bytes: Vec<u8>| {
        std::fs::write(file.path(), bytes).unwrap();
        OfficialCheckpoint::open(file.path(), &empty())
    };
    for averaged in [Averaged::Callback(average), Averaged::StateDict(average)] {
        let model = open(checkpoint(current, &averaged)).unwrap().averaged(empty()).unwrap();
        for (path, tensor) in named_params(&model).unwrap() {
            let golden = average.iter().find(|(name, ..)| *name == official_name(&path)).unwrap();
            assert!(tensor.data == golden.2, "{path}");
        }
    }
    let without = open(checkpoint(current, &Averaged::Absent)).unwrap();
    assert!(
        matches!(without.averaged(empty()), Err(OfficialError::NoAverage { places, .. }) if places == ["state_dict"])
    );
    assert!(matches!(open(compressed(current)), Err(OfficialError::Weights(_))));
}

/// The published size: names, shapes and the order of the averages' list.
#[test]
fn the_paper_preset_has_the_released_parameters() {
    let Some(folder) = folder("bev_vae_official") else { return };
    let file = std::fs::File::open(folder.join("manifest_full.json.gz")).unwrap();
    let manifest: Value = serde_json::from_reader(flate2::read::GzDecoder::new(file)).unwrap();
    parameters_match_the_manifest(&vae::Preset::Paper.config(), &manifest);
    let order: Vec<&str> =
        manifest["ema_order"].as_array().unwrap().iter().map(|name| name.as_str().unwrap()).collect();
    let parameters = manifest["parameters"].as_array().unwrap().iter();
    let names: Vec<&str> = parameters.map(|p| p["name"].as_str().unwrap()).filter(|name| !is_ignored(name)).collect();
    let of = |module: &'static str| names.iter().copied().filter(move |name| name.starts_with(module));
    let listed: Vec<&str> = ["encoder.", "decoder.", "pre_quant.", "post_quant."].into_iter().flat_map(of).collect();
    assert_eq!(listed, order);
}
