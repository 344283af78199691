//! Pixel values inside and outside the network: [0, 1] RGB and ImageNet-normalised RGB. One function each way.

use burn::tensor::{Device, Tensor, TensorData};

/// ImageNet mean of R, G, B.
pub const MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// ImageNet standard deviation of R, G, B.
pub const STD: [f32; 3] = [0.229, 0.224, 0.225];

fn per_channel(values: [f32; 3], device: &Device) -> Tensor<5> {
    Tensor::from_data(TensorData::new(values.to_vec(), [1, 1, 3, 1, 1]), device)
}

/// `[B, V, 3, H, W]` in [0, 1] to network values.
pub fn normalise(rgb: Tensor<5>) -> Tensor<5> {
    let device = rgb.device();
    (rgb - per_channel(MEAN, &device)) / per_channel(STD, &device)
}

/// Network values to `[B, V, 3, H, W]` RGB, not clamped: losses see what the network says, metrics clamp.
pub fn denormalise(values: Tensor<5>) -> Tensor<5> {
    let device = values.device();
    values * per_channel(STD, &device) + per_channel(MEAN, &device)
}
