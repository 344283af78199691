//! Classifier-free guidance.

use burn::tensor::Tensor;

/// Ho & Salimans, "Classifier-Free Diffusion Guidance": `uncond + scale·(cond − uncond)`. 0 is unconditional, 1 plain conditional.
pub fn guide<const D: usize>(uncond: Tensor<D>, cond: Tensor<D>, scale: f64) -> Tensor<D> {
    uncond.clone() + (cond - uncond) * scale
}

/// Lin et al., "Common Diffusion Noise Schedules and Sample Steps are Flawed", eq. 15 and 16: the guided output brought to the
/// conditional output's standard deviation, mixed in with weight `rescale`. The deviation is taken over all axes but the first,
/// with n − 1.
pub fn rescale_guidance<const D: usize>(guided: Tensor<D>, cond: Tensor<D>, rescale: f64) -> Tensor<D> {
    let shape = guided.dims();
    let rest: usize = shape[1..].iter().product();
    let rows = |tensor: Tensor<D>| tensor.reshape([shape[0], rest]);
    let (flat, cond) = (rows(guided), rows(cond));
    let ratio = cond.var(1).sqrt() / flat.clone().var(1).sqrt();
    (flat.clone() * ratio * rescale + flat * (1.0 - rescale)).reshape(shape)
}
