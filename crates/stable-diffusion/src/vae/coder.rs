//! Encoder and decoder of the autoencoder. Shapes: N items, C channels, H W pixels.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Bias, GroupNorm, Init};

use super::VaeConfig;
use crate::attention::Attention;
use crate::layers::{Conv2d, DownPadding, Downsample, Upsample};
use crate::resnet::{ResnetBlock, ResnetSizes};

/// Epsilon of every norm in the autoencoder.
const EPSILON: f32 = 1e-6;

fn resnet(c_in: usize, c_out: usize, config: &VaeConfig, init: &mut Init) -> ResnetBlock {
    let sizes = ResnetSizes { c_in, c_out, groups: config.norm_groups, epsilon: EPSILON, time_width: None };
    ResnetBlock::new(sizes, init)
}

/// Residual blocks that start at `c_in` and then keep `c_out` channels.
fn resnets(count: usize, c_in: usize, c_out: usize, config: &VaeConfig, init: &mut Init) -> Vec<ResnetBlock> {
    (0..count).map(|i| resnet(if i == 0 { c_in } else { c_out }, c_out, config, init)).collect()
}

fn through(resnets: &[ResnetBlock], x: Tensor<4>) -> Tensor<4> {
    resnets.iter().fold(x, |x, block| block.forward(x, None))
}

/// One head over all pixels, with a residual around it.
#[derive(Module, Debug)]
pub struct SelfAttention2d {
    /// Before the projections.
    pub group_norm: GroupNorm,
    /// `to_q`, `to_k`, `to_v` and `to_out.0` of the state dict.
    pub attention: Attention,
}

impl SelfAttention2d {
    fn new(channels: usize, groups: usize, init: &mut Init) -> Self {
        Self {
            group_norm: GroupNorm::new(channels, groups, EPSILON, init),
            attention: Attention::new(channels, channels, 1, Bias::With, init),
        }
    }

    /// Shape unchanged, `[N, C, H, W]`.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [n, c, h, w] = x.dims();
        let tokens = self.group_norm.forward(x.clone()).reshape([n, c, h * w]).swap_dims(1, 2);
        let mixed = self.attention.forward(tokens.clone(), tokens);
        x + mixed.swap_dims(1, 2).reshape([n, c, h, w])
    }
}

/// Residual block, attention, residual block.
#[derive(Module, Debug)]
pub struct MidBlock {
    /// Before and after the attention.
    pub resnets: [ResnetBlock; 2],
    /// Between the two.
    pub attentions: [SelfAttention2d; 1],
}

impl MidBlock {
    fn new(channels: usize, config: &VaeConfig, init: &mut Init) -> Self {
        let [first, second] = [0, 1].map(|_| resnet(channels, channels, config, init));
        Self { resnets: [first, second], attentions: [SelfAttention2d::new(channels, config.norm_groups, init)] }
    }

    /// Shape unchanged.
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let ([first, second], [attention]) = (&self.resnets, &self.attentions);
        second.forward(attention.forward(first.forward(x, None)), None)
    }
}

/// One level of the encoder.
#[derive(Module, Debug)]
pub struct EncoderBlock {
    /// In order.
    pub resnets: Vec<ResnetBlock>,
    /// On every level but the last.
    pub downsampler: Option<Downsample>,
}

/// Pictures to moments.
#[derive(Module, Debug)]
pub struct Encoder {
    /// 3×3 from colours.
    pub conv_in: Conv2d,
    /// Finest first.
    pub down_blocks: Vec<EncoderBlock>,
    /// On the coarsest level.
    pub mid_block: MidBlock,
    /// Before the last convolution, followed by SiLU.
    pub conv_norm_out: GroupNorm,
    /// 3×3 to moments.
    pub conv_out: Conv2d,
}

impl Encoder {
    pub(super) fn new(config: &VaeConfig, init: &mut Init) -> Self {
        let channels = &config.block_channels;
        let [first, last] = ends(channels);
        let conv_in = Conv2d::new(3, first, 3, init);
        let mut before = first;
        let level = |(i, &c): (usize, &usize)| {
            let resnets = resnets(config.resnets_per_level, before, c, config, init);
            before = c;
            let inner = i + 1 < channels.len();
            EncoderBlock { resnets, downsampler: inner.then(|| Downsample::new(c, DownPadding::RightBottom, init)) }
        };
        let down_blocks = channels.iter().enumerate().map(level).collect();
        Self {
            conv_in,
            down_blocks,
            mid_block: MidBlock::new(last, config, init),
            conv_norm_out: GroupNorm::new(last, config.norm_groups, EPSILON, init),
            conv_out: Conv2d::new(last, 2 * config.latent_channels, 3, init),
        }
    }

    /// # Shapes
    /// - images: `[N, 3, H, W]` in [−1, 1]
    /// - output: `[N, 2·latent, H/f, W/f]`
    pub fn forward(&self, images: Tensor<4>) -> Tensor<4> {
        let x = self.down_blocks.iter().fold(self.conv_in.forward(images), |x, block| {
            let x = through(&block.resnets, x);
            match &block.downsampler {
                Some(downsampler) => downsampler.forward(x),
                None => x,
            }
        });
        self.conv_out.forward(self.conv_norm_out.forward_silu(self.mid_block.forward(x)))
    }
}

/// One level of the decoder.
#[derive(Module, Debug)]
pub struct DecoderBlock {
    /// In order.
    pub resnets: Vec<ResnetBlock>,
    /// On every level but the last.
    pub upsampler: Option<Upsample>,
}

/// Latents to pictures.
#[derive(Module, Debug)]
pub struct Decoder {
    /// 3×3 from latents.
    pub conv_in: Conv2d,
    /// On the coarsest level.
    pub mid_block: MidBlock,
    /// Coarsest first.
    pub up_blocks: Vec<DecoderBlock>,
    /// Before the last convolution, followed by SiLU.
    pub conv_norm_out: GroupNorm,
    /// 3×3 to colours.
    pub conv_out: Conv2d,
}

impl Decoder {
    pub(super) fn new(config: &VaeConfig, init: &mut Init) -> Self {
        let channels = &config.block_channels;
        let [first, last] = ends(channels);
        let conv_in = Conv2d::new(config.latent_channels, last, 3, init);
        let mid_block = MidBlock::new(last, config, init);
        let mut before = last;
        let level = |(i, &c): (usize, &usize)| {
            let resnets = resnets(config.resnets_per_level + 1, before, c, config, init);
            before = c;
            let inner = i + 1 < channels.len();
            DecoderBlock { resnets, upsampler: inner.then(|| Upsample::new(c, init)) }
        };
        let up_blocks = channels.iter().rev().enumerate().map(level).collect();
        Self {
            conv_in,
            mid_block,
            up_blocks,
            conv_norm_out: GroupNorm::new(first, config.norm_groups, EPSILON, init),
            conv_out: Conv2d::new(first, 3, 3, init),
        }
    }

    /// # Shapes
    /// - latents: `[N, latent, h, w]`
    /// - output: `[N, 3, h·f, w·f]`, not clamped
    pub fn forward(&self, latents: Tensor<4>) -> Tensor<4> {
        self.conv_out.forward(self.features(latents))
    }

    /// What enters the last convolution, `[N, C, h·f, w·f]`.
    pub fn features(&self, latents: Tensor<4>) -> Tensor<4> {
        let x = self.mid_block.forward(self.conv_in.forward(latents));
        let x = self.up_blocks.iter().fold(x, |x, block| {
            let x = through(&block.resnets, x);
            let [_, _, h, w] = x.dims();
            match &block.upsampler {
                Some(upsampler) => upsampler.forward(x, [2 * h, 2 * w]),
                None => x,
            }
        });
        self.conv_norm_out.forward_silu(x)
    }
}

/// Channels of the finest and the coarsest level.
fn ends(channels: &[usize]) -> [usize; 2] {
    [channels.first(), channels.last()].map(|c| c.copied().unwrap_or_default())
}
