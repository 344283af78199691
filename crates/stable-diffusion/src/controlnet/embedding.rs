//! The condition picture at latent size.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::Init;

use super::ControlNetConfig;
use crate::layers::Conv2d;

/// 3×3 convolutions with SiLU between, every second one halving the size; the last starts as 0.
#[derive(Module, Debug)]
pub struct ConditionEmbedding {
    /// From the condition's channels.
    pub conv_in: Conv2d,
    /// Keeping and halving convolutions in turn.
    pub blocks: Vec<Conv2d>,
    /// To the channels of the UNet's first level; zero at the start.
    pub conv_out: Conv2d,
}

impl ConditionEmbedding {
    pub(super) fn new(config: &ControlNetConfig, init: &mut Init) -> Self {
        let channels = &config.embedding_channels;
        let conv_in = Conv2d::new(config.condition_channels, channels[0], 3, init);
        let mut blocks = Vec::new();
        for pair in channels.windows(2) {
            blocks.push(Conv2d::new(pair[0], pair[0], 3, init));
            blocks.push(Conv2d::with_stride(pair[0], pair[1], 3, 2, 1, init));
        }
        let last = channels[channels.len() - 1];
        Self { conv_in, blocks, conv_out: Conv2d::zeros(last, config.encoder.first_channels(), 3, init) }
    }

    /// # Shapes
    /// - condition: `[N, K, h·f, w·f]`
    /// - output: `[N, C, h, w]`
    pub fn forward(&self, condition: Tensor<4>) -> Tensor<4> {
        let x = ops::silu(self.conv_in.forward(condition));
        let x = self.blocks.iter().fold(x, |x, conv| ops::silu(conv.forward(x)));
        self.conv_out.forward(x)
    }
}
