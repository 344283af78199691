//! SqueezeNet and EfficientNet-Lite0 against their reference features, strict names, gradients.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};
use features::{EFFICIENTNET_SIZE, EfficientNetLite0, Preprocessing, SqueezeNet};
use nn::golden::golden_values;
use nn::weights::WeightError;

use crate::common::{check_slope, file_of, host, stream};
use crate::golden;
use crate::npz;

/// The picture with value (7 x + 13 y + 29 c) mod 256.
fn pattern(size: usize, device: &Device) -> Tensor<4> {
    let value = |c: usize, y: usize, x: usize| ((7 * x + 13 * y + 29 * c) % 256) as f32 / 255.0;
    let values = (0..3 * size * size).map(|at| value(at / size / size, at / size % size, at % size)).collect();
    Tensor::from_data(TensorData::new::<f32, _>(values, [1, 3, size, size]), device)
}

fn check(weights: &std::path::Path, name: &str, actual: &[f32]) {
    let (_, expected) = npz::array(&weights.join("reference_features.npz"), name);
    assert_eq!(expected.len(), actual.len(), "{name}");
    let largest = expected.iter().fold(0.0_f32, |max, value| max.max(value.abs()));
    let worst = expected.iter().zip(actual).map(|(e, a)| (e - a).abs() / largest).fold(0.0, f32::max);
    eprintln!("{name}: error {worst:.1e} of the maximum");
    assert!(worst <= 1e-3, "{name}: error {worst} of the maximum");
}

#[test]
fn squeezenet_agrees_with_its_reference() {
    let Some(weights) = golden::weights() else { return };
    let device = Device::flex();
    let network = SqueezeNet::load(weights.join("squeezenet1_1_imagenet_ndf.safetensors"), &device).unwrap();
    assert_eq!(network.preprocessing(), Preprocessing::Caffe);
    let (pooled, logits) = network.pooled_and_logits(pattern(224, &device));
    check(&weights, "squeezenet1_1/pattern224/pool512", &host(pooled));
    check(&weights, "squeezenet1_1/pattern224/logits1000", &host(logits));
    let channels: Vec<_> = network.taps(pattern(64, &device)).iter().map(|tap| tap.dims()[1]).collect();
    assert_eq!(channels, [64, 128, 256, 384, 384, 512, 512]);
}

#[test]
fn efficientnet_agrees_with_its_reference() {
    let Some(weights) = golden::weights() else { return };
    let device = Device::flex();
    let network = EfficientNetLite0::load(weights.join("efficientnet_lite0_imagenet.safetensors"), &device).unwrap();
    let features = network.features(pattern(EFFICIENTNET_SIZE, &device));
    check(&weights, "efficientnet_lite0/pattern224/pool1280", &host(features.clone()));
    check(&weights, "efficientnet_lite0/pattern224/logits1000", &host(network.logits(features)));
}

#[test]
fn gradients_with_respect_to_the_image_agree_with_central_differences() {
    let Some(weights) = golden::weights() else { return };
    let device = Device::flex().autodiff();
    let squeeze = SqueezeNet::load(weights.join("squeezenet1_1_imagenet_ndf.safetensors"), &device).unwrap();
    let start = stream("squeeze", [1, 3, 32, 32], &device);
    check_slope(&start, 1.0 / 4096.0, 2e-2, |images| squeeze.taps(images)[3].clone().square().mean());
    let efficient = EfficientNetLite0::load(weights.join("efficientnet_lite0_imagenet.safetensors"), &device).unwrap();
    let start = stream("efficient", [1, 3, 64, 64], &device);
    check_slope(&start, 1.0 / 4096.0, 2e-2, |images| efficient.pooled(images).square().mean());
}

#[test]
fn torchvision_names_and_rounding_up() {
    let device = Device::flex();
    let mut names = BTreeMap::new();
    let network = SqueezeNet::from_values(Preprocessing::Torchvision, &device, |name, shape| {
        names.insert(name.to_owned(), shape.to_vec());
        Ok(golden_values(name, shape))
    });
    assert_eq!(names.len(), 52);
    for (name, shape) in [
        ("features.0.weight", vec![64, 3, 3, 3]),
        ("features.7.expand3x3.weight", vec![128, 32, 3, 3]),
        ("features.12.squeeze1x1.bias", vec![64]),
        ("classifier.1.weight", vec![1000, 512, 1, 1]),
    ] {
        assert_eq!(names[name], shape, "{name}");
    }
    // 33 → 16 after the first convolution; torchvision's ceil mode then gives 8, the other layout 7.
    let images = stream("ceil", [1, 3, 33, 33], &device);
    assert_eq!(network.unwrap().taps(images.clone())[1].dims(), [1, 128, 8, 8]);
    let caffe = SqueezeNet::from_values(Preprocessing::Caffe, &device, |name, shape| Ok(golden_values(name, shape)));
    assert_eq!(caffe.unwrap().taps(images)[1].dims(), [1, 128, 7, 7]);
}

#[test]
fn foreign_files_are_refused() {
    let (device, file) = (Device::flex(), file_of("fc.weight", &[3]));
    assert!(matches!(SqueezeNet::load(file.path(), &device), Err(WeightError::Layout { .. })));
    let WeightError::Mismatch(mismatch) = EfficientNetLite0::load(file.path(), &device).unwrap_err() else {
        panic!("loaded")
    };
    assert_eq!(mismatch.unexpected, ["fc.weight"]);
    assert!(mismatch.missing.contains(&("_blocks.15._project_conv.weight".to_owned(), vec![320, 1152, 1, 1])));
}
