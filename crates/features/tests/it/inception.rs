//! Inception-v3 against torch-fidelity and pytorch-fid with golden weights, and the stand-in against its reference features.

use burn::tensor::{Device, Tensor, TensorData};
use features::{INCEPTION_SIZE, Inception, InceptionWeights, PixelCentres, resize_bilinear};
use nn::golden::golden_values;
use nn::weights::WeightError;

use crate::common::{assert_missing, file_of, from_bytes, host};
use crate::golden::{self, Golden};
use crate::npz;

/// What the reference's README allows without a resize and behind one.
const DIRECT: f32 = 1e-3;
const RESIZED: f32 = 1e-2;

fn network(io: &Golden) -> Inception {
    Inception::from_values(&Device::flex(), |name, shape| Ok(io.parameter(name, shape))).unwrap()
}

fn means(map: Tensor<4>) -> Tensor<2> {
    let [images, channels, height, width] = map.dims();
    ops::mean_dim(map.reshape([images, channels, height * width]), 2).reshape([images, channels])
}

#[test]
fn the_network_alone_agrees() {
    let Some(folder) = golden::folder("inception_fid") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let network = network(&io);
    let input = (from_bytes(io.bytes("direct/image_u8"), &Device::flex()) - 128.0) / 128.0;
    let maps = network.maps(input);
    let pooled = means(maps.mixed_7c);
    for (name, map) in [("64", maps.pool1), ("192", maps.pool2), ("768", maps.mixed_6e)] {
        io.check_absolute(&format!("direct/{name}"), &host(means(map)), DIRECT);
    }
    io.check_absolute("direct/2048", &host(pooled.clone()), DIRECT);
    let (unbiased, logits) = network.logits(pooled).unwrap();
    io.check_absolute("direct/logits_unbiased", &host(unbiased), DIRECT);
    io.check_absolute("direct/logits", &host(logits), DIRECT);
}

#[test]
fn both_packages_resizes_and_features_agree() {
    let Some(folder) = golden::folder("inception_fid") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let network = network(&io);
    let images = from_bytes(io.bytes("images_u8"), &Device::flex());

    let resized = resize_bilinear(images.clone(), [INCEPTION_SIZE; 2], PixelCentres::Corner);
    io.check_absolute("torch_fidelity/resized_0_255", &host(resized.clone()), 1e-4);
    let input = (resized - 128.0) / 128.0;
    io.check_absolute("torch_fidelity/network_input", &host(input.clone()), 1e-6);
    let pooled = means(network.maps(input).mixed_7c);
    io.check_absolute("torch_fidelity/2048", &host(pooled.clone()), RESIZED);
    io.check_absolute("torch_fidelity/logits", &host(network.logits(pooled).unwrap().1), RESIZED);

    let images = images / 255.0;
    let input = network.prepare(images.clone());
    io.check_absolute("pytorch_fid/resized_0_1", &host((input.clone() + 1.0) / 2.0), 1e-6);
    let maps = network.maps(input);
    for (name, map) in [("64", maps.pool1), ("192", maps.pool2), ("768", maps.mixed_6e)] {
        io.check_absolute(&format!("pytorch_fid/{name}_map"), &host(map.clone()), RESIZED);
        io.check_absolute(&format!("pytorch_fid/{name}_mean"), &host(means(map)), RESIZED);
    }
    io.check_absolute("pytorch_fid/2048_mean", &host(network.features(images.clone())), RESIZED);

    let pure = Inception::from_values(&Device::flex(), |name, shape| Ok(golden_values(name, shape))).unwrap();
    io.check_absolute("pure_golden/pytorch_fid/2048", &host(pure.features(images)), DIRECT);
}

#[test]
fn a_batch_gives_what_its_images_give() {
    let Some(folder) = golden::folder("inception_fid") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let network = network(&io);
    let images = from_bytes(io.bytes("images_u8"), &Device::flex()) / 255.0;
    let together = host(network.features(images.clone()));
    let alone = [0, 1].map(|at| host(network.features(images.clone().narrow(0, at, 1)))).concat();
    assert_eq!(together, alone);
}

#[test]
fn the_stand_in_agrees_with_its_reference() {
    let Some(weights) = golden::weights() else { return };
    let device = Device::flex();
    let network = Inception::load(weights.join("inception_v3_nsfwjs_u8.safetensors"), &device).unwrap();
    assert_eq!(network.weights(), InceptionWeights::Nsfwjs);
    let size = INCEPTION_SIZE;
    let value = |c: usize, y: usize, x: usize| ((7 * x + 13 * y + 29 * c) % 256) as f32 / 255.0;
    let pattern = (0..3 * size * size).map(|at| value(at / size / size, at / size % size, at % size)).collect();
    let pattern = Tensor::from_data(TensorData::new::<f32, _>(pattern, [1, 3, size, size]), &device);
    let features = host(network.features(pattern));
    let (_, expected) = npz::array(&weights.join("reference_features.npz"), "inception_nsfwjs/pattern299/pool2048");
    let largest = expected.iter().fold(0.0_f32, |max, value| max.max(value.abs()));
    let worst = expected.iter().zip(&features).map(|(e, a)| (e - a).abs() / largest).fold(0.0, f32::max);
    eprintln!("nsfwjs: error {worst:.1e} of the maximum");
    assert!(expected.len() == features.len() && worst <= 1e-3, "{worst}");
    assert!(network.logits(Tensor::zeros([1, 2048], &device)).is_none());
}

#[test]
fn names_are_those_of_the_published_file() {
    let device = Device::flex();
    let foreign = file_of("conv1.weight", &[1]);
    assert!(matches!(Inception::load(foreign.path(), &device), Err(WeightError::Layout { .. })));
    let Some(folder) = golden::folder("inception_fid") else { return };
    let present = "Conv2d_1a_3x3.conv.weight";
    let file = file_of(present, &[32, 3, 3, 3]);
    assert_missing(Inception::load(file.path(), &device).unwrap_err(), golden::manifest(&folder), present);
}
