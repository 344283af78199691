//! The diffusion time as a vector.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use nn::{Bias, Init, Linear};

/// Ratio of the fastest to the slowest frequency.
const LONGEST: f64 = 10_000.0;

/// Cosines, then sines, of t·10000^(−j/(width/2)).
///
/// Angles are rounded as PyTorch rounds them: published weights know no others. At t = 981 exact angles would change the code by
/// 2e-5 and gradients of the network by 2e-4.
///
/// # Shapes
/// - output: `[N, width]`, `width` even
pub fn time_code(timesteps: &[f64], width: usize, device: &Device) -> Tensor<2> {
    let half = width / 2;
    let frequency = |j: usize| {
        let exponent = -LONGEST.ln() as f32 * j as f32 / half as f32;
        f64::from(exponent).exp() as f32
    };
    let row = |t: &f64| {
        let angles: Vec<f64> = (0..half).map(|j| f64::from(*t as f32 * frequency(j))).collect();
        let cosines: Vec<f64> = angles.iter().map(|a| a.cos()).collect();
        cosines.into_iter().chain(angles.into_iter().map(f64::sin)).map(|v| v as f32).collect::<Vec<_>>()
    };
    let values: Vec<f32> = timesteps.iter().flat_map(row).collect();
    Tensor::from_data(TensorData::new(values, [timesteps.len(), 2 * half]), device)
}

/// Two linear layers over the time code.
#[derive(Module, Debug)]
pub struct TimeEmbedding {
    /// Code to embedding.
    pub linear_1: Linear,
    /// Embedding to embedding.
    pub linear_2: Linear,
}

impl TimeEmbedding {
    pub(crate) fn new(code_width: usize, width: usize, init: &mut Init) -> Self {
        Self {
            linear_1: Linear::new(code_width, width, Bias::With, init),
            linear_2: Linear::new(width, width, Bias::With, init),
        }
    }

    /// The embedding of each time, `[N, width]`.
    pub fn forward(&self, timesteps: &[f64], device: &Device) -> Tensor<2> {
        let [_, code_width] = self.linear_1.weight.dims();
        let code = time_code(timesteps, code_width, device);
        self.linear_2.forward(ops::silu(self.linear_1.forward(code)))
    }
}
