//! The adaLN-Zero block: attention and MLP whose inputs are shifted and scaled, and whose outputs are gated, by the condition.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Bias, Init, Linear};

/// Epsilon of the norms, which have no parameters.
const NORM_EPSILON: f32 = 1e-6;

/// Weights U(±√(6 / (in + out))), bias 0.
pub(crate) fn xavier(d_in: usize, d_out: usize, init: &mut Init) -> Linear {
    let bound = (6.0 / (d_in + d_out) as f64).sqrt();
    Linear { weight: init.uniform([d_out, d_in], bound), ..Linear::zeros(1, d_out, Bias::With, init) }
}

/// Normed tokens, scaled and shifted per sample: `LN(x)·(1 + scale) + shift`.
///
/// # Shapes
/// - tokens and output: `[B, N, D]`
/// - shift, scale: `[B, 1, D]`
pub(crate) fn modulated(tokens: Tensor<3>, shift: Tensor<3>, scale: Tensor<3>) -> Tensor<3> {
    ops::modulated_layer_norm(tokens, shift, scale, NORM_EPSILON)
}

/// `count` vectors per sample from SiLU(c): `[B, D]` to `count` times `[B, 1, D]`.
pub(crate) fn split_modulation<const COUNT: usize>(layer: &Linear, c: Tensor<2>) -> [Tensor<3>; COUNT] {
    let [b, d] = c.dims();
    let all = layer.forward(ops::silu(c)).reshape([b, COUNT, d]);
    std::array::from_fn(|i| all.clone().narrow(1, i, 1))
}

/// One block.
#[derive(Module, Debug)]
pub struct DitBlock {
    /// D→6D: shift, scale, gate of attention, then of the MLP. Starts as 0, so that a fresh block is the identity.
    pub modulation: Linear,
    /// D→3D in the order q, k, v
    pub qkv: Linear,
    /// D→D
    pub out: Linear,
    /// D→4D
    pub expand: Linear,
    /// 4D→D
    pub contract: Linear,
    heads: usize,
}

impl DitBlock {
    /// `heads` must divide `width`.
    pub fn new(width: usize, heads: usize, init: &mut Init) -> Self {
        Self {
            modulation: Linear::zeros(width, 6 * width, Bias::With, init),
            qkv: xavier(width, 3 * width, init),
            out: xavier(width, width, init),
            expand: xavier(width, 4 * width, init),
            contract: xavier(4 * width, width, init),
            heads,
        }
    }

    /// # Shapes
    /// - tokens and output: `[B, N, D]`
    /// - c: `[B, D]`
    pub fn forward(&self, tokens: Tensor<3>, c: Tensor<2>) -> Tensor<3> {
        let [shift_1, scale_1, gate_1, shift_2, scale_2, gate_2] = split_modulation(&self.modulation, c);
        let tokens = tokens.clone() + self.attend(modulated(tokens, shift_1, scale_1)) * gate_1;
        let hidden = ops::gelu_tanh(self.expand.forward(modulated(tokens.clone(), shift_2, scale_2)));
        tokens + self.contract.forward(hidden) * gate_2
    }

    fn attend(&self, tokens: Tensor<3>) -> Tensor<3> {
        let [b, n, width] = tokens.dims();
        let head = width / self.heads;
        let qkv = self.qkv.forward(tokens).reshape([b, n, 3, self.heads, head]).permute([2, 0, 3, 1, 4]);
        let part = |i: usize| qkv.clone().narrow(0, i, 1).reshape([b, self.heads, n, head]);
        let attended = ops::attention(part(0), part(1), part(2), None);
        self.out.forward(attended.swap_dims(1, 2).reshape([b, n, width]))
    }
}
