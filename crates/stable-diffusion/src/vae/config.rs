//! Sizes of the autoencoder.

use serde::{Deserialize, Serialize};

use crate::config::{ConfigError, divides, few, positive};

/// Every size of an [`AutoencoderKL`](super::AutoencoderKL), and the scale of its latents.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VaeConfig {
    /// Channels per level, finest first; each level but the last halves the size.
    pub block_channels: Vec<usize>,
    /// Residual blocks per level of the encoder; the decoder has one more.
    pub resnets_per_level: usize,
    /// Groups of all norms.
    pub norm_groups: usize,
    /// Channels of the latent.
    pub latent_channels: usize,
    /// The diffusion model's latents are the autoencoder's times this number. It belongs to the weights.
    pub scaling_factor: f64,
    /// Picture size at training time, px; not used here, but by other tools that open the folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample_size: Option<usize>,
}

impl VaeConfig {
    /// The config, if it builds a network.
    ///
    /// # Errors
    /// [`ConfigError`] for zero sizes, groups that do not divide a level, or a scale that is no positive number.
    pub fn checked(self) -> Result<Self, ConfigError> {
        few("levels of block_channels", self.block_channels.len())?;
        few("resnets_per_level", self.resnets_per_level)?;
        positive("latent_channels", self.latent_channels)?;
        for &channels in &self.block_channels {
            divides(("norm_groups", self.norm_groups), ("block_channels", channels))?;
        }
        if !(self.scaling_factor.is_finite() && self.scaling_factor > 0.0) {
            let reason = format!("must be a positive number, not {}", self.scaling_factor);
            return Err(ConfigError::Range { what: "scaling_factor".to_owned(), reason });
        }
        Ok(self)
    }

    /// Pixels per latent cell along each axis.
    #[must_use]
    pub fn factor(&self) -> usize {
        1 << self.block_channels.len().saturating_sub(1)
    }
}
