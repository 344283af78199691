//! I3D against its PyTorch port with golden weights: every endpoint, both epsilons, odd sizes.

use burn::tensor::{Device, Tensor, TensorData};
use features::{I3D_MIN_FRAMES, I3D_SIZE, I3d, I3dEpsilon};
use nn::golden::golden_values;

use crate::common::{assert_missing, check_slope, file_of, host, stream};
use crate::golden::{self, Golden};

/// Of the maximum, what the reference's README allows.
const TOLERANCE: f32 = 1e-4;

/// `[N, T, H, W, 3]` of u8 as `[N, T, 3, H, W]` in [0, 1].
fn clip(io: &Golden, name: &str, device: &Device) -> Tensor<5> {
    let (shape, bytes) = io.bytes(&format!("{name}/clip_u8"));
    let shape: [usize; 5] = shape.try_into().unwrap();
    let values: Vec<f32> = bytes.into_iter().map(|byte| f32::from(byte) / 255.0).collect();
    Tensor::<5>::from_data(TensorData::new(values, shape), device).permute([0, 1, 4, 2, 3])
}

fn network(io: &Golden, epsilon: I3dEpsilon, device: &Device) -> I3d {
    I3d::from_values(epsilon, device, |name, shape| Ok(io.parameter(name, shape))).unwrap()
}

#[test]
fn every_endpoint_and_feature_agrees() {
    let Some(folder) = golden::folder("i3d_fvd") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex();
    let network = network(&io, I3dEpsilon::Port, &device);
    let clips: Vec<String> =
        io.names().iter().filter_map(|name| name.strip_suffix("/clip_u8").map(str::to_owned)).collect();
    assert!(!clips.is_empty());
    for name in clips {
        let input = I3d::prepare(clip(&io, &name, &device));
        io.check_absolute(&format!("{name}/input"), &host(input.clone()), 2e-6);
        let mut endpoints = 0;
        let features = network.forward(input, |stage, output| {
            io.check(&format!("{name}/endpoint/{stage}"), &host(output.clone()), TOLERANCE);
            endpoints += 1;
        });
        let stored = io.names().iter().filter(|stored| stored.starts_with(&format!("{name}/endpoint/"))).count();
        assert_eq!(endpoints, stored);
        io.check(&format!("{name}/pooled_1024"), &host(features.pooled), TOLERANCE);
        io.check(&format!("{name}/logits_400"), &host(features.logits), TOLERANCE);
    }
}

#[test]
fn the_original_epsilon_and_pure_golden_weights_agree() {
    let Some(folder) = golden::folder("i3d_fvd") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex();
    let features = network(&io, I3dEpsilon::TensorFlow, &device).features(clip(&io, "c1", &device));
    io.check("c1/pooled_1024_bn_eps_1e-3", &host(features.pooled), TOLERANCE);
    io.check("c1/logits_400_bn_eps_1e-3", &host(features.logits), TOLERANCE);
    let pure = I3d::from_values(I3dEpsilon::Port, &device, |name, shape| Ok(golden_values(name, shape))).unwrap();
    let features = pure.features(clip(&io, "c0", &device));
    io.check("pure_golden/c0/logits_400", &host(features.logits), TOLERANCE);
}

#[test]
fn the_gradient_with_respect_to_the_clip_agrees_with_central_differences() {
    let Some(folder) = golden::folder("i3d_fvd") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex().autodiff();
    let network = network(&io, I3dEpsilon::Port, &device);
    let start = stream("i3d clip", [1, I3D_MIN_FRAMES, 3, 16, 16], &device);
    // With golden weights the features change fast; a longer step would leave the linear range.
    check_slope(&start, 1.0 / 65536.0, 2e-2, |clip| network.features(clip).logits.square().mean());
}

#[test]
#[should_panic(expected = "I3D needs 9 frames")]
fn short_clips_are_refused() {
    let device = Device::flex();
    let network =
        I3d::from_values(I3dEpsilon::Port, &device, |_, shape| Ok(vec![0.0; shape.iter().product()])).unwrap();
    drop(network.forward(Tensor::zeros([1, 3, 8, I3D_SIZE, I3D_SIZE], &device), |_, _| ()));
}

#[test]
fn names_are_those_of_the_published_file() {
    let Some(folder) = golden::folder("i3d_fvd") else { return };
    let present = "logits.conv3d.bias";
    let file = file_of(present, &[400]);
    let error = I3d::load(file.path(), I3dEpsilon::Port, &Device::flex()).unwrap_err();
    assert_missing(error, golden::manifest(&folder), present);
}
