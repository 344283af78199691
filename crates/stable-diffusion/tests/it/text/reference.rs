//! Reference outputs and weights of text encoders.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use burn::tensor::{Device, Tensor};
use nn::golden::golden_values;
use nn::weights::{HostTensor, WeightFile, write_safetensors};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use stable_diffusion::text::{BytePairs, TokenBatch};

/// The end token of all published encoders.
pub const END: u32 = 49_407;

/// A folder below the one that a variable names. Without the variable there is none; with it a missing folder is a
/// failure.
fn below(variable: &str, name: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os(variable) else {
        eprintln!("did not run: {variable} is not set");
        return None;
    };
    let path = PathBuf::from(root).join(name);
    assert!(path.exists(), "{variable} has no {name}");
    Some(path)
}

pub fn golden(name: &str) -> Option<PathBuf> {
    below("RIGSCAPE_GOLDEN", name)
}

/// CLIP's table of merges.
pub fn table() -> Option<BytePairs> {
    Some(BytePairs::from_table(&below("RIGSCAPE_WEIGHTS", "bpe_simple_vocab_16e6.txt.gz")?).unwrap())
}

pub fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Shape and values of an integer tensor.
pub fn integers(file: &Path, name: &str) -> (Vec<usize>, Vec<u32>) {
    let bytes = std::fs::read(file).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let view = file.tensor(name).unwrap();
    assert_eq!(view.dtype(), Dtype::I64, "{name}");
    let value = |b: &[u8]| u32::try_from(i64::from_le_bytes(b.try_into().unwrap())).unwrap();
    (view.shape().to_vec(), view.data().chunks_exact(8).map(value).collect())
}

pub fn input_ids(file: &Path, end: u32) -> TokenBatch {
    let (shape, ids) = integers(file, "input_ids");
    TokenBatch::new(ids, shape[1], end)
}

/// Names and shapes of a manifest, in its order.
pub fn manifest(value: &Value) -> Vec<(String, Vec<usize>)> {
    let shape = |value: &Value| value.as_array().unwrap().iter().map(|n| n.as_u64().unwrap() as usize).collect();
    let entry = |p: &Value| match p.as_array() {
        Some(pair) => (pair[0].as_str().unwrap().to_owned(), shape(&pair[1])),
        None => (p["name"].as_str().unwrap().to_owned(), shape(&p["shape"])),
    };
    value["parameters"].as_array().unwrap().iter().map(entry).collect()
}

/// Golden weights for names and shapes.
pub fn golden_weights(parameters: &[(String, Vec<usize>)]) -> BTreeMap<String, HostTensor> {
    let filled =
        |(name, shape): &(String, Vec<usize>)| (name.clone(), HostTensor::new(shape, golden_values(name, shape)));
    parameters.iter().map(filled).collect()
}

/// A text encoder's folder from a config and weights.
pub fn write_folder(folder: &Path, config: &Value, weights: &BTreeMap<String, HostTensor>) {
    std::fs::write(folder.join("config.json"), config.to_string()).unwrap();
    let weights: Vec<_> = weights.iter().map(|(name, tensor)| (name.clone(), tensor.clone())).collect();
    write_safetensors(folder.join("model.safetensors"), &weights, &BTreeMap::new()).unwrap();
}

/// Compares with a golden tensor; returns the largest difference over max(1, largest value).
pub fn check<const D: usize>(file: &WeightFile, name: &str, got: Tensor<D>, tolerance: f32) -> f32 {
    let want = file.tensor(name).unwrap();
    assert_eq!(got.dims().as_slice(), want.shape, "{name}: shape");
    let got: Vec<f32> = got.into_data().iter::<f32>().collect();
    let scale = want.data.iter().fold(1.0_f32, |scale, v| scale.max(v.abs()));
    let larger = |a: f32, b: f32| if b > a || b.is_nan() { b } else { a };
    let off = got.iter().zip(&want.data).map(|(a, b)| (a - b).abs()).fold(0.0, larger) / scale;
    eprintln!("{name}: off by {off:.1e}");
    assert!(off <= tolerance, "{name}: off by {off:e}");
    off
}

pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

pub fn device() -> Device {
    Device::flex()
}
