//! BEV-VAE: pictures of one rig to one bird's-eye-view latent, and from it the pictures of any rig.
//!
//! Paper: "Scalable and Generalizable Autonomous Driving Scene Synthesis" (BEV-VAE), section 3. Views never meet directly: all
//! exchange goes through the voxel grid, so what two cameras see of one place agrees by construction.
//! Parity: `tests/it/official.rs`. Shapes: B batch, V views, L latent channels.

use burn::module::Module;
use burn::tensor::{Tensor, TensorData};
use nn::{Bias, Init, Linear};

use crate::BevVaeConfig;
use crate::image_coder::{ImageDecoder, ImageEncoder};
use crate::sample_points::{ViewMatrices, rays_in_grid, voxels_in_views};
use crate::scene_decoder::SceneDecoder;
use crate::scene_encoder::SceneEncoder;
use crate::state_coder::{DiagonalGaussian, StateDecoder, StateEncoder, latent_tokens};

/// Log variance of the posterior before training: standard deviation 0.02. [our choice]
const INITIAL_LOG_VAR: f32 = -8.0;

/// Pictures to BEV tokens.
#[derive(Module, Debug)]
pub struct Encoder {
    /// Each view alone.
    pub image: ImageEncoder,
    /// Views to voxels.
    pub scene: SceneEncoder,
    /// Voxels to BEV tokens.
    pub state: StateEncoder,
}

/// BEV tokens to pictures.
#[derive(Module, Debug)]
pub struct Decoder {
    /// BEV tokens to voxels.
    pub state: StateDecoder,
    /// Voxels to the views asked for.
    pub scene: SceneDecoder,
    /// Each view alone.
    pub image: ImageDecoder,
}

/// The whole network, without the discriminator.
#[derive(Module, Debug)]
pub struct BevVae {
    /// Pictures to BEV tokens.
    pub encoder: Encoder,
    /// BEV tokens to moments of the posterior.
    pub pre_quant: Linear,
    /// Latent to BEV tokens.
    pub post_quant: Linear,
    /// BEV tokens to pictures.
    pub decoder: Decoder,
    #[module(skip)]
    config: BevVaeConfig,
}

/// Decoded pictures and what the adaptive adversarial weight needs.
#[derive(Debug, Clone)]
pub struct Decoded {
    /// `[B, V, 3, H, W]`, ImageNet-normalised like the input.
    pub images: Tensor<5>,
    /// Tokens entering the last layer, `[B·V, h, w, E]`.
    pub last_tokens: Tensor<4>,
}

impl BevVae {
    /// A network with fresh parameters; `config` must be checked.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let (d, l) = (config.state_channels(), config.latent_channels);
        Self {
            encoder: Encoder {
                image: ImageEncoder::new(config, init),
                scene: SceneEncoder::new(config, init),
                state: StateEncoder::new(config, init),
            },
            pre_quant: quiet_posterior(Linear::new(d, 2 * l, Bias::With, init), l),
            post_quant: Linear::new(l, d, Bias::With, init),
            decoder: Decoder {
                state: StateDecoder::new(config, init),
                scene: SceneDecoder::new(config, init),
                image: ImageDecoder::new(config, init),
            },
            config: config.clone(),
        }
    }

    /// Before training: pictures start as this colour, RGB in [0, 1], best the mean of the training data.
    #[must_use]
    pub fn starting_from(mut self, rgb: [f32; 3]) -> Self {
        let colour = std::array::from_fn(|c| (rgb[c] - crate::pixels::MEAN[c]) / crate::pixels::STD[c]);
        self.decoder.image = self.decoder.image.starting_from(colour);
        self
    }

    /// The sizes it was built with.
    pub fn config(&self) -> &BevVaeConfig {
        &self.config
    }

    /// # Shapes
    /// - images: `[B, V, 3, H, W]`, ImageNet-normalised; padded views may hold anything
    /// - cameras: `img_from_ego` of the same views
    /// - output: moments over `[B, N, L]`
    pub fn encode(&self, images: Tensor<5>, cameras: &ViewMatrices) -> DiagonalGaussian {
        let [b, v, channels, h, w] = images.dims();
        assert_eq!([b, v], cameras.view_mask.dims(), "one camera per picture");
        assert_eq!([h, w], [self.config.image.height, self.config.image.width], "network picture size");
        let points = voxels_in_views(&self.config, cameras);
        let features = self.encoder.image.forward(images.reshape([b * v, channels, h, w]), &self.config);
        let scene = self.encoder.scene.forward(features, &points, &self.config);
        let state = self.encoder.state.forward(scene, &self.config);
        DiagonalGaussian::from_moments(self.pre_quant.forward(state))
    }

    /// # Shapes
    /// - latent: `[B, N, L]`
    /// - cameras: `ego_from_img` of any number of views, none of which needs to have been encoded
    pub fn decode(&self, latent: Tensor<3>, cameras: &ViewMatrices) -> Decoded {
        let [b, v] = cameras.view_mask.dims();
        let state = self.post_quant.forward(latent);
        let scene = self.decoder.state.forward(state, &self.config);
        let rays = rays_in_grid(&self.config, cameras);
        let features = self.decoder.scene.forward(scene, &rays, &self.config);
        let (images, last_tokens) = self.decoder.image.forward(features, &self.config);
        let (h, w) = (self.config.image.height, self.config.image.width);
        Decoded { images: images.reshape([b, v, 3, h, w]), last_tokens }
    }

    /// As [`BevVae::decode`], from a latent picture `[B, L, y, x]`.
    pub fn decode_picture(&self, latent: Tensor<4>, cameras: &ViewMatrices) -> Decoded {
        self.decode(latent_tokens(latent), cameras)
    }
}

/// Starts the posterior's noise far below its signal.
///
/// With the framework's defaults a fresh encoder has means that differ by 0.04 between scenes under noise of standard deviation 1:
/// the decoder then learns to ignore the latent before the encoder can say anything.
fn quiet_posterior(layer: Linear, latent: usize) -> Linear {
    let bias = layer.bias.map(|bias| {
        bias.map(|values| {
            let device = values.device();
            let shift = (0..2 * latent).map(|i| if i < latent { 0.0 } else { INITIAL_LOG_VAR }).collect::<Vec<f32>>();
            // A fresh leaf: a sum would hang on the old parameter's tape.
            let start = Tensor::<1>::from_data(TensorData::new(shift, [2 * latent]), &device.clone().inner());
            let start = start + values.inner();
            if device.is_autodiff() { Tensor::from_inner(start).require_grad() } else { start }
        })
    });
    Linear { bias, ..layer }
}
