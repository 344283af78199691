//! The denoising UNet of latent diffusion.
//!
//! Paper: Rombach et al., section 3.3. Parity: `tests/it/unet.rs`. Shapes: N items (samples, views and frames folded), h w
//! latent size, L text tokens.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{GroupNorm, Init};

use super::blocks::{Condition, DownBlock, EPSILON, MidBlock, UpBlock, encode, encoder_blocks};
use super::{EncoderConfig, TimeEmbedding, UNetConfig};
use crate::controlnet::ControlResiduals;
use crate::cross_view::Adjacency;
use crate::layers::Conv2d;
use crate::panels::{Panels, join_width, split_width};

/// Noisy latent, time and text to a prediction of the latent's size.
#[derive(Module, Debug)]
pub struct UNet2DCondition {
    /// 3×3 from latents.
    pub conv_in: Conv2d,
    /// Time to an offset in every residual block.
    pub time_embedding: TimeEmbedding,
    /// Finest first.
    pub down_blocks: Vec<DownBlock>,
    /// On the coarsest level.
    pub mid_block: MidBlock,
    /// Coarsest first.
    pub up_blocks: Vec<UpBlock>,
    /// Before the last convolution, followed by SiLU.
    pub conv_norm_out: GroupNorm,
    /// 3×3 to the prediction.
    pub conv_out: Conv2d,
    #[module(skip)]
    config: UNetConfig,
}

/// What the UNet is given beside the noisy latent.
#[derive(Debug, Clone)]
pub struct UNetInputs<'a> {
    /// Diffusion time of each item, length N.
    pub timesteps: &'a [f64],
    /// Text tokens, `[N, L, context width]`.
    pub context: Tensor<3>,
    /// Which views are neighbours, exactly in networks that let views meet ([`EncoderConfig::needs_views`]).
    pub views: Option<&'a Adjacency>,
    /// What ControlNets add.
    pub control: Option<&'a ControlResiduals>,
}

impl UNet2DCondition {
    /// Fresh weights. The config must have passed [`UNetConfig::checked`].
    pub fn new(config: &UNetConfig, init: &mut Init) -> Self {
        let encoder = &config.encoder;
        let first = encoder.first_channels();
        let conv_in = Conv2d::new(encoder.in_channels, first, 3, init);
        let time_embedding = TimeEmbedding::new(first, encoder.time_width(), init);
        let (down_blocks, mid_block) = encoder_blocks(encoder, init);
        let (mut skips, mut before) = (encoder.skip_channels(), encoder.last_channels());
        let level = |level: usize| {
            let block = UpBlock::new(level, before, &mut skips, encoder, init);
            before = encoder.block_channels[level];
            block
        };
        let up_blocks = (0..encoder.levels()).rev().map(level).collect();
        Self {
            conv_in,
            time_embedding,
            down_blocks,
            mid_block,
            up_blocks,
            conv_norm_out: GroupNorm::new(first, encoder.norm_groups, EPSILON, init),
            conv_out: Conv2d::new(first, config.out_channels, 3, init),
            config: config.clone(),
        }
    }

    /// What the network was built from.
    pub fn config(&self) -> &UNetConfig {
        &self.config
    }

    /// The prediction of a network whose views do not meet, without ControlNets.
    ///
    /// # Shapes
    /// - sample: `[N, in, h, w]`, any size
    /// - timesteps: length N
    /// - context: `[N, L, context width]`
    /// - output: `[N, out, h, w]`
    ///
    /// # Panics
    /// When the lengths disagree.
    pub fn forward(&self, sample: Tensor<4>, timesteps: &[f64], context: Tensor<3>) -> Tensor<4> {
        self.forward_with(sample, &UNetInputs { timesteps, context, views: None, control: None })
    }

    /// The prediction with everything that can be given.
    ///
    /// # Shapes
    /// - sample: `[N, in, h, w]`, any size
    /// - output: `[N, out, h, w]`
    ///
    /// # Panics
    /// When the lengths disagree, an adjacency comes without need or is missing, or a view of a panorama does not divide.
    pub fn forward_with(&self, sample: Tensor<4>, inputs: &UNetInputs) -> Tensor<4> {
        let told = (inputs.timesteps, &inputs.context, inputs.views);
        let condition = condition(&sample, &self.config.encoder, &self.time_embedding, told);
        let x = self.conv_in.forward(join_width(sample, condition.joined));
        let (mut skips, mut x) = encode(x, &self.down_blocks, &self.mid_block, &condition);
        if let Some(control) = inputs.control {
            x = control.add_to(&mut skips, x);
        }
        let x = self.up_blocks.iter().fold(x, |x, block| block.forward(x, &condition, &mut skips));
        split_width(self.conv_out.forward(self.conv_norm_out.forward_silu(x)), condition.joined)
    }
}

/// What the blocks are told, after it is checked against the batch and the sizes.
pub(crate) fn condition<'a>(
    sample: &Tensor<4>,
    config: &EncoderConfig,
    time_embedding: &TimeEmbedding,
    (timesteps, context, views): (&[f64], &Tensor<3>, Option<&'a Adjacency>),
) -> Condition<'a> {
    let [n, _, _, w] = sample.dims();
    assert_eq!(timesteps.len(), n, "one time per item");
    assert_eq!(context.dims()[0], n, "one text per item");
    assert_eq!(views.is_some(), config.needs_views(), "an adjacency for networks that let views meet, and only then");
    if let Some(views) = views {
        assert_eq!(views.items(), n, "items of the adjacency");
    }
    let joined = match (config.panels, views) {
        (Panels::JointWidth, Some(views)) => views.views().max(1),
        _ => 1,
    };
    if joined > 1 {
        let factor = 1 << (config.levels() - 1);
        assert_eq!(w % factor, 0, "a view of a panorama must be a multiple of {factor} wide");
        let same = |times: &[f64]| times.iter().all(|t| *t == times[0]);
        assert!(timesteps.chunks(joined).all(same), "the views of a panorama share one time");
    }
    let per_picture: Vec<f64> = timesteps.iter().step_by(joined).copied().collect();
    let time = ops::silu(time_embedding.forward(&per_picture, &sample.device()));
    Condition { time, context: context.clone(), views, joined }
}
