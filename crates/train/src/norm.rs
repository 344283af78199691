//! Norm over all gradients of a module together, and clipping to it. burn's own clipping works on single tensors.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::Tensor;

use crate::params::{map_gradients, visit_gradients};

/// Euclidean norm of all gradients taken as one vector.
#[derive(Clone, Debug, PartialEq)]
pub struct GradientNorm {
    /// The norm; not finite when any gradient is not, or when the sum of squares of one tensor leaves f32.
    pub value: f64,
    /// Paths of the parameters whose gradient made it so.
    pub nonfinite: Vec<String>,
}

/// Norm of all gradients of `module` in `grads`. One read-back from the device.
///
/// The squares of each tensor are summed on the device in f32, the sums of the tensors on the host in f64.
pub fn global_norm<M: Module>(grads: &GradientsParams, module: &M) -> GradientNorm {
    let mut paths = Vec::new();
    let mut sums = Vec::new();
    visit_gradients(module, grads, |info, grad| {
        paths.push(info.path.clone());
        sums.push(grad.clone().mul(grad).sum());
    });
    if sums.is_empty() {
        return GradientNorm { value: 0.0, nonfinite: Vec::new() };
    }
    let sums: Vec<f32> = Tensor::cat(sums, 0).into_data().iter::<f32>().collect();
    let value = sums.iter().map(|&sum| f64::from(sum)).sum::<f64>().sqrt();
    let nonfinite = paths.into_iter().zip(&sums).filter(|(_, sum)| !sum.is_finite()).map(|(path, _)| path).collect();
    GradientNorm { value, nonfinite }
}

/// Multiplies every gradient of `module` by `factor`.
pub fn scale_gradients<M: Module>(grads: &mut GradientsParams, module: &M, factor: f64) {
    map_gradients(module, grads, |grad| grad.mul_scalar(factor));
}

/// Multiplies all gradients by `min(1, max_norm / (norm + 1e-6))` and returns the norm before. Gradients with a norm
/// that is not finite are left alone: no factor makes them usable.
pub fn clip_global_norm<M: Module>(grads: &mut GradientsParams, module: &M, max_norm: f64) -> GradientNorm {
    let norm = global_norm(grads, module);
    let factor = max_norm / (norm.value + 1e-6);
    if norm.value.is_finite() && factor < 1.0 {
        scale_gradients(grads, module, factor);
    }
    norm
}
