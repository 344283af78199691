//! Adapter files of diffusers and PEFT, and the weights that they merge into.

use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::tensor::Device;
use nn::golden::golden_values;
use nn::lora::{self, LoraSites, Site};
use nn::weights::{WeightFile, fill_params};
use nn::{Bias, Init, Linear};
use serde_json::Value;

/// Layers under any paths.
#[derive(Module, Debug)]
struct Named {
    layers: Vec<Linear>,
    #[module(skip)]
    paths: Vec<String>,
}

impl LoraSites for Named {
    fn visit_sites(&mut self, _path: &str, visit: &mut dyn FnMut(Site<'_>)) {
        for (layer, path) in self.layers.iter_mut().zip(&self.paths) {
            layer.visit_sites(path, visit);
        }
    }
}

/// Without `RIGSCAPE_GOLDEN` an absent folder is none, with it a failure.
fn folder() -> Option<PathBuf> {
    let (root, required) = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => (PathBuf::from(root), true),
        None => (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"), false),
    };
    let folder = root.join("lora");
    if folder.is_dir() {
        return Some(folder);
    }
    assert!(!required, "RIGSCAPE_GOLDEN has no folder lora");
    eprintln!("golden folder lora is absent and RIGSCAPE_GOLDEN is not set: this test did not run");
    None
}

/// The adapted layers of the golden network, with golden weights under its names.
fn layers(folder: &Path) -> Named {
    let manifest: Value = serde_json::from_slice(&std::fs::read(folder.join("manifest.json")).unwrap()).unwrap();
    let parameters = manifest["parameters"].as_array().unwrap();
    let size = |p: &Value, axis: usize| p["shape"][axis].as_u64().unwrap() as usize;
    let mut init = Init::new(0, &Device::flex());
    let mut named = Named { layers: vec![], paths: vec![] };
    for pair in parameters.chunks_exact(2) {
        let name = pair[0]["name"].as_str().unwrap();
        let path = name.strip_prefix("unet.").unwrap().strip_suffix(".lora.down.weight").unwrap();
        named.paths.push(path.to_owned());
        named.layers.push(Linear::new(size(&pair[0], 1), size(&pair[1], 0), Bias::Without, &mut init));
    }
    let paths = named.paths.clone();
    let golden = |path: &str, shape: &[usize]| {
        let index: usize = path.split('.').nth(1).unwrap().parse().unwrap();
        Ok(golden_values(&format!("{}.weight", paths[index]), shape))
    };
    fill_params(named, golden).unwrap()
}

#[test]
fn both_layouts_load_and_merge_as_the_reference() {
    let Some(folder) = folder() else { return };
    let io = WeightFile::open(folder.join("io.safetensors")).unwrap();
    let rank_and_alpha = |named: &mut Named| {
        let mut found = Vec::new();
        named.visit_sites("", &mut |site| found.extend(site.lora.stack.iter().map(|a| (a.rank(), a.alpha()))));
        found
    };
    for (layout, alpha) in [("plain", 4.0), ("with_metadata", 8.0)] {
        let path = folder.join(layout).join("pytorch_lora_weights.safetensors");
        let mut named = lora::load(layers(&folder), "style", &path, "unet").unwrap();
        assert_eq!(rank_and_alpha(&mut named), vec![(4, alpha); named.layers.len()], "{layout}");
        // The plain layout carries no alpha; the adapter was trained with alpha 8.
        lora::set_weight(&mut named, "style", 8.0 / alpha).unwrap();
        lora::merge(&mut named);
        let mut checked = 0;
        let paths = named.paths.clone();
        for (layer, path) in named.layers.iter().zip(&paths) {
            let name = format!("merged_weight/{path}.weight");
            if io.shape(&name).is_none() {
                continue;
            }
            let got: Vec<f32> = layer.lora.matrix(&layer.weight).into_data().iter::<f32>().collect();
            let want = io.tensor(&name).unwrap().data;
            let off = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            eprintln!("{layout}: {path} off by {off:.1e}");
            assert!(got.len() == want.len() && off <= 1e-6, "{path}: {off}");
            checked += 1;
        }
        assert_eq!(checked, 3);
    }
}

#[test]
fn factors_are_golden_init_and_are_written_as_they_were_read() {
    let Some(folder) = folder() else { return };
    let plain = WeightFile::open(folder.join("plain/pytorch_lora_weights.safetensors")).unwrap();
    for name in plain.names() {
        let tensor = plain.tensor(name).unwrap();
        assert_eq!(tensor.data, golden_values(name, &tensor.shape), "{name}");
    }
    let out = tempfile::tempdir().unwrap();
    for (layout, kind) in [("plain", lora::LoraLayout::Diffusers), ("with_metadata", lora::LoraLayout::Peft)] {
        let theirs = folder.join(layout).join("pytorch_lora_weights.safetensors");
        let named = lora::load(layers(&folder), "style", &theirs, "unet").unwrap();
        let ours = out.path().join("pytorch_lora_weights.safetensors");
        lora::save(&named, "style", &ours, ("unet", kind), &Default::default()).unwrap();
        let (ours, theirs) = (WeightFile::open(ours).unwrap(), WeightFile::open(theirs).unwrap());
        assert_eq!(ours.read_all().unwrap(), theirs.read_all().unwrap(), "{layout}");
        assert!(ours.names().count() == 2 * named.layers.len());
        let settings: Value = serde_json::from_str(&ours.metadata()["lora_adapter_metadata"]).unwrap();
        assert_eq!(settings["unet.r"], 4);
        assert_eq!(settings["unet.lora_alpha"], if layout == "plain" { 4 } else { 8 });
    }
}
