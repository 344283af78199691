//! The rotary transformer of BEV-VAE's image and state stacks.
//!
//! Pre-norm blocks without linear biases; queries and keys are RMS-normalised per head, then rotated.
//! Shapes: B batch, N tokens, D width, H heads, d = D/H.

use burn::module::Module;
use burn::tensor::Tensor;

use crate::{Bias, Init, LayerNorm, Linear, RmsNorm, RotaryAngles};

/// Epsilon of every norm in the stack.
pub const NORM_EPSILON: f32 = 1e-6;

/// Linear D→4D, exact GELU, linear 4D→D, no biases.
#[derive(Module, Debug)]
pub struct Mlp {
    /// D→4D
    pub expand: Linear,
    /// 4D→D
    pub contract: Linear,
}

impl Mlp {
    /// With the customary factor 4.
    pub fn new(width: usize, init: &mut Init) -> Self {
        Self {
            expand: Linear::new(width, 4 * width, Bias::Without, init),
            contract: Linear::zeros(4 * width, width, Bias::Without, init),
        }
    }

    /// Shape unchanged.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        self.contract.forward(ops::gelu(self.expand.forward(x)))
    }
}

/// Multi-head self-attention with RMS-normalised, rotated queries and keys.
#[derive(Module, Debug)]
pub struct RotaryAttention {
    /// D→3D in the order q, k, v
    pub qkv: Linear,
    /// D→D
    pub out: Linear,
    /// Over d, shared by all heads.
    pub query_norm: RmsNorm,
    /// Over d, shared by all heads.
    pub key_norm: RmsNorm,
    heads: usize,
}

impl RotaryAttention {
    /// `heads` must divide `width`.
    pub fn new(width: usize, heads: usize, init: &mut Init) -> Self {
        assert_eq!(width % heads, 0, "{heads} heads must divide width {width}");
        Self {
            qkv: Linear::new(width, 3 * width, Bias::Without, init),
            out: Linear::zeros(width, width, Bias::Without, init),
            query_norm: RmsNorm::new(width / heads, init),
            key_norm: RmsNorm::new(width / heads, init),
            heads,
        }
    }

    /// # Shapes
    /// - tokens: `[B, N, D]`
    /// - cos, sin: `[1 or H, N, d/2]`
    /// - output: `[B, N, D]`
    pub fn forward(&self, tokens: Tensor<3>, (cos, sin): (Tensor<3>, Tensor<3>)) -> Tensor<3> {
        let gains = [self.query_norm.weight.val(), self.key_norm.weight.val()];
        let attended = ops::rotary_attention(self.qkv.forward(tokens), gains, [cos, sin], self.heads, NORM_EPSILON);
        self.out.forward(attended)
    }
}

/// x += attention(norm(x)); x += mlp(norm(x)).
#[derive(Module, Debug)]
pub struct RotaryBlock {
    /// Before attention.
    pub norm_1: LayerNorm,
    /// Mixes tokens.
    pub attention: RotaryAttention,
    /// Before the MLP.
    pub norm_2: LayerNorm,
    /// Mixes channels.
    pub mlp: Mlp,
}

impl RotaryBlock {
    fn new(width: usize, heads: usize, init: &mut Init) -> Self {
        Self {
            norm_1: LayerNorm::new(width, NORM_EPSILON, init),
            attention: RotaryAttention::new(width, heads, init),
            norm_2: LayerNorm::new(width, NORM_EPSILON, init),
            mlp: Mlp::new(width, init),
        }
    }

    /// # Shapes
    /// - tokens: `[B, N, D]`
    /// - output: `[B, N, D]`
    pub fn forward(&self, tokens: Tensor<3>, rotation: (Tensor<3>, Tensor<3>)) -> Tensor<3> {
        let tokens = tokens.clone() + self.attention.forward(self.norm_1.forward(tokens), rotation);
        tokens.clone() + self.mlp.forward(self.norm_2.forward(tokens))
    }
}

/// Blocks and a final norm.
#[derive(Module, Debug)]
pub struct RotaryStack {
    /// In order.
    pub blocks: Vec<RotaryBlock>,
    /// After the last block.
    pub norm: LayerNorm,
}

impl RotaryStack {
    /// `depth` blocks of the same size.
    pub fn new(width: usize, heads: usize, depth: usize, init: &mut Init) -> Self {
        Self {
            blocks: (0..depth).map(|_| RotaryBlock::new(width, heads, init)).collect(),
            norm: LayerNorm::new(width, NORM_EPSILON, init),
        }
    }

    /// # Shapes
    /// - tokens: `[B, N, D]`
    /// - output: `[B, N, D]`
    pub fn forward(&self, tokens: Tensor<3>, angles: &RotaryAngles) -> Tensor<3> {
        let rotation = angles.cos_sin(&tokens.device());
        let tokens = self.blocks.iter().fold(tokens, |tokens, block| block.forward(tokens, rotation.clone()));
        self.norm.forward(tokens)
    }
}
