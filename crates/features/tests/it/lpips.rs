//! LPIPS against the package `lpips`, as wiring: its heads on kernels that they were not trained on.

use burn::tensor::{Device, Tensor};
use features::{Lpips, LpipsBackbone, SqueezeNet, Vgg16};
use nn::weights::WeightError;

use crate::common::{check_slope, file_of, from_bytes, host, stream};
use crate::golden::{self, Golden};

const HEADS: &str = "lpips_linear_heads_v0.1.safetensors";

fn picture(io: &Golden, name: &str, device: &Device) -> Tensor<4> {
    let (shape, bytes) = io.bytes(name);
    from_bytes(([vec![1], shape].concat(), bytes), device) / 255.0
}

#[test]
fn the_vgg_distance_and_its_gradient_agree() {
    let (Some(weights), Some(folder)) = (golden::weights(), golden::folder("vgg16")) else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex().autodiff();
    let backbone = LpipsBackbone::Vgg(Vgg16::load(weights.join("vgg16_conv_f16.safetensors"), &device).unwrap());
    assert!(!backbone.fits_the_heads());
    let lpips = Lpips::load(backbone, weights.join(HEADS), &device).unwrap();
    let (a, b) = (picture(&io, "crop_u8", &device), picture(&io, "other_u8", &device).require_grad());
    let distance = lpips.forward(a.clone(), b.clone());
    let text = std::fs::read_to_string(folder.join("losses.json")).unwrap();
    let losses: serde_json::Value = serde_json::from_str(&text).unwrap();
    let expected = losses["lpips_package"]["value_f64"].as_f64().unwrap();
    let found = f64::from(host(distance.clone())[0]);
    eprintln!("lpips: {found} against {expected}");
    assert!((found / expected - 1.0).abs() <= 1e-4, "{found} against {expected}");
    let gradient = host(b.grad(&distance.sum().backward()).unwrap());
    io.check_gradient("gradient/lpips_package", &gradient, 2e-3);

    let back = host(lpips.forward(b.clone(), a.clone()))[0];
    assert!((f64::from(back) - found).abs() < 1e-6, "{back}: not symmetric");
    assert_eq!(host(lpips.forward(a.clone(), a.clone())), [0.0]);
    let both = host(lpips.forward(Tensor::cat(vec![a.clone(), b.clone()], 0), Tensor::cat(vec![a, b.clone()], 0)));
    assert_eq!(both, [0.0, 0.0]);
}

#[test]
fn the_squeezenet_distance_is_zero_only_for_equal_images_and_has_a_gradient() {
    let Some(weights) = golden::weights() else { return };
    let device = Device::flex().autodiff();
    let backbone = SqueezeNet::load(weights.join("squeezenet1_1_imagenet_ndf.safetensors"), &device).unwrap();
    let lpips = Lpips::load(LpipsBackbone::Squeeze(Box::new(backbone)), weights.join(HEADS), &device).unwrap();
    assert_eq!(lpips.backbone().name(), "squeeze");
    let (a, b) = (stream("a", [2, 3, 32, 40], &device), stream("b", [2, 3, 32, 40], &device));
    assert_eq!(host(lpips.forward(a.clone(), a.clone())), [0.0, 0.0]);
    assert!(host(lpips.forward(a.clone(), b.clone())).iter().all(|distance| *distance > 1e-3));
    let one = |images: Tensor<4>| images.narrow(0, 0, 1);
    check_slope(&one(b), 1.0 / 4096.0, 3e-2, |images| lpips.forward(one(a.clone()), images));
    // Black images have features that are zero everywhere; the gradient stays finite.
    let black = Tensor::zeros([1, 3, 32, 40], &device).require_grad();
    let gradients = lpips.forward(one(a.clone()), black.clone()).sum().backward();
    assert!(host(black.grad(&gradients).unwrap()).iter().all(|slope| slope.is_finite()));
}

#[test]
fn heads_of_another_size_or_network_are_refused() {
    let device = Device::flex();
    let network = || {
        let values = |_: &str, shape: &[usize]| Ok(vec![0.0; shape.iter().product()]);
        LpipsBackbone::Squeeze(Box::new(
            SqueezeNet::from_values(features::Preprocessing::Caffe, &device, values).unwrap(),
        ))
    };
    let small = file_of("lin0.model.1.weight", &[1, 63, 1, 1]);
    assert!(matches!(Lpips::load(network(), small.path(), &device), Err(WeightError::Layout { .. })));
    let other = file_of("vgg.lin0.model.1.weight", &[1, 64, 1, 1]);
    let error = Lpips::load(network(), other.path(), &device).unwrap_err();
    assert!(
        matches!(&error, WeightError::MissingTensor { name, .. } if name == "squeeze.lin0.model.1.weight"),
        "{error}"
    );
}
