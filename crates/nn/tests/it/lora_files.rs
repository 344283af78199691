//! Adapter files: round trips, layouts of other tools, what is refused.

use std::collections::BTreeMap;
use std::path::Path;

use burn::tensor::Device;
use nn::lora::{self, LoraError, LoraLayout};
use nn::weights::{HostTensor, WeightError, WeightFile, named_params, write_safetensors};

use crate::lora::{Model, attach_trained, bits, everywhere, image, largest_difference};

fn saved(layout: LoraLayout, folder: &Path) -> (Model, std::path::PathBuf) {
    let mut model = attach_trained(Model::new(&Device::flex()), "style", &everywhere(3, 5.0));
    // A strength chosen for use is no part of the trained adapter.
    lora::set_weight(&mut model, "style", 0.25).unwrap();
    let path = folder.join("adapter.safetensors");
    let notes = BTreeMap::from([("step".to_owned(), "120".to_owned())]);
    lora::save(&model, "style", &path, ("unet", layout), &notes).unwrap();
    lora::set_weight(&mut model, "style", 1.0).unwrap();
    (model, path)
}

#[test]
fn files_come_back_bit_for_bit() {
    let device = Device::flex();
    for layout in [LoraLayout::Diffusers, LoraLayout::Peft, LoraLayout::PeftWholeModel] {
        let folder = tempfile::tempdir().unwrap();
        let (model, path) = saved(layout, folder.path());
        let file = WeightFile::open(&path).unwrap();
        assert_eq!(file.metadata()["step"], "120");
        assert_eq!(file.names().count(), 16);
        let loaded = lora::load(Model::new(&device), "other", &path, "unet").unwrap();
        assert_eq!(named_params(&loaded).unwrap(), named_params(&model).unwrap(), "{layout:?}");
        assert_eq!(bits(loaded.forward(image(&device))), bits(model.forward(image(&device))), "{layout:?}");
        assert_eq!(loaded.blocks[0].conv.lora.stack[0].scale(), 5.0 / 3.0);
    }
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(LoraLayout::Peft, folder.path());
    let file = WeightFile::open(path).unwrap();
    assert_eq!(file.shape("unet.blocks.0.conv.lora_A.weight"), Some([3, 3, 3, 3].as_slice()));
    assert_eq!(file.shape("unet.blocks.0.conv.lora_B.weight"), Some([3, 3, 1, 1].as_slice()));
    assert_eq!(file.shape("unet.blocks.1.to_out.0.lora_A.weight"), Some([3, 5].as_slice()));
}

/// The tensors of a saved adapter under other names.
fn renamed(path: &Path, rename: impl Fn(&str) -> String) -> Vec<(String, HostTensor)> {
    let file = WeightFile::open(path).unwrap();
    file.read_all().unwrap().into_iter().map(|(name, tensor)| (rename(&name), tensor)).collect()
}

#[test]
fn layouts_of_other_tools_are_read() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let (model, path) = saved(LoraLayout::Diffusers, folder.path());
    let want = bits(model.forward(image(&device)));
    let other = folder.path().join("other.safetensors");

    let kohya = |name: &str| {
        let (module, factor) = name.strip_prefix("unet.").unwrap().split_once(".lora.").unwrap();
        format!("lora_unet_{}.lora_{factor}", module.replace('.', "_"))
    };
    let mut tensors = renamed(&path, kohya);
    tensors.push(("lora_te_text_model_x.lora_up.weight".to_owned(), HostTensor::new(&[1, 1], vec![0.0])));
    let modules: Vec<String> =
        tensors.iter().filter_map(|(name, _)| Some(name.strip_suffix(".lora_up.weight")?.to_owned())).collect();
    let alphas = modules
        .iter()
        .filter(|m| !m.starts_with("lora_te"))
        .map(|m| (format!("{m}.alpha"), HostTensor::new(&[], vec![5.0])));
    let tensors: Vec<_> = tensors.iter().cloned().chain(alphas).collect();
    write_safetensors(&other, &tensors, &BTreeMap::new()).unwrap();
    let loaded = lora::load(Model::new(&device), "style", &other, "unet").unwrap();
    assert_eq!(bits(loaded.forward(image(&device))), want);

    // Without any alpha the scale is 1.
    write_safetensors(&other, &renamed(&path, str::to_owned), &BTreeMap::new()).unwrap();
    let mut loaded = lora::load(Model::new(&device), "style", &other, "unet").unwrap();
    assert_eq!(loaded.blocks[0].conv.lora.stack[0].scale(), 1.0);
    lora::set_weight(&mut loaded, "style", 5.0 / 3.0).unwrap();
    assert!(largest_difference(loaded.forward(image(&device)), model.forward(image(&device))) < 1e-6);
}

#[test]
fn every_difference_is_listed() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(LoraLayout::Peft, folder.path());
    let mut tensors = renamed(&path, str::to_owned);
    tensors.retain(|(name, _)| name != "unet.blocks.0.to_q.lora_B.weight");
    for (name, tensor) in &mut tensors {
        match name.as_str() {
            "unet.blocks.1.to_q.lora_A.weight" => *tensor = HostTensor::new(&[3, 7], vec![0.0; 21]),
            "unet.blocks.0.patches.lora_A.weight" => *name = "unet.blocks.0.depatches.lora_A.weight".to_owned(),
            _ => {}
        }
    }
    tensors.push(("unet.blocks.0.to_q.weight".to_owned(), HostTensor::new(&[1], vec![0.0])));
    let other = folder.path().join("other.safetensors");
    write_safetensors(&other, &tensors, &BTreeMap::new()).unwrap();
    let error = lora::load(Model::new(&device), "style", &other, "unet").unwrap_err();
    assert!(matches!(error, LoraError::Weights(WeightError::Mismatch(_))), "{error}");
    let lines: Vec<String> = error.to_string().lines().map(|line| line.trim().to_owned()).collect();
    assert_eq!(
        lines,
        [
            "weights do not fit: 2 missing, 2 unexpected, 1 of another shape",
            "missing     blocks.0.patches, matrix down (A) []",
            "missing     blocks.0.to_q, matrix up (B) []",
            "unexpected  unet.blocks.0.depatches.lora_A.weight",
            "unexpected  unet.blocks.0.to_q.weight",
            "shape       unet.blocks.1.to_q.lora_A.weight is [3, 7], the model needs [3, 6]",
            &format!("in: {}", other.display()),
        ]
    );
}

#[test]
fn settings_that_change_the_function_are_refused() {
    let device = Device::flex();
    let folder = tempfile::tempdir().unwrap();
    let (_, path) = saved(LoraLayout::PeftWholeModel, folder.path());
    let config = folder.path().join("adapter_config.json");
    for entry in
        [r#"{"use_rslora": true}"#, r#"{"use_dora": true}"#, r#"{"bias": "all"}"#, "[", r#"{"lora_alpha": "8"}"#]
    {
        std::fs::write(&config, entry).unwrap();
        let error = lora::load(Model::new(&device), "style", &path, "unet").unwrap_err();
        assert!(matches!(error, LoraError::Settings { .. }), "{entry}: {error}");
        assert!(error.to_string().ends_with(&config.display().to_string()), "{error}");
    }
    std::fs::write(&config, r#"{"lora_alpha": 6, "alpha_pattern": {"to_q": 9.0}, "bias": "none"}"#).unwrap();
    let model = lora::load(Model::new(&device), "style", &path, "unet").unwrap();
    assert_eq!(model.blocks[0].to_q.lora.stack[0].scale(), 3.0);
    assert_eq!(model.blocks[0].conv.lora.stack[0].scale(), 2.0);
    let (_, path) = saved(LoraLayout::Diffusers, folder.path());
    let error = lora::load(Model::new(&device), "style", &path, "text_encoder").unwrap_err();
    assert!(matches!(error, LoraError::Weights(WeightError::Layout { .. })), "{error}");
}
