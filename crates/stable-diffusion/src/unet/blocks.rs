//! Levels of the UNet. Shapes: N items, C channels, h w latent size.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::Init;

use super::{EncoderConfig, Transformer2d};
use crate::cross_view::Adjacency;
use crate::layers::{DownPadding, Downsample, Upsample};
use crate::resnet::{ResnetBlock, ResnetSizes};

/// Epsilon of the norms in residual blocks; the one before the last convolution has it too.
pub(super) const EPSILON: f32 = 1e-5;

/// What every block is told beside its input.
#[derive(Debug, Clone)]
pub struct Condition<'a> {
    /// Time embedding after SiLU, `[N, time width]`.
    pub time: Tensor<2>,
    /// Text tokens, `[N, L, context width]`.
    pub context: Tensor<3>,
    /// Which views are neighbours, in networks with cross-view attention.
    pub views: Option<&'a Adjacency>,
    /// Views that stand side by side in the pictures which blocks are given; 1 where each view is a picture.
    pub joined: usize,
}

fn resnet(c_in: usize, c_out: usize, config: &EncoderConfig, init: &mut Init) -> ResnetBlock {
    let time_width = Some(config.time_width());
    ResnetBlock::new(ResnetSizes { c_in, c_out, groups: config.norm_groups, epsilon: EPSILON, time_width }, init)
}

fn transformers(count: usize, level: usize, config: &EncoderConfig, init: &mut Init) -> Vec<Transformer2d> {
    let count = if config.attention_levels[level] { count } else { 0 };
    (0..count).map(|_| Transformer2d::new(level, config, init)).collect()
}

/// One level on the way down.
#[derive(Module, Debug)]
pub struct DownBlock {
    /// In order.
    pub resnets: Vec<ResnetBlock>,
    /// One behind each residual block, or none.
    pub attentions: Vec<Transformer2d>,
    /// On every level but the last.
    pub downsampler: Option<Downsample>,
}

impl DownBlock {
    fn new(level: usize, c_in: usize, config: &EncoderConfig, init: &mut Init) -> Self {
        let (c, count) = (config.block_channels[level], config.resnets_per_level);
        let inner = level + 1 < config.levels();
        Self {
            resnets: (0..count).map(|j| resnet(if j == 0 { c_in } else { c }, c, config, init)).collect(),
            attentions: transformers(count, level, config, init),
            downsampler: inner.then(|| Downsample::new(c, DownPadding::AllSides, init)),
        }
    }

    /// Adds every intermediate result to `skips`.
    pub fn forward(&self, mut x: Tensor<4>, condition: &Condition, skips: &mut Vec<Tensor<4>>) -> Tensor<4> {
        for (j, resnet) in self.resnets.iter().enumerate() {
            x = resnet.forward(x, Some(&condition.time));
            if let Some(attention) = self.attentions.get(j) {
                x = attention.forward(x, condition);
            }
            skips.push(x.clone());
        }
        if let Some(downsampler) = &self.downsampler {
            x = downsampler.forward(x);
            skips.push(x.clone());
        }
        x
    }
}

/// Residual block, transformer, residual block on the coarsest level.
#[derive(Module, Debug)]
pub struct MidBlock {
    /// Before and after the transformer.
    pub resnets: [ResnetBlock; 2],
    /// Between the two.
    pub attentions: [Transformer2d; 1],
}

impl MidBlock {
    fn new(config: &EncoderConfig, init: &mut Init) -> Self {
        let c = config.last_channels();
        let [first, second] = [0, 1].map(|_| resnet(c, c, config, init));
        Self { resnets: [first, second], attentions: [Transformer2d::new(config.levels() - 1, config, init)] }
    }

    /// Shape unchanged.
    pub fn forward(&self, x: Tensor<4>, condition: &Condition) -> Tensor<4> {
        let ([first, second], [attention]) = (&self.resnets, &self.attentions);
        let x = attention.forward(first.forward(x, Some(&condition.time)), condition);
        second.forward(x, Some(&condition.time))
    }
}

/// One level on the way up.
#[derive(Module, Debug)]
pub struct UpBlock {
    /// In order; each sees one skip beside the hidden state.
    pub resnets: Vec<ResnetBlock>,
    /// One behind each residual block, or none.
    pub attentions: Vec<Transformer2d>,
    /// On every level but the finest.
    pub upsampler: Option<Upsample>,
}

impl UpBlock {
    /// `skips` are the channels of all skips that are left; the block takes its own from the end.
    pub(super) fn new(
        level: usize,
        c_in: usize,
        skips: &mut Vec<usize>,
        config: &EncoderConfig,
        init: &mut Init,
    ) -> Self {
        let (c, count) = (config.block_channels[level], config.resnets_per_level + 1);
        let own = skips.split_off(skips.len() - count);
        let inputs = own.iter().rev().enumerate().map(|(j, skip)| skip + if j == 0 { c_in } else { c });
        Self {
            resnets: inputs.map(|c_in| resnet(c_in, c, config, init)).collect(),
            attentions: transformers(count, level, config, init),
            upsampler: (level > 0).then(|| Upsample::new(c, init)),
        }
    }

    /// Takes its skips from the end of `skips`.
    ///
    /// # Shapes
    /// - x: `[N, C', h, w]`
    /// - output: `[N, C, h', w']`, the size of the next skip (not always twice the input's)
    pub fn forward(&self, mut x: Tensor<4>, condition: &Condition, skips: &mut Vec<Tensor<4>>) -> Tensor<4> {
        let own = skips.split_off(skips.len() - self.resnets.len());
        for (j, (resnet, skip)) in self.resnets.iter().zip(own.into_iter().rev()).enumerate() {
            x = resnet.forward(Tensor::cat(vec![x, skip], 1), Some(&condition.time));
            if let Some(attention) = self.attentions.get(j) {
                x = attention.forward(x, condition);
            }
        }
        match (&self.upsampler, skips.last()) {
            (Some(upsampler), Some(next)) => {
                let [_, _, h, w] = next.dims();
                upsampler.forward(x, [h, w])
            }
            _ => x,
        }
    }
}

/// Levels on the way down and the middle, as UNet and ControlNet both have them.
pub(crate) fn encoder_blocks(config: &EncoderConfig, init: &mut Init) -> (Vec<DownBlock>, MidBlock) {
    let mut before = config.first_channels();
    let level = |level: usize| {
        let block = DownBlock::new(level, before, config, init);
        before = config.block_channels[level];
        block
    };
    let down_blocks = (0..config.levels()).map(level).collect();
    (down_blocks, MidBlock::new(config, init))
}

/// Skips in the order in which they are made, the first being `x` itself, and the middle's output.
pub(crate) fn encode(
    x: Tensor<4>,
    down_blocks: &[DownBlock],
    mid_block: &MidBlock,
    condition: &Condition,
) -> (Vec<Tensor<4>>, Tensor<4>) {
    let mut skips = vec![x.clone()];
    let x = down_blocks.iter().fold(x, |x, block| block.forward(x, condition, &mut skips));
    (skips, mid_block.forward(x, condition))
}
