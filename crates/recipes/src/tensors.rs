//! Where host arrays become tensors; nothing before this knows a device, nothing after it a dataset.

use burn::tensor::{Bool, Device, Tensor, TensorData};
use data::ViewArrays;
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use vae::ViewMatrices;

/// Pictures `[B, V, 3, H, W]`, RGB in [0, 1].
pub fn pictures(arrays: &ViewArrays, device: &Device) -> Tensor<5> {
    let shape = [arrays.batch, arrays.views, 3, arrays.height, arrays.width];
    Tensor::from_data(TensorData::new(arrays.images.clone(), shape), device)
}

/// `[B, V]`, true where the rig has a camera.
pub fn view_mask(arrays: &ViewArrays, device: &Device) -> Tensor<2, Bool> {
    Tensor::from_data(TensorData::new(arrays.mask.clone(), [arrays.batch, arrays.views]), device)
}

/// `[B, V, 1, H, W]`, 1 where a pixel counts, else 0; `None` when every pixel of every camera does.
pub fn counted_pixels(arrays: &ViewArrays, device: &Device) -> Option<Tensor<5>> {
    let values = || arrays.pixel_mask.iter().map(|counts| f32::from(u8::from(*counts))).collect::<Vec<f32>>();
    let shape = [arrays.batch, arrays.views, 1, arrays.height, arrays.width];
    arrays.has_ignored_pixels().then(|| Tensor::from_data(TensorData::new(values(), shape), device))
}

/// Matrices of the cameras that look.
pub fn encode_cameras(arrays: &ViewArrays, device: &Device) -> ViewMatrices {
    matrices(arrays, &arrays.img_from_ego, device)
}

/// Matrices of the cameras that are asked to see.
pub fn decode_cameras(arrays: &ViewArrays, device: &Device) -> ViewMatrices {
    matrices(arrays, &arrays.ego_from_img, device)
}

fn matrices(arrays: &ViewArrays, values: &[f32], device: &Device) -> ViewMatrices {
    let shape = [arrays.batch, arrays.views, 3, 4];
    ViewMatrices {
        matrices: Tensor::from_data(TensorData::new(values.to_vec(), shape), device),
        view_mask: view_mask(arrays, device),
    }
}

/// Network pictures back to RGB in [0, 1] on the host, clamped: one `[3, H, W]` per view, in (sample, view) order.
pub fn displayed(network: Tensor<5>) -> Vec<Vec<f32>> {
    let [_, _, c, h, w] = network.dims();
    let rgb = vae::pixels::denormalise(network).clamp(0.0, 1.0);
    let values: Vec<f32> = rgb.into_data().iter::<f32>().collect();
    values.chunks_exact(c * h * w).map(<[f32]>::to_vec).collect()
}

/// RGB in [0, 1] to what latent diffusion networks see, [−1, 1]. Any shape.
pub fn signed<const D: usize>(rgb: Tensor<D>) -> Tensor<D> {
    rgb * 2.0 - 1.0
}

/// Pictures of latent diffusion networks, `[N, 3, H, W]` in about [−1, 1], back to RGB in [0, 1] on the host, clamped: one `[3, H, W]`
/// per item.
pub fn displayed_signed(network: Tensor<4>) -> Vec<Vec<f32>> {
    let [_, c, h, w] = network.dims();
    let values: Vec<f32> = stable_diffusion::vae::pixels_from_network(network).into_data().iter::<f32>().collect();
    values.chunks_exact(c * h * w).map(<[f32]>::to_vec).collect()
}

/// Standard normal numbers drawn on the host, so that every backend sees the same.
pub fn normal<const D: usize>(shape: [usize; D], rng: &mut impl Rng, device: &Device) -> Tensor<D> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| StandardNormal.sample(rng)).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}
