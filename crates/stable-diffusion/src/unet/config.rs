//! Sizes of the UNet and of what a ControlNet copies of it.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, divides, few, positive};
use crate::cross_view::NeighbourMerge;
use crate::panels::Panels;

/// Attention heads of every level.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AttentionHeads {
    /// Number of heads per level (SD 1.5: 8 on each).
    Count(Vec<usize>),
    /// Channels of one head, equal on all levels (SD 2.1: 64).
    Width(usize),
}

/// How a transformer's entry and exit are stored. The arithmetic is the same.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProjectionKind {
    /// A 1×1 convolution, `[D, D, 1, 1]` (SD 1.5).
    Convolution,
    /// A matrix, `[D, D]` (SD 2.1).
    Linear,
}

/// Sizes of the UNet's encoder and middle, which a ControlNet shares.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncoderConfig {
    /// Channels of the noisy latent and of whatever is concatenated to it.
    pub in_channels: usize,
    /// Channels per level, finest first; each level but the last halves the size.
    pub block_channels: Vec<usize>,
    /// Residual blocks per level; the decoder has one more.
    pub resnets_per_level: usize,
    /// Which levels have transformers. The middle always has one.
    pub attention_levels: Vec<bool>,
    /// Heads of every attention; the middle's are those of the last level.
    pub heads: AttentionHeads,
    /// Width of the text tokens.
    pub context_width: usize,
    /// Groups of all group norms.
    pub norm_groups: usize,
    /// How transformers store their entry and exit.
    pub projection: ProjectionKind,
    /// Attention between neighbouring views in every transformer block, and how neighbours are merged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cross_view: Option<NeighbourMerge>,
    /// What convolutions see.
    #[serde(default)]
    pub panels: Panels,
}

impl EncoderConfig {
    /// Whether the network must be told which views belong together.
    #[must_use]
    pub fn needs_views(&self) -> bool {
        self.cross_view.is_some() || self.panels == Panels::JointWidth
    }

    /// Number of levels.
    #[must_use]
    pub fn levels(&self) -> usize {
        self.block_channels.len()
    }

    /// Heads of one level.
    #[must_use]
    pub fn heads_of(&self, level: usize) -> usize {
        match &self.heads {
            AttentionHeads::Count(counts) => counts[level],
            AttentionHeads::Width(width) => self.block_channels[level] / width,
        }
    }

    /// Channels of the finest level.
    #[must_use]
    pub fn first_channels(&self) -> usize {
        self.block_channels[0]
    }

    /// Channels of the coarsest level and the middle.
    #[must_use]
    pub fn last_channels(&self) -> usize {
        self.block_channels[self.levels() - 1]
    }

    /// Width of the time embedding.
    #[must_use]
    pub fn time_width(&self) -> usize {
        4 * self.first_channels()
    }

    /// Channels of the skips in the order in which the encoder makes them.
    #[must_use]
    pub fn skip_channels(&self) -> Vec<usize> {
        let mut channels = vec![self.first_channels()];
        for (level, &c) in self.block_channels.iter().enumerate() {
            let down = usize::from(level + 1 < self.levels());
            channels.extend(std::iter::repeat_n(c, self.resnets_per_level + down));
        }
        channels
    }

    /// Refuses sizes that build no network.
    pub(crate) fn check(&self) -> Result<(), ConfigError> {
        let levels = self.levels();
        few("levels of block_channels", levels)?;
        positive("in_channels", self.in_channels)?;
        few("resnets_per_level", self.resnets_per_level)?;
        positive("context_width", self.context_width)?;
        let same_length = |what: &str, found: usize| {
            if found == levels { Ok(()) } else { Err(ConfigError::Levels { what: what.to_owned(), found, levels }) }
        };
        same_length("attention_levels", self.attention_levels.len())?;
        if let AttentionHeads::Count(counts) = &self.heads {
            same_length("heads", counts.len())?;
        }
        for (level, &channels) in self.block_channels.iter().enumerate() {
            divides(("norm_groups", self.norm_groups), ("block_channels", channels))?;
            match &self.heads {
                AttentionHeads::Count(counts) => divides(("heads", counts[level]), ("block_channels", channels))?,
                AttentionHeads::Width(width) => divides(("head width", *width), ("block_channels", channels))?,
            }
        }
        // The time code is half cosines and half sines.
        divides(("the two halves of the time code", 2), ("block_channels", self.first_channels()))
    }
}

/// Every size of a [`UNet2DCondition`](super::UNet2DCondition).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UNetConfig {
    /// What a ControlNet shares.
    pub encoder: EncoderConfig,
    /// Channels of the prediction.
    pub out_channels: usize,
    /// Latent size at training time; not used here, but by other tools that open the folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample_size: Option<usize>,
}

impl UNetConfig {
    /// The config, if it builds a network.
    ///
    /// # Errors
    /// [`ConfigError`] for zero sizes, lists of other lengths than the levels, groups or heads that divide no level.
    pub fn checked(self) -> Result<Self, ConfigError> {
        self.encoder.check()?;
        positive("out_channels", self.out_channels)?;
        // A decoder's norm sees the skip beside the hidden state.
        let skips = self.encoder.skip_channels();
        let mut hidden = self.encoder.last_channels();
        let per_level = self.encoder.resnets_per_level + 1;
        for (i, skip) in skips.iter().rev().enumerate() {
            divides(("norm_groups", self.encoder.norm_groups), ("hidden and skip channels", hidden + skip))?;
            hidden = self.encoder.block_channels[self.encoder.levels() - 1 - i / per_level];
        }
        Ok(self)
    }
}
