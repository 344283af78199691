//! Where a token stands and how noisy the latent is, as vectors.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use nn::{Bias, Init, Linear};

/// Base of both frequency ladders.
const BASE: f64 = 10_000.0;
/// Width of the sinusoids that enter the timestep's linear layers.
const CODE_WIDTH: usize = 256;

/// Fixed sine–cosine code of a token grid: the first half of the channels from the column index, the second from the row
/// index, each half all sines, then all cosines, of `index · 10000^(−j / (D/4))`.
///
/// # Shapes
/// - output: `[rows·columns, D]`, row-major; D divisible by 4
pub fn position_code([rows, columns]: [usize; 2], width: usize) -> Vec<f64> {
    let quarter = width / 4;
    let half = |index: usize| {
        let angle = move |j: usize| index as f64 * BASE.powf(-(j as f64) / quarter as f64);
        (0..quarter).map(move |j| angle(j).sin()).chain((0..quarter).map(move |j| angle(j).cos()))
    };
    (0..rows * columns).flat_map(|token| half(token % columns).chain(half(token / columns))).collect()
}

/// Cosines, then sines, of `t · 10000^(−j / (width/2))`.
///
/// # Shapes
/// - output: `[B, width]`, width even
pub fn timestep_code(timesteps: &[f64], width: usize, device: &Device) -> Tensor<2> {
    let half = width / 2;
    let angle = |t: f64, j: usize| t * (-BASE.ln() * j as f64 / half as f64).exp();
    let row = |&t: &f64| {
        let cosines = (0..half).map(move |j| angle(t, j).cos() as f32);
        cosines.chain((0..half).map(move |j| angle(t, j).sin() as f32))
    };
    let values: Vec<f32> = timesteps.iter().flat_map(row).collect();
    Tensor::from_data(TensorData::new(values, [timesteps.len(), 2 * half]), device)
}

/// 256 sinusoids of the timestep through Linear, SiLU, Linear.
#[derive(Module, Debug)]
pub struct TimestepEmbedding {
    /// 256→D
    pub expand: Linear,
    /// D→D
    pub mix: Linear,
}

impl TimestepEmbedding {
    /// Weights N(0, 0.02²), biases 0.
    pub fn new(width: usize, init: &mut Init) -> Self {
        let mut layer = |d_in: usize| Linear {
            weight: init.normal([width, d_in], 0.02),
            ..Linear::zeros(1, width, Bias::With, init)
        };
        Self { expand: layer(CODE_WIDTH), mix: layer(width) }
    }

    /// `[B, D]` of B timesteps.
    pub fn forward(&self, timesteps: &[f64], device: &Device) -> Tensor<2> {
        self.mix.forward(ops::silu(self.expand.forward(timestep_code(timesteps, CODE_WIDTH, device))))
    }
}
