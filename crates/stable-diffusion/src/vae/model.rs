//! The autoencoder of latent diffusion.
//!
//! Paper: Rombach et al., section 3.1 and appendix G. Parity: `tests/it/vae.rs`. Shapes: N items, f = 2^(levels − 1).

use burn::module::Module;
use burn::tensor::Tensor;
use nn::Init;

use super::coder::{Decoder, Encoder};
use super::{Posterior, Tiling, VaeConfig};
use crate::config::ConfigError;
use crate::layers::Conv2d;

/// Pictures to latents an f-th of their size, and back.
#[derive(Module, Debug)]
pub struct AutoencoderKL {
    /// Pictures to moments.
    pub encoder: Encoder,
    /// Latents to pictures.
    pub decoder: Decoder,
    /// 1×1 over moments.
    pub quant_conv: Conv2d,
    /// 1×1 over latents.
    pub post_quant_conv: Conv2d,
    #[module(skip)]
    config: VaeConfig,
}

impl AutoencoderKL {
    /// Fresh weights. The config must have passed [`VaeConfig::checked`].
    pub fn new(config: &VaeConfig, init: &mut Init) -> Self {
        let latent = config.latent_channels;
        Self {
            encoder: Encoder::new(config, init),
            decoder: Decoder::new(config, init),
            quant_conv: Conv2d::new(2 * latent, 2 * latent, 1, init),
            post_quant_conv: Conv2d::new(latent, latent, 1, init),
            config: config.clone(),
        }
    }

    /// What the network was built from.
    pub fn config(&self) -> &VaeConfig {
        &self.config
    }

    /// The same weights with another scale of the latents, as measured after training.
    ///
    /// # Errors
    /// [`ConfigError`] for a scale that is no positive number.
    pub fn with_scaling_factor(self, scaling_factor: f64) -> Result<Self, ConfigError> {
        let config = VaeConfig { scaling_factor, ..self.config.clone() }.checked()?;
        Ok(Self { config, ..self })
    }

    /// # Shapes
    /// - images: `[N, 3, H, W]` in [−1, 1], H and W multiples of f
    /// - output: moments of `[N, latent, H/f, W/f]`, not scaled
    ///
    /// # Panics
    /// When f does not divide the size.
    pub fn encode(&self, images: Tensor<4>) -> Posterior {
        let ([_, _, h, w], factor) = (images.dims(), self.config.factor());
        assert!(h % factor == 0 && w % factor == 0, "pictures of {w}x{h} pixels must be multiples of {factor}");
        Posterior::from_moments(self.moments(images))
    }

    /// Means and log variances before clamping, `[N, 2·latent, H/f, W/f]`.
    pub fn moments(&self, images: Tensor<4>) -> Tensor<4> {
        self.quant_conv.forward(self.encoder.forward(images))
    }

    /// # Shapes
    /// - latents: `[N, latent, h, w]`, not scaled
    /// - output: `[N, 3, h·f, w·f]`, about [−1, 1], not clamped
    pub fn decode(&self, latents: Tensor<4>) -> Tensor<4> {
        self.decoder.forward(self.post_quant_conv.forward(latents))
    }

    /// What enters the decoder's last convolution, `[N, C, h·f, w·f]`; shapes else as for `decode`.
    pub fn decode_features(&self, latents: Tensor<4>) -> Tensor<4> {
        self.decoder.features(self.post_quant_conv.forward(latents))
    }

    /// [`AutoencoderKL::decode`], `items` of the batch at a time: the same pictures with less memory.
    ///
    /// # Panics
    /// When `items` is 0.
    pub fn decode_in_chunks(&self, latents: Tensor<4>, items: usize) -> Tensor<4> {
        assert!(items > 0, "a chunk holds at least one item");
        Tensor::cat(latents.split(items, 0).into_iter().map(|chunk| self.decode(chunk)).collect(), 0)
    }

    /// [`AutoencoderKL::decode`] in overlapping tiles, for pictures that do not fit in memory at once.
    ///
    /// Norms and the middle attention see one tile at a time, so colours may drift a little from the whole decode; tiles are
    /// blended linearly over their overlap so that no seam shows. Shapes as for `decode`.
    pub fn decode_in_tiles(&self, latents: Tensor<4>, tiling: &Tiling) -> Tensor<4> {
        tiling.decode(latents, self.config.factor(), |tile| self.decode(tile))
    }

    /// Latents as the diffusion model sees them: times the scale of these weights.
    pub fn scale(&self, latents: Tensor<4>) -> Tensor<4> {
        latents * self.config.scaling_factor
    }

    /// The inverse of [`AutoencoderKL::scale`], to be done before decoding.
    pub fn unscale(&self, latents: Tensor<4>) -> Tensor<4> {
        latents / self.config.scaling_factor
    }
}

/// Network values in about [−1, 1] to colours in [0, 1], clamped. Any shape.
pub fn pixels_from_network<const D: usize>(images: Tensor<D>) -> Tensor<D> {
    ((images + 1.0) * 0.5).clamp(0.0, 1.0)
}
