//! Sizes that go together.

use serde::{Deserialize, Serialize};

use crate::controlnet::ControlNetConfig;
use crate::panels::Panels;
use crate::unet::{AttentionHeads, EncoderConfig, ProjectionKind, UNetConfig};
use crate::vae::VaeConfig;

/// The scale of Stable Diffusion's own latents.
const SD_SCALE: f64 = 0.18215;

/// Networks of one size.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// 32×32 pictures; seconds on a CPU.
    Debug,
    /// 64×112 pictures; minutes on a CPU.
    Tiny,
    /// One GPU without published weights.
    Small,
    /// Stable Diffusion 1.5.
    Sd15,
    /// Stable Diffusion 2.1.
    Sd21,
}

impl Preset {
    /// All of them, smallest first.
    pub const ALL: [Self; 5] = [Self::Debug, Self::Tiny, Self::Small, Self::Sd15, Self::Sd21];

    /// The autoencoder. Below `Small` its scale is to be measured after training; until then it is 1.
    #[must_use]
    pub fn vae(self) -> VaeConfig {
        let (block_channels, resnets_per_level, norm_groups, scaling_factor, sample_size) = match self {
            Self::Debug => (vec![8, 8, 16], 1, 4, 1.0, None),
            Self::Tiny => (vec![16, 32, 32, 32], 1, 8, 1.0, None),
            Self::Small | Self::Sd15 => (vec![128, 256, 512, 512], 2, 32, SD_SCALE, Some(512)),
            Self::Sd21 => (vec![128, 256, 512, 512], 2, 32, SD_SCALE, Some(768)),
        };
        VaeConfig { block_channels, resnets_per_level, norm_groups, latent_channels: 4, scaling_factor, sample_size }
    }

    /// The UNet.
    #[must_use]
    pub fn unet(self) -> UNetConfig {
        let sample_size = match self {
            Self::Debug | Self::Tiny | Self::Small => None,
            Self::Sd15 => Some(64),
            Self::Sd21 => Some(96),
        };
        UNetConfig { encoder: self.encoder(), out_channels: 4, sample_size }
    }

    /// The ControlNet for pictures of `condition_channels` channels.
    #[must_use]
    pub fn controlnet(self, condition_channels: usize) -> ControlNetConfig {
        let embedding_channels = match self {
            Self::Debug => vec![4, 8, 16],
            Self::Tiny => vec![8, 16, 32, 64],
            Self::Small | Self::Sd15 | Self::Sd21 => vec![16, 32, 96, 256],
        };
        ControlNetConfig { encoder: self.encoder(), condition_channels, embedding_channels }
    }

    fn encoder(self) -> EncoderConfig {
        let of = |channels: &[usize], resnets_per_level, attention: &[bool], heads, context_width, norm_groups| {
            let projection = match self {
                Self::Sd15 => ProjectionKind::Convolution,
                _ => ProjectionKind::Linear,
            };
            EncoderConfig {
                in_channels: 4,
                block_channels: channels.to_vec(),
                resnets_per_level,
                attention_levels: attention.to_vec(),
                heads,
                context_width,
                norm_groups,
                projection,
                cross_view: None,
                panels: Panels::PerView,
            }
        };
        let count = |heads: usize, levels: usize| AttentionHeads::Count(vec![heads; levels]);
        let (sd, upper) = ([320, 640, 1280, 1280], [true, true, true, false]);
        match self {
            Self::Debug => of(&[8, 16], 1, &[true, false], count(2, 2), 16, 4),
            Self::Tiny => of(&[32, 64, 64], 1, &[true, true, false], count(4, 3), 64, 8),
            Self::Small => of(&[128, 256, 384, 384], 2, &upper, count(8, 4), 384, 32),
            Self::Sd15 => of(&sd, 2, &upper, count(8, 4), 768, 32),
            Self::Sd21 => of(&sd, 2, &upper, AttentionHeads::Width(64), 1024, 32),
        }
    }
}
