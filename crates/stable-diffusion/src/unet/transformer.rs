//! The transformer that a level of the UNet puts behind its residual blocks.
//!
//! Shapes: N items, D channels, h w latent size, L text tokens.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Bias, GroupNorm, Init, LayerNorm, Linear};

use super::{Condition, EncoderConfig, ProjectionKind};
use crate::attention::Attention;
use crate::cross_view::CrossView;
use crate::layers::Conv2d;
use crate::panels::{join_width, split_width};

/// Epsilon of the group norm at the entrance; residual blocks have another.
const ENTRANCE_EPSILON: f32 = 1e-6;

/// Epsilon of the norms inside the block.
const BLOCK_EPSILON: f32 = 1e-5;

/// A linear map with bias per position, stored as the config says.
#[derive(Module, Debug)]
pub enum Projection {
    /// `[D, D, 1, 1]`
    Convolution(Conv2d),
    /// `[D, D]`
    Linear(Linear),
}

impl Projection {
    fn new(width: usize, kind: ProjectionKind, init: &mut Init) -> Self {
        match kind {
            ProjectionKind::Convolution => Self::Convolution(Conv2d::new(width, width, 1, init)),
            ProjectionKind::Linear => Self::Linear(Linear::new(width, width, Bias::With, init)),
        }
    }

    /// Shape unchanged, `[N, h·w, D]`.
    pub fn forward(&self, tokens: Tensor<3>) -> Tensor<3> {
        match self {
            Self::Linear(linear) => linear.forward(tokens),
            Self::Convolution(conv) => {
                let matrix = conv.lora.matrix(&conv.weight);
                conv.lora.add_to_rows(tokens, |tokens| ops::linear(tokens, matrix, Some(conv.bias.val())))
            }
        }
    }
}

/// GEGLU: D→8D split into values and gates, values·gelu(gates), 4D→D.
#[derive(Module, Debug)]
pub struct FeedForward {
    /// `net.0.proj` of the state dict.
    pub expand: Linear,
    /// `net.2` of the state dict.
    pub contract: Linear,
}

impl FeedForward {
    fn new(width: usize, init: &mut Init) -> Self {
        Self {
            expand: Linear::new(width, 8 * width, Bias::With, init),
            contract: Linear::new(4 * width, width, Bias::With, init),
        }
    }

    /// Shape unchanged, `[N, h·w, D]`.
    pub fn forward(&self, tokens: Tensor<3>) -> Tensor<3> {
        let half = 4 * tokens.dims()[2];
        let both = self.expand.forward(tokens);
        let gates = ops::gelu(both.clone().narrow(2, half, half));
        self.contract.forward(both.narrow(2, 0, half) * gates)
    }
}

/// Self-attention, attention to text, optionally to neighbouring views, feed-forward; each behind a norm, with a residual.
#[derive(Module, Debug)]
pub struct TransformerBlock {
    /// Before `attn1`.
    pub norm1: LayerNorm,
    /// Between positions of one picture.
    pub attn1: Attention,
    /// Before `attn2`.
    pub norm2: LayerNorm,
    /// To text.
    pub attn2: Attention,
    /// To neighbouring views.
    pub cross_view: Option<CrossView>,
    /// Before `ff`.
    pub norm3: LayerNorm,
    /// Mixes channels.
    pub ff: FeedForward,
}

impl TransformerBlock {
    fn new(width: usize, heads: usize, config: &EncoderConfig, init: &mut Init) -> Self {
        Self {
            norm1: LayerNorm::with_bias(width, BLOCK_EPSILON, init),
            attn1: Attention::new(width, width, heads, Bias::Without, init),
            norm2: LayerNorm::with_bias(width, BLOCK_EPSILON, init),
            attn2: Attention::new(width, config.context_width, heads, Bias::Without, init),
            cross_view: config.cross_view.map(|merge| CrossView::new(width, heads, merge, init)),
            norm3: LayerNorm::with_bias(width, BLOCK_EPSILON, init),
            ff: FeedForward::new(width, init),
        }
    }

    /// Shape unchanged, `[N, h·w, D]`.
    ///
    /// # Panics
    /// When the block has cross-view attention and the condition no adjacency.
    pub fn forward(&self, x: Tensor<3>, condition: &Condition) -> Tensor<3> {
        let normed = self.norm1.forward(x.clone());
        let x = x + self.attn1.forward(normed.clone(), normed);
        let x = x.clone() + self.attn2.forward(self.norm2.forward(x), condition.context.clone());
        let x = match (&self.cross_view, condition.views) {
            (Some(block), Some(views)) => block.forward(x, views),
            (Some(_), None) => panic!("cross-view attention needs an adjacency of views"),
            (None, _) => x,
        };
        x.clone() + self.ff.forward(self.norm3.forward(x))
    }
}

/// Group norm, projection in, blocks, projection out, plus input.
#[derive(Module, Debug)]
pub struct Transformer2d {
    /// At the entrance.
    pub norm: GroupNorm,
    /// Channels to block width.
    pub proj_in: Projection,
    /// One block in all published networks.
    pub transformer_blocks: Vec<TransformerBlock>,
    /// Block width to channels.
    pub proj_out: Projection,
}

impl Transformer2d {
    /// The transformer of one level.
    pub fn new(level: usize, config: &EncoderConfig, init: &mut Init) -> Self {
        let (width, heads) = (config.block_channels[level], config.heads_of(level));
        Self {
            norm: GroupNorm::new(width, config.norm_groups, ENTRANCE_EPSILON, init),
            proj_in: Projection::new(width, config.projection, init),
            transformer_blocks: vec![TransformerBlock::new(width, heads, config, init)],
            proj_out: Projection::new(width, config.projection, init),
        }
    }

    /// Shape unchanged, `[N, D, h, w]`, or `[B, D, h, V·w]` of joined views: the norm sees what convolutions see, the blocks
    /// see one view at a time.
    pub fn forward(&self, x: Tensor<4>, condition: &Condition) -> Tensor<4> {
        let normed = split_width(self.norm.forward(x.clone()), condition.joined);
        let [n, d, h, w] = normed.dims();
        let tokens = self.proj_in.forward(normed.reshape([n, d, h * w]).swap_dims(1, 2));
        let tokens = self.transformer_blocks.iter().fold(tokens, |tokens, block| block.forward(tokens, condition));
        let out = self.proj_out.forward(tokens).swap_dims(1, 2).reshape([n, d, h, w]);
        x + join_width(out, condition.joined)
    }
}
