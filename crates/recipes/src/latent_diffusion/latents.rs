//! The frozen autoencoder: pictures of a batch to scaled latents, and back.

use std::path::Path;

use anyhow::Context;
use burn::tensor::{Device, Tensor};
use data::{ImageSize, SceneBatch};
use rand_chacha::ChaCha8Rng;
use stable_diffusion::AutoencoderKL;
use stable_diffusion::layout::load_folder;

use crate::autoencoder::check_size;
use crate::tensors::{displayed_signed, normal, pictures, signed};

/// Pictures decoded at a time; more would only cost memory.
const CHUNK: usize = 8;

/// A frozen autoencoder, without a tape.
#[derive(Debug)]
pub struct LatentCoder {
    autoencoder: AutoencoderKL,
    device: Device,
}

impl LatentCoder {
    /// Opens the folder of an autoencoder for pictures of this size.
    ///
    /// # Errors
    /// Files that cannot be read or do not fit, pictures that it cannot halve, latents of another number of channels than the UNet's.
    pub fn open(folder: &Path, (image, channels): (ImageSize, usize), device: &Device) -> anyhow::Result<Self> {
        let device = device.clone().without_autodiff();
        let autoencoder: AutoencoderKL = load_folder(folder, &device).context(
            "autoencoder: the folder of a trained one is needed; `train-autoencoder` writes it as `vae` into its run",
        )?;
        let config = autoencoder.config();
        check_size(image, config.factor())?;
        anyhow::ensure!(
            config.latent_channels == channels,
            "the autoencoder's latents have {} channels, the UNet takes and gives {channels}: {}",
            config.latent_channels,
            folder.display()
        );
        Ok(Self { autoencoder, device })
    }

    /// The network.
    pub fn autoencoder(&self) -> &AutoencoderKL {
        &self.autoencoder
    }

    /// Size of latents, `[C, h, w]`.
    pub fn latent_size(&self, image: ImageSize) -> [usize; 3] {
        let config = self.autoencoder.config();
        let factor = config.factor();
        [config.latent_channels, image.height as usize / factor, image.width as usize / factor]
    }

    /// Draws scaled latents of all views, `[B·V, C, h, w]`.
    pub fn encode(&self, batch: &SceneBatch, rng: &mut ChaCha8Rng) -> Tensor<4> {
        let images = signed(pictures(&batch.target, &self.device));
        let [b, v, c, h, w] = images.dims();
        let posterior = self.autoencoder.encode(images.reshape([b * v, c, h, w]));
        let noise = normal(posterior.mean.dims(), rng, &self.device);
        self.autoencoder.scale(posterior.sample(noise))
    }

    /// RGB in [0, 1] of scaled latents, one `[3, H, W]` per item.
    pub fn decode(&self, latents: Tensor<4>) -> Vec<Vec<f32>> {
        displayed_signed(self.autoencoder.decode_in_chunks(self.autoencoder.unscale(latents), CHUNK))
    }
}
