//! The perceptual term with its frozen network.

use anyhow::Context;
use burn::tensor::{Device, Tensor};
use features::Vgg16;
use vae::pixels::denormalise;

use super::PerceptualConfig;

/// What a network's pictures hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PixelRange {
    /// ImageNet-normalised.
    ImageNet,
    /// RGB in [−1, 1].
    Signed,
}

/// VGG-16 and how it is used.
#[derive(Debug)]
pub struct Perceptual {
    network: Vgg16,
    config: PerceptualConfig,
    range: PixelRange,
}

impl Perceptual {
    /// Loads the weights if the config names any.
    ///
    /// # Errors
    /// Names the weights file.
    pub fn open(config: &PerceptualConfig, range: PixelRange, device: &Device) -> anyhow::Result<Option<Self>> {
        let Some(path) = &config.weights else { return Ok(None) };
        let network = Vgg16::load(path, device).context("loss.perceptual.weights")?;
        Ok(Some(Self { network, config: config.clone(), range }))
    }

    /// Views it looks at per step; 0 for all.
    pub fn views(&self) -> usize {
        self.config.views
    }

    /// Weighted L_perc of network pictures.
    ///
    /// # Shapes
    /// - decoded, target: `[N, 3, H, W]`, in the range given at opening
    /// - output: `[1]`
    pub fn loss(&self, decoded: Tensor<4>, target: Tensor<4>) -> Tensor<1> {
        let rgb = |x: Tensor<4>| match self.range {
            PixelRange::Signed => (x + 1.0) * 0.5,
            PixelRange::ImageNet => {
                let [n, c, h, w] = x.dims();
                denormalise(x.reshape([1, n, c, h, w])).reshape([n, c, h, w])
            }
        };
        self.network.perceptual_loss(rgb(target), rgb(decoded), self.config.last) * self.config.weight
    }
}
