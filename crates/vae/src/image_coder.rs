//! Image encoder and decoder: a patch embedding and a rotary transformer on each view alone.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::{Init, PatchConv2d, PatchDeconv2d, RotaryAngles, RotaryStack};

use crate::BevVaeConfig;

/// Pictures to tokens (section 4.1).
#[derive(Module, Debug)]
pub struct ImageEncoder {
    /// 8×8 patches to tokens.
    pub patch: PatchConv2d,
    /// Mixes the tokens of one view.
    pub stack: RotaryStack,
}

impl ImageEncoder {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let i = &config.image;
        Self {
            patch: PatchConv2d::new(3, i.channels, i.patch, init),
            stack: RotaryStack::new(i.channels, i.heads, i.encoder_blocks, init),
        }
    }

    /// # Shapes
    /// - images: `[B·V, 3, H, W]`, ImageNet-normalised
    /// - output: `[B·V, E, h, w]`
    pub fn forward(&self, images: Tensor<4>, config: &BevVaeConfig) -> Tensor<4> {
        let tokens = self.patch.forward(images);
        let [n, h, w, e] = tokens.dims();
        let tokens = self.stack.forward(tokens.reshape([n, h * w, e]), &rotary_angles(config));
        tokens.swap_dims(1, 2).reshape([n, e, h, w])
    }
}

/// Features of a view to its picture (section 4.7).
#[derive(Module, Debug)]
pub struct ImageDecoder {
    /// Mixes the tokens of one view.
    pub stack: RotaryStack,
    /// Tokens to 8×8 patches; its weight is the "last layer" of the adaptive adversarial weight.
    pub pixels: PatchDeconv2d,
}

impl ImageDecoder {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let i = &config.image;
        Self {
            stack: RotaryStack::new(i.channels, i.heads, i.decoder_blocks, init),
            pixels: PatchDeconv2d::zeros(i.channels, 3, i.patch, init),
        }
    }

    /// Starts from pictures of one colour, in network values: with random first pictures the stack first learns to make all
    /// tokens alike, and takes long to tell them apart again. [our choice]
    #[must_use]
    pub fn starting_from(mut self, colour: [f32; 3]) -> Self {
        self.pixels.bias = self.pixels.bias.map(|bias| {
            let device = bias.device();
            let start = Tensor::<1>::from_floats(colour, &device.clone().inner());
            if device.is_autodiff() { Tensor::from_inner(start).require_grad() } else { start }
        });
        self
    }

    /// The pictures, and the tokens that enter the last layer.
    ///
    /// # Shapes
    /// - features: `[B·V, h·w, E]`
    /// - output: `[B·V, 3, H, W]` and `[B·V, h, w, E]`
    pub fn forward(&self, features: Tensor<3>, config: &BevVaeConfig) -> (Tensor<4>, Tensor<4>) {
        let [n, _, e] = features.dims();
        let [h, w] = config.image_tokens();
        let tokens = self.stack.forward(features, &rotary_angles(config)).reshape([n, h, w, e]);
        (self.pixels.forward(tokens.clone()), tokens)
    }
}

/// Rotation angles of one view's patches.
pub fn rotary_angles(config: &BevVaeConfig) -> RotaryAngles {
    let [h, w] = config.image_tokens();
    RotaryAngles::grid_2d(h, w, config.image.channels / config.image.heads)
}
