//! The whole network run in segments: the tape never holds more than one block, and the way back computes each block again
//! (see [`nn::segments`]). Gradients are those of the plain path up to rounding.
//!
//! Shapes: B batch, V views, N BEV tokens, L latent channels.

mod stages;
mod way_back;

use burn::module::Module;
use burn::optim::{GradientsAccumulator, GradientsParams};
use burn::tensor::Tensor;
use nn::segments::Segments;

pub use self::stages::OnBoth;
use self::stages::Surroundings;
use self::way_back::{WayBack, kl_gradient};
use crate::BevVae;
use crate::sample_points::{ViewMatrices, rays_in_grid, voxels_in_views};
use crate::state_coder::DiagonalGaussian;

/// Blocks per segment. A block's input is small beside what it computes.
const LENGTH: usize = 1;

/// A forward pass that kept the inputs of its segments only.
pub struct SegmentedPass {
    around: Surroundings,
    /// Network pictures, `[B·V, 3, H, W]`.
    input: Tensor<4>,
    image_encoder: Segments<3, 1>,
    scene_encoder: Segments<3, 4>,
    state_encoder: Segments<3, 1>,
    moments: Tensor<3>,
    state_decoder: Segments<3, 1>,
    scene_decoder: Segments<4, 3>,
    image_decoder: Segments<3, 1>,
    images: Tensor<5>,
    last_tokens: Tensor<4>,
}

impl SegmentedPass {
    /// Encodes, samples the posterior and decodes.
    ///
    /// # Shapes
    /// - images: `[B, V, 3, H, W]`, ImageNet-normalised, without a tape
    /// - encode, decode: cameras that look and cameras that are asked to see
    /// - noise: draws standard normal numbers `[B, N, L]`, without a tape
    pub fn forward(
        model: &BevVae,
        images: Tensor<5>,
        [encode, decode]: [&OnBoth<ViewMatrices>; 2],
        noise: impl FnOnce([usize; 3]) -> Tensor<3>,
    ) -> Self {
        let config = model.config().clone();
        let [b, v, c, h, w] = images.dims();
        let input = images.reshape([b * v, c, h, w]);
        let plain = model.valid();
        let mut around = Surroundings {
            voxels: encode.map(|cameras| voxels_in_views(&config, cameras)),
            rays: decode.map(|cameras| rays_in_grid(&config, cameras)),
            noise: Tensor::zeros([1, 1, 1], &input.device()),
            config,
        };
        let unused = || Tensor::<1>::zeros([1], &input.device());
        let (encoder, decoder) = (&model.encoder, &model.decoder);

        let start = around.patches(&plain, input.clone());
        let image_encoder =
            Segments::forward(&encoder.image.stack.blocks, LENGTH, (start, unused()), &around.image_block());
        let values = around.image_values(&plain, image_encoder.output());
        let start = plain.encoder.scene.queries(b, &around.config);
        let scene_encoder = Segments::forward(&encoder.scene.blocks, LENGTH, (start, values), &around.voxel_block());
        let start = around.state_tokens(&plain, scene_encoder.output());
        let state_encoder =
            Segments::forward(&encoder.state.stack.blocks, LENGTH, (start, unused()), &around.state_block());
        let moments = around.moments(&plain, state_encoder.output());

        let [_, n, double] = moments.dims();
        around.noise = noise([b, n, double / 2]);
        let start = around.decoder_tokens(&plain, moments.clone());
        let state_decoder =
            Segments::forward(&decoder.state.stack.blocks, LENGTH, (start, unused()), &around.state_block());
        let values = around.scene_values(&plain, state_decoder.output());
        let start = plain.decoder.scene.queries(b, around.rays.plain.valid.dims()[1], &around.config);
        let scene_decoder = Segments::forward(&decoder.scene.blocks, LENGTH, (start, values), &around.ray_block());
        let start = around.image_features(&plain, scene_decoder.output());
        let image_decoder =
            Segments::forward(&decoder.image.stack.blocks, LENGTH, (start, unused()), &around.image_block());
        let last_tokens = around.last_tokens(&plain, image_decoder.output());
        let images = around.pictures(&plain, image_decoder.output());
        Self {
            around,
            input,
            image_encoder,
            scene_encoder,
            state_encoder,
            moments,
            state_decoder,
            scene_decoder,
            image_decoder,
            images,
            last_tokens,
        }
    }

    /// Decoded pictures `[B, V, 3, H, W]`, without a tape.
    pub fn images(&self) -> Tensor<5> {
        self.images.clone()
    }

    /// Tokens entering the last layer, `[B·V, h, w, E]`, without a tape.
    pub fn last_tokens(&self) -> Tensor<4> {
        self.last_tokens.clone()
    }

    /// The posterior, without a tape.
    pub fn posterior(&self) -> DiagonalGaussian {
        DiagonalGaussian::from_moments(self.moments.clone())
    }

    /// Gradients of a loss that has the gradient `upstream` at the decoded pictures, plus `kl_weight` times the mean KL term.
    pub fn backward(self, model: &BevVae, upstream: Tensor<5>, kl_weight: f64) -> GradientsParams {
        let around = &self.around;
        let mut way = WayBack { model, gradients: GradientsAccumulator::new() };
        let (encoder, decoder) = (&model.encoder, &model.decoder);

        let up = way.piece(self.image_decoder.output(), upstream, |m, x| around.pictures(m, x));
        let up = way.stack(self.image_decoder, &decoder.image.stack.blocks, up, &around.image_block());
        let up = way.piece(self.scene_decoder.output(), up, |m, x| around.image_features(m, x));
        let (queries, values) = way.conditioned(self.scene_decoder, &decoder.scene.blocks, up, &around.ray_block());
        let [b, views, ..] = queries.dims();
        way.table(queries, |m| m.decoder.scene.queries(b, views, &around.config));
        let up = way.piece(self.state_decoder.output(), values, |m, x| around.scene_values(m, x));
        let up = way.stack(self.state_decoder, &decoder.state.stack.blocks, up, &around.state_block());
        let up = way.piece(self.moments.clone(), up, |m, x| around.decoder_tokens(m, x))
            + kl_gradient(self.moments, kl_weight);

        let up = way.piece(self.state_encoder.output(), up, |m, x| around.moments(m, x));
        let up = way.stack(self.state_encoder, &encoder.state.stack.blocks, up, &around.state_block());
        let up = way.piece(self.scene_encoder.output(), up, |m, x| around.state_tokens(m, x));
        let (queries, values) = way.conditioned(self.scene_encoder, &encoder.scene.blocks, up, &around.voxel_block());
        way.table(queries, |m| m.encoder.scene.queries(b, &around.config));
        let up = way.piece(self.image_encoder.output(), values, |m, x| around.image_values(m, x));
        let up = way.stack(self.image_encoder, &encoder.image.stack.blocks, up, &around.image_block());
        way.piece(self.input, up, |m, x| around.patches(m, x));
        way.gradients.grads()
    }
}
