//! Sizes of a ControlNet.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, few, positive};
use crate::unet::EncoderConfig;

/// Every size of a [`ControlNet`](super::ControlNet).
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ControlNetConfig {
    /// That of the UNet it steers.
    pub encoder: EncoderConfig,
    /// Channels of the condition picture.
    pub condition_channels: usize,
    /// Channels of the condition embedder; each step halves the size, so that it ends at the latent's.
    pub embedding_channels: Vec<usize>,
}

impl ControlNetConfig {
    /// The config, if it builds a network.
    ///
    /// # Errors
    /// [`ConfigError`] as for the UNet, and for zero channels of condition or embedder.
    pub fn checked(self) -> Result<Self, ConfigError> {
        self.encoder.check()?;
        positive("condition_channels", self.condition_channels)?;
        few("steps of embedding_channels", self.embedding_channels.len())?;
        self.embedding_channels.iter().try_for_each(|c| positive("embedding_channels", *c))?;
        Ok(self)
    }

    /// Condition pixels per latent cell along each axis.
    #[must_use]
    pub fn factor(&self) -> usize {
        1 << self.embedding_channels.len().saturating_sub(1)
    }
}
