//! VGG-16 against PyTorch with golden and with real weights, strict loading, gradients.

use std::collections::BTreeMap;
use std::path::PathBuf;

use burn::tensor::{Device, Tensor, TensorData};
use features::{Preprocessing, Tap, Vgg16};
use nn::golden::{golden_stream, golden_values};
use nn::weights::{HostTensor, WeightError, write_safetensors};

use crate::golden::{self, Golden};

const TAP_NAMES: [&str; 5] = ["relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3"];

/// Sums of up to 4608 f32 products; measured 1e-6 here, 2e-5 is what the reference's README allows.
const FEATURES: f32 = 2e-5;

/// Measured 2e-6 away from the kinks of ReLU and max pool.
const GRADIENTS: f32 = 1e-4;

fn golden_network(device: &Device) -> Vgg16 {
    Vgg16::from_values(Preprocessing::Torchvision, device, |name, shape| Ok(golden_values(name, shape))).unwrap()
}

fn host(tensor: Tensor<4>) -> Vec<f32> {
    tensor.try_into_vec_as().unwrap()
}

/// A stored u8 picture `[3, H, W]` as `[1, 3, H, W]` in [0, 1].
fn picture(io: &Golden, name: &str, device: &Device) -> Tensor<4> {
    let (shape, bytes) = io.bytes(name);
    let values: Vec<f32> = bytes.iter().map(|&byte| f32::from(byte) / 255.0).collect();
    Tensor::from_data(TensorData::new(values, [1, shape[0], shape[1], shape[2]]), device)
}

/// Per tap: unit-normalise over channels, squared difference, sum over channels, mean over pixels.
fn unit_loss(wanted: Vec<Tensor<4>>, found: Vec<Tensor<4>>) -> Tensor<1> {
    let unit = |f: Tensor<4>| f.clone() / (ops::sum_dim(f.square(), 1).sqrt() + 1e-10);
    let per_tap = wanted.into_iter().zip(found).map(|(w, f)| ops::sum_dim((unit(w) - unit(f)).square(), 1).mean());
    per_tap.reduce(|sum, tap| sum + tap).unwrap()
}

fn assert_close(name: &str, actual: f64, expected: f64, tolerance: f64) {
    eprintln!("{name}: {actual} against {expected}");
    assert!((actual / expected - 1.0).abs() <= tolerance, "{name}: {actual} against {expected}");
}

fn scalar(tensor: Tensor<1>) -> f64 {
    f64::from(tensor.try_into_vec_as::<f32>().unwrap()[0])
}

fn losses(folder: &std::path::Path) -> serde_json::Value {
    serde_json::from_str(&std::fs::read_to_string(folder.join("losses.json")).unwrap()).unwrap()
}

#[test]
fn golden_weights_give_the_reference_features_loss_and_gradient() {
    let Some(folder) = golden::folder("vgg16") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex().autodiff();
    let network = golden_network(&device);
    // Golden kernels keep the input's magnitude, so the reference feeds them caffe input scaled to about one.
    let features = |images| network.forward_preprocessed(Preprocessing::Caffe.apply(images) / 64.0, Tap::Relu5_3);

    let wanted = features(picture(&io, "crop_u8", &device));
    let mut checked = 0;
    for name in io.names() {
        let Some(tap) = name.strip_prefix("golden/features/crop/") else { continue };
        let index = TAP_NAMES.iter().position(|known| *known == tap).unwrap_or_else(|| panic!("tap {tap}"));
        io.check(&name, &host(wanted[index].clone()), FEATURES);
        checked += 1;
    }
    assert!(checked > 0, "no golden features");

    let prediction = picture(&io, "other_u8", &device).require_grad();
    let loss = unit_loss(wanted, features(prediction.clone()));
    assert_close("golden_unit", scalar(loss.clone()), losses(&folder)["golden_unit"].as_f64().unwrap(), 1e-4);
    let gradients = loss.backward();
    io.check_gradient("golden/gradient/unit", &host(prediction.grad(&gradients).unwrap()), GRADIENTS);
}

#[test]
fn real_weights_give_the_reference_features_losses_and_gradient() {
    let Some(weights) = std::env::var_os("RIGSCAPE_WEIGHTS").map(PathBuf::from) else {
        eprintln!("RIGSCAPE_WEIGHTS is not set: this test did not run");
        return;
    };
    let Some(folder) = golden::folder("vgg16") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex().autodiff();
    let network = Vgg16::load(weights.join("vgg16_conv_f16.safetensors"), &device).unwrap();
    assert_eq!(network.preprocessing(), Preprocessing::Caffe);

    let target = picture(&io, "crop_u8", &device);
    let prediction = picture(&io, "other_u8", &device).require_grad();
    let probe = Preprocessing::Caffe.apply(target.clone()).narrow(2, 0, 4).narrow(3, 0, 4);
    io.check("input_caffe_probe", &host(probe), 1e-6);

    let (wanted, found) =
        (network.forward(target.clone(), Tap::Relu5_3), network.forward(prediction.clone(), Tap::Relu5_3));
    for (tap, name) in TAP_NAMES.iter().enumerate() {
        io.check(&format!("features/crop/{name}"), &host(wanted[tap].clone()), FEATURES);
        io.check(&format!("features/other/{name}"), &host(found[tap].clone()), FEATURES);
    }

    let expected = losses(&folder);
    let loss = network.perceptual_loss(target.clone(), prediction.clone(), Tap::Relu5_3);
    assert_close("mse", scalar(loss.clone()), expected["total_f64"]["mse"].as_f64().unwrap(), 1e-4);
    let gradient = host(prediction.grad(&loss.backward()).unwrap());
    io.check_gradient("gradient/mse", &gradient, GRADIENTS);
    io.check_gradient("gradient_f64/mse", &gradient, GRADIENTS);

    let mut partial = 0.0;
    for (tap, name) in Tap::ALL.into_iter().zip(TAP_NAMES) {
        partial += expected["per_tap"]["mse"][name].as_f64().unwrap();
        let loss = network.perceptual_loss(target.clone(), prediction.clone(), tap);
        assert_close(&format!("mse up to {name}"), scalar(loss), partial, 1e-4);
    }
    let unit = unit_loss(wanted, found);
    assert_close("unit", scalar(unit.clone()), expected["total_f64"]["unit"].as_f64().unwrap(), 1e-4);
    io.check_gradient("gradient/unit", &host(prediction.grad(&unit.backward()).unwrap()), GRADIENTS);
}

fn stream_image(name: &str, shape: [usize; 4], device: &Device) -> Tensor<4> {
    let values = golden_stream(name, shape.iter().product());
    Tensor::from_data(TensorData::new(values.iter().map(|&x| (0.5 + 0.5 * x) as f32).collect(), shape), device)
}

#[test]
fn taps_stop_early_and_halve_the_size_rounding_down() {
    let device = Device::flex();
    let network = golden_network(&device);
    let images = stream_image("image", [2, 3, 9, 17], &device);
    let shapes: Vec<_> = network.forward(images.clone(), Tap::Relu4_3).iter().map(Tensor::dims).collect();
    assert_eq!(shapes, [[2, 64, 9, 17], [2, 128, 4, 8], [2, 256, 2, 4], [2, 512, 1, 2]]);
    assert_eq!(network.forward(images.clone(), Tap::Relu1_2).len(), 1);
    assert_eq!(scalar(network.perceptual_loss(images.clone(), images, Tap::Relu3_3)), 0.0);
}

#[test]
fn the_gradient_agrees_with_central_differences() {
    let device = Device::flex().autodiff();
    let network = golden_network(&device);
    let shape = [1, 3, 8, 8];
    let (target, start) = (stream_image("target", shape, &device), stream_image("prediction", shape, &device));
    let loss_at = |images| network.perceptual_loss(target.clone(), images, Tap::Relu3_3);

    let leaf = start.clone().require_grad();
    let gradient = leaf.grad(&loss_at(leaf.clone()).backward()).unwrap();
    // Along the gradient's signs the slope is as far above the loss's f32 rounding as it can be.
    let direction = Tensor::from_inner(gradient.clone().sign());
    let analytic = scalar(gradient.abs().sum());
    let step = 1.0 / 1024.0;
    let ahead = scalar(loss_at(start.clone() + direction.clone() * step));
    let behind = scalar(loss_at(start - direction * step));
    assert_close("slope", (ahead - behind) / (2.0 * step), analytic, 5e-3);
}

#[test]
fn only_the_prediction_gets_a_gradient_and_plain_images_stay_plain() {
    let device = Device::flex().autodiff();
    let network = golden_network(&device);
    let target = stream_image("target", [1, 3, 4, 4], &device).require_grad();
    let prediction = stream_image("prediction", [1, 3, 4, 4], &device).require_grad();
    let loss = network.perceptual_loss(target.clone(), prediction.clone(), Tap::Relu1_2);
    let gradients = loss.backward();
    assert!(prediction.grad(&gradients).is_some());
    assert!(target.grad(&gradients).is_none());
    let plain = network.perceptual_loss(target.inner(), prediction.inner(), Tap::Relu1_2);
    assert!(!plain.is_autodiff());
}

#[test]
fn torchvision_preprocessing_is_the_imagenet_normalisation() {
    let image = Tensor::<4>::from_floats([[[[0.485]], [[1.0]], [[0.0]]]], &Device::flex());
    let values = host(Preprocessing::Torchvision.apply(image));
    for (value, expected) in values.iter().zip([0.0, 0.544 / 0.224, -0.406 / 0.225]) {
        assert!((value - expected).abs() < 1e-6, "{values:?}");
    }
}

fn file_with(tensors: &[(&str, &[usize])]) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    let named =
        |(name, shape): &(&str, &[usize])| ((*name).to_owned(), HostTensor::new(shape, golden_values(name, shape)));
    write_safetensors(file.path(), &tensors.iter().map(named).collect::<Vec<_>>(), &BTreeMap::new()).unwrap();
    file
}

#[test]
fn incomplete_and_foreign_files_are_refused_with_every_name() {
    let device = Device::flex();
    let file = file_with(&[
        ("features.0.weight", &[64, 3, 3, 3]),
        ("features.0.bias", &[63]),
        ("features.1.weight", &[64]),
        ("classifier.0.bias", &[4]),
    ]);
    let error = Vgg16::load(file.path(), &device).unwrap_err();
    assert!(error.to_string().ends_with(&file.path().display().to_string()), "{error}");
    let WeightError::Mismatch(mismatch) = error else { panic!("{error}") };
    assert_eq!(mismatch.missing.len(), 24);
    assert!(mismatch.missing.contains(&("features.28.weight".to_owned(), vec![512, 512, 3, 3])));
    assert_eq!(mismatch.unexpected, ["features.1.weight"]);
    assert_eq!(mismatch.wrong_shape, [("features.0.bias".to_owned(), vec![64], vec![63])]);

    let file = file_with(&[("conv1.weight", &[64, 3, 3, 3])]);
    assert!(matches!(Vgg16::load(file.path(), &device), Err(WeightError::Layout { .. })));
}
