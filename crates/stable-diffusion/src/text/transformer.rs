//! The transformer layers of text encoders, named as transformers' state dicts name them.

use burn::module::{Module, Param};
use burn::tensor::{Bool, Int, Tensor};
use nn::{Bias, Init, LayerNorm, Linear, lora_sites};

use super::Activation;

/// Sizes of one layer.
#[derive(Debug, Clone, Copy)]
pub(super) struct LayerSizes {
    pub width: usize,
    pub inner: usize,
    pub heads: usize,
    pub activation: Activation,
    pub epsilon: f32,
}

/// A learned vector per row.
#[derive(Module, Debug)]
pub struct Table {
    /// `[rows, D]`
    pub weight: Param<Tensor<2>>,
}

impl Table {
    fn new(rows: usize, width: usize, init: &mut Init) -> Self {
        Self { weight: init.normal([rows, width], 0.02) }
    }
}

/// Token plus position.
#[derive(Module, Debug)]
pub struct Embeddings {
    /// By token id.
    pub token_embedding: Table,
    /// By place in the text.
    pub position_embedding: Table,
}

impl Embeddings {
    pub(super) fn new(vocabulary: usize, positions: usize, width: usize, init: &mut Init) -> Self {
        Self {
            token_embedding: Table::new(vocabulary, width, init),
            position_embedding: Table::new(positions, width, init),
        }
    }

    /// `[N, L]` ids to `[N, L, D]`.
    pub(super) fn forward(&self, ids: Tensor<2, Int>) -> Tensor<3> {
        let [n, l] = ids.dims();
        let table = self.token_embedding.weight.val();
        let width = table.dims()[1];
        let tokens = table.select(0, ids.reshape([n * l])).reshape([n, l, width]);
        tokens + self.position_embedding.weight.val().narrow(0, 0, l).unsqueeze::<3>()
    }
}

/// Multi-head self-attention with biases everywhere.
#[derive(Module, Debug)]
pub struct SelfAttention {
    /// Keys, D→D.
    pub k_proj: Linear,
    /// Values, D→D.
    pub v_proj: Linear,
    /// Queries, D→D.
    pub q_proj: Linear,
    /// D→D
    pub out_proj: Linear,
    heads: usize,
}

impl SelfAttention {
    fn new(width: usize, heads: usize, init: &mut Init) -> Self {
        let mut projection = || Linear::new(width, width, Bias::With, init);
        let [k_proj, v_proj, q_proj, out_proj] = [projection(), projection(), projection(), projection()];
        Self { k_proj, v_proj, q_proj, out_proj, heads }
    }

    /// # Shapes
    /// - x and output: `[N, L, D]`
    /// - mask: broadcasts to `[N, H, L, L]`, true where a query (third axis) may look at a key (fourth)
    pub fn forward(&self, x: Tensor<3>, mask: Tensor<4, Bool>) -> Tensor<3> {
        let [n, l, width] = x.dims();
        let split = |y: Tensor<3>| y.reshape([n, l, self.heads, width / self.heads]).swap_dims(1, 2);
        let q = split(self.q_proj.forward(x.clone()));
        let k = split(self.k_proj.forward(x.clone()));
        let v = split(self.v_proj.forward(x));
        let attended = ops::attention(q, k, v, Some(mask));
        self.out_proj.forward(attended.swap_dims(1, 2).reshape([n, l, width]))
    }
}

/// Linear, activation, linear.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// D→inner
    pub fc1: Linear,
    /// inner→D
    pub fc2: Linear,
    #[module(skip)]
    activation: Activation,
}

impl FeedForward {
    /// Shape unchanged.
    pub fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        /// Makes the logistic function look like the normal distribution's.
        const SLOPE: f64 = 1.702;
        let inner = self.fc1.forward(x);
        self.fc2.forward(match self.activation {
            Activation::Gelu => ops::gelu(inner),
            // x·sigmoid(s·x) is silu(s·x) / s.
            Activation::QuickGelu => ops::silu(inner * SLOPE) / SLOPE,
        })
    }
}

/// x += attention(norm x); x += MLP(norm x).
#[derive(Module, Debug)]
pub struct EncoderLayer {
    /// Mixes tokens.
    pub self_attn: SelfAttention,
    /// Before attention.
    pub layer_norm1: LayerNorm,
    /// Mixes channels.
    pub mlp: FeedForward,
    /// Before the MLP.
    pub layer_norm2: LayerNorm,
}

impl EncoderLayer {
    fn new(sizes: LayerSizes, init: &mut Init) -> Self {
        let LayerSizes { width, inner, heads, activation, epsilon } = sizes;
        Self {
            self_attn: SelfAttention::new(width, heads, init),
            layer_norm1: LayerNorm::with_bias(width, epsilon, init),
            mlp: FeedForward {
                fc1: Linear::new(width, inner, Bias::With, init),
                fc2: Linear::new(inner, width, Bias::With, init),
                activation,
            },
            layer_norm2: LayerNorm::with_bias(width, epsilon, init),
        }
    }

    /// As [`SelfAttention::forward`].
    pub fn forward(&self, x: Tensor<3>, mask: Tensor<4, Bool>) -> Tensor<3> {
        let x = x.clone() + self.self_attn.forward(self.layer_norm1.forward(x), mask);
        x.clone() + self.mlp.forward(self.layer_norm2.forward(x))
    }
}

/// Layers in order.
#[derive(Module, Debug)]
pub struct Encoder {
    /// From the tokens on.
    pub layers: Vec<EncoderLayer>,
}

impl Encoder {
    pub(super) fn new(layers: usize, sizes: LayerSizes, init: &mut Init) -> Self {
        Self { layers: (0..layers).map(|_| EncoderLayer::new(sizes, init)).collect() }
    }

    /// Output of the first `count` layers.
    pub(super) fn forward(&self, x: Tensor<3>, mask: &Tensor<4, Bool>, count: usize) -> Tensor<3> {
        self.layers.iter().take(count).fold(x, |x, layer| layer.forward(x, mask.clone()))
    }
}

lora_sites!(SelfAttention { k_proj, v_proj, q_proj, out_proj });
lora_sites!(FeedForward { fc1, fc2 });
lora_sites!(EncoderLayer { self_attn, mlp });
lora_sites!(Encoder { layers });
