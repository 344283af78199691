//! The network cut into stages: what stands between the stacks, and one block of each stack.

use burn::tensor::Tensor;
use nn::{RotaryAngles, RotaryBlock};

use crate::sample_points::SamplePoints;
use crate::scene_decoder::{SceneDecoderBlock, flatten_volumes};
use crate::scene_encoder::{SceneEncoderBlock, flatten_levels};
use crate::state_coder::DiagonalGaussian;
use crate::{BevVae, BevVaeConfig, image_coder, state_coder};

/// The same values without a tape and for use on it.
#[derive(Debug, Clone)]
pub struct OnBoth<T> {
    /// Without a tape.
    pub plain: T,
    /// On the device with the tape.
    pub taped: T,
}

impl<T: Clone> OnBoth<T> {
    /// Makes both by one rule.
    pub fn map<U>(&self, rule: impl Fn(&T) -> U) -> OnBoth<U> {
        OnBoth { plain: rule(&self.plain), taped: rule(&self.taped) }
    }

    fn beside<const D: usize>(&self, neighbour: &Tensor<D>) -> &T {
        if neighbour.device().is_autodiff() { &self.taped } else { &self.plain }
    }
}

/// Where cameras look, and the noise of the posterior: what every block may need besides its input.
pub(super) struct Surroundings {
    pub config: BevVaeConfig,
    pub voxels: OnBoth<SamplePoints>,
    pub rays: OnBoth<SamplePoints>,
    /// `[B, N, L]`, without a tape.
    pub noise: Tensor<3>,
}

/// The stages between stacks and the blocks of each stack, on the device of their input.
impl Surroundings {
    pub fn patches(&self, model: &BevVae, images: Tensor<4>) -> Tensor<3> {
        let tokens = model.encoder.image.patch.forward(images);
        let [n, h, w, e] = tokens.dims();
        tokens.reshape([n, h * w, e])
    }

    pub fn image_values(&self, model: &BevVae, tokens: Tensor<3>) -> Tensor<4> {
        let [n, _, e] = tokens.dims();
        let [h, w] = self.config.image_tokens();
        let [b, v, _] = self.voxels.plain.valid.dims();
        let features = model.encoder.image.stack.norm.forward(tokens).swap_dims(1, 2).reshape([n, e, h, w]);
        flatten_levels(model.encoder.scene.pyramid.forward(features), b, v)
    }

    pub fn state_tokens(&self, model: &BevVae, voxels: Tensor<3>) -> Tensor<3> {
        let [b, _, c] = voxels.dims();
        let [z, y, x] = self.config.grid.cells;
        let scene = model.encoder.scene.norm.forward(voxels).swap_dims(1, 2).reshape([b, c, z, y, x]);
        model.encoder.state.tokens(scene)
    }

    pub fn moments(&self, model: &BevVae, tokens: Tensor<3>) -> Tensor<3> {
        model.pre_quant.forward(model.encoder.state.stack.norm.forward(tokens))
    }

    pub fn decoder_tokens(&self, model: &BevVae, moments: Tensor<3>) -> Tensor<3> {
        let taped = moments.device().is_autodiff();
        let noise = if taped { Tensor::from_inner(self.noise.clone()) } else { self.noise.clone() };
        model.post_quant.forward(DiagonalGaussian::from_moments(moments).sample(noise))
    }

    pub fn scene_values(&self, model: &BevVae, tokens: Tensor<3>) -> Tensor<3> {
        let state = &model.decoder.state;
        let scene = state.voxels(state.stack.norm.forward(tokens), &self.config);
        flatten_volumes(model.decoder.scene.pyramid.forward(scene))
    }

    pub fn image_features(&self, model: &BevVae, points: Tensor<4>) -> Tensor<3> {
        let scene = &model.decoder.scene;
        scene.out.forward(scene.collapse(points, self.config.frustum.depths))
    }

    pub fn last_tokens(&self, model: &BevVae, tokens: Tensor<3>) -> Tensor<4> {
        let [n, _, e] = tokens.dims();
        let [h, w] = self.config.image_tokens();
        model.decoder.image.stack.norm.forward(tokens).reshape([n, h, w, e])
    }

    pub fn pictures(&self, model: &BevVae, tokens: Tensor<3>) -> Tensor<5> {
        let images = model.decoder.image.pixels.forward(self.last_tokens(model, tokens));
        let [_, c, h, w] = images.dims();
        let [b, v, _] = self.rays.plain.valid.dims();
        images.reshape([b, v, c, h, w])
    }

    pub fn image_block(&self) -> impl Fn(&RotaryBlock, Tensor<3>, Tensor<1>) -> Tensor<3> + use<> {
        rotary_block(image_coder::rotary_angles(&self.config))
    }

    pub fn state_block(&self) -> impl Fn(&RotaryBlock, Tensor<3>, Tensor<1>) -> Tensor<3> + use<> {
        rotary_block(state_coder::rotary_angles(&self.config))
    }

    pub fn voxel_block(&self) -> impl Fn(&SceneEncoderBlock, Tensor<3>, Tensor<4>) -> Tensor<3> + '_ {
        let levels = self.config.image_levels();
        move |block, voxels, values| {
            let points = self.voxels.beside(&voxels);
            block.forward(voxels, values, points, &levels)
        }
    }

    pub fn ray_block(&self) -> impl Fn(&SceneDecoderBlock, Tensor<4>, Tensor<3>) -> Tensor<4> + '_ {
        let levels = self.config.scene_levels();
        move |block, points, values| {
            let rays = self.rays.beside(&points);
            block.forward(points, values, rays, &levels, self.config.frustum.depths)
        }
    }
}

fn rotary_block(angles: RotaryAngles) -> impl Fn(&RotaryBlock, Tensor<3>, Tensor<1>) -> Tensor<3> {
    move |block, tokens, _| {
        let rotation = angles.cos_sin(&tokens.device());
        block.forward(tokens, rotation)
    }
}
