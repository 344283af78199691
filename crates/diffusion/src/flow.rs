//! Rectified flow: straight lines between sample and noise (Liu et al., "Flow Straight and Fast"; Esser et al., "Scaling Rectified
//! Flow Transformers"). x = (1 − σ)·x0 + σ·noise; the network predicts noise − x0.

use burn::tensor::Tensor;

/// `(1 − sigma)·x0 + sigma·noise`; `sigma` broadcasts, `[B, 1, ...]`.
pub fn flow_noised<const D: usize>(x0: Tensor<D>, noise: Tensor<D>, sigma: Tensor<D>) -> Tensor<D> {
    x0.clone() + (noise - x0) * sigma
}

/// The target, `noise − x0`.
pub fn flow_velocity<const D: usize>(x0: Tensor<D>, noise: Tensor<D>) -> Tensor<D> {
    noise - x0
}

/// σ of every step and a final 0. `shift` above 1 spends more steps on noisy samples: σ' = shift·σ / (1 + (shift − 1)·σ).
///
/// As the reference scheduler has it, the ends of the line are shifted once before it is divided into steps, and then all its points.
pub fn flow_sigmas(steps: usize, shift: f64, timesteps: usize) -> Vec<f64> {
    let shifted = |sigma: f64| shift * sigma / (1.0 + (shift - 1.0) * sigma);
    let (first, last) = (shifted(1.0), shifted(1.0 / timesteps as f64));
    let place = |i: usize| if steps > 1 { i as f64 / (steps - 1) as f64 } else { 0.0 };
    let mut sigmas: Vec<f64> = (0..steps).map(|i| shifted(first + (last - first) * place(i))).collect();
    sigmas.push(0.0);
    sigmas
}
