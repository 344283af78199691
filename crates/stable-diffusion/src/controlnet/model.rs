//! The ControlNet itself.
//!
//! Paper: Zhang et al., section 3. Parity: `tests/it/controlnet.rs`. Shapes: N items, K condition channels, f pixels per latent
//! cell.

use std::collections::BTreeMap;

use burn::module::Module;
use burn::tensor::Tensor;
use nn::Init;
use nn::weights::{HostTensor, Mismatch, WeightError, fill_some_params, named_params, param_shapes};

use super::{ConditionEmbedding, ControlNetConfig, ControlResiduals};
use crate::cross_view::Adjacency;
use crate::layers::Conv2d;
use crate::panels::join_width;
use crate::unet::{DownBlock, MidBlock, TimeEmbedding, UNet2DCondition, condition, encode, encoder_blocks};

/// Noisy latent, time, text and condition picture to residuals for the UNet.
#[derive(Module, Debug)]
pub struct ControlNet {
    /// 3×3 from latents.
    pub conv_in: Conv2d,
    /// As in the UNet.
    pub time_embedding: TimeEmbedding,
    /// Condition picture to latent size.
    pub controlnet_cond_embedding: ConditionEmbedding,
    /// As in the UNet.
    pub down_blocks: Vec<DownBlock>,
    /// As in the UNet.
    pub mid_block: MidBlock,
    /// 1×1 per skip, zero at the start.
    pub controlnet_down_blocks: Vec<Conv2d>,
    /// 1×1, zero at the start.
    pub controlnet_mid_block: Conv2d,
    #[module(skip)]
    config: ControlNetConfig,
}

/// What a ControlNet is given beside the noisy latent.
#[derive(Debug, Clone)]
pub struct ControlInputs<'a> {
    /// Diffusion time of each item, length N.
    pub timesteps: &'a [f64],
    /// Text tokens, `[N, L, context width]`.
    pub context: Tensor<3>,
    /// Condition picture, `[N, K, h·f, w·f]`.
    pub condition: Tensor<4>,
    /// Which views are neighbours, exactly in networks that let views meet.
    pub views: Option<&'a Adjacency>,
    /// All residuals are multiplied by it.
    pub scale: f64,
}

impl ControlNet {
    /// Fresh weights; all residuals are 0. The config must have passed [`ControlNetConfig::checked`].
    pub fn new(config: &ControlNetConfig, init: &mut Init) -> Self {
        let encoder = &config.encoder;
        let first = encoder.first_channels();
        let conv_in = Conv2d::new(encoder.in_channels, first, 3, init);
        let time_embedding = TimeEmbedding::new(first, encoder.time_width(), init);
        let controlnet_cond_embedding = ConditionEmbedding::new(config, init);
        let (down_blocks, mid_block) = encoder_blocks(encoder, init);
        let skips = encoder.skip_channels();
        let last = encoder.last_channels();
        Self {
            conv_in,
            time_embedding,
            controlnet_cond_embedding,
            down_blocks,
            mid_block,
            controlnet_down_blocks: skips.into_iter().map(|c| Conv2d::zeros(c, c, 1, init)).collect(),
            controlnet_mid_block: Conv2d::zeros(last, last, 1, init),
            config: config.clone(),
        }
    }

    /// A ControlNet whose encoder and middle start as the UNet's.
    ///
    /// # Errors
    /// [`WeightError::Mismatch`] when the UNet's encoder has other sizes than `config.encoder`, [`WeightError::Readback`].
    pub fn from_unet(config: &ControlNetConfig, unet: &UNet2DCondition, init: &mut Init) -> Result<Self, WeightError> {
        let control = Self::new(config, init);
        let shared = |name: &str| !name.starts_with("controlnet_");
        let mut found: BTreeMap<String, HostTensor> = BTreeMap::new();
        for (prefix, tensors) in [
            ("conv_in", named_params(&unet.conv_in)?),
            ("time_embedding", named_params(&unet.time_embedding)?),
            ("down_blocks", named_params(&unet.down_blocks)?),
            ("mid_block", named_params(&unet.mid_block)?),
        ] {
            found.extend(tensors.into_iter().map(|(name, tensor)| (format!("{prefix}.{name}"), tensor)));
        }
        let wanted = param_shapes(&control).into_iter().filter(|(name, _)| shared(name)).collect();
        let shapes = found.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect();
        let mismatch = Mismatch::between(&wanted, &shapes);
        if !mismatch.is_empty() {
            return Err(WeightError::Mismatch(Box::new(mismatch)));
        }
        fill_some_params(control, |name, _| Ok(found.remove(name).map(|tensor| tensor.data)))
    }

    /// What the network was built from.
    pub fn config(&self) -> &ControlNetConfig {
        &self.config
    }

    /// # Shapes
    /// - sample: `[N, in, h, w]`
    /// - output: of the UNet's skips and middle, of panoramas where its views are joined
    ///
    /// # Panics
    /// When the lengths disagree, or the condition is not f times the sample's size.
    pub fn forward(&self, sample: Tensor<4>, inputs: &ControlInputs) -> ControlResiduals {
        let ([n, _, h, w], f) = (sample.dims(), self.config.factor());
        let expected = [n, self.config.condition_channels, h * f, w * f];
        assert_eq!(inputs.condition.dims(), expected, "condition picture [N, K, h·{f}, w·{f}]");
        let told = (inputs.timesteps, &inputs.context, inputs.views);
        let told = condition(&sample, &self.config.encoder, &self.time_embedding, told);
        let join = |x: Tensor<4>| join_width(x, told.joined);
        let hint = self.controlnet_cond_embedding.forward(join(inputs.condition.clone()));
        let x = self.conv_in.forward(join(sample)) + hint;
        let (skips, middle) = encode(x, &self.down_blocks, &self.mid_block, &told);
        let down = self.controlnet_down_blocks.iter().zip(skips).map(|(conv, skip)| conv.forward(skip)).collect();
        let residuals = ControlResiduals { down, middle: self.controlnet_mid_block.forward(middle) };
        residuals.scaled(inputs.scale)
    }
}
