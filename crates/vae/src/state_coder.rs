//! State encoder and decoder: the voxel grid to BEV tokens and back, and the posterior between them (sections 4.3 to 4.5).

use burn::module::Module;
use burn::tensor::Tensor;
use nn::layout::{channels_last, volume_channels_first, volume_channels_last};
use nn::{Bias, Init, Linear, PatchConv2d, PatchDeconv2d, RotaryAngles, RotaryStack};

use crate::BevVaeConfig;

/// Rotation angles of BEV tokens; head h carries the code of height slice h.
pub fn rotary_angles(config: &BevVaeConfig) -> RotaryAngles {
    let [rows, columns] = config.state_tokens();
    RotaryAngles::grid_2d_with_heads(config.grid.cells[0], rows, columns, config.state.channels_per_height)
}

/// Voxels to BEV tokens.
#[derive(Module, Debug)]
pub struct StateEncoder {
    /// Voxel channels to few.
    pub squeeze: Linear,
    /// One patch filter shared by all height slices.
    pub patch: PatchConv2d,
    /// Mixes BEV tokens and, through its linears, heights.
    pub stack: RotaryStack,
}

impl StateEncoder {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let s = &config.state;
        Self {
            squeeze: Linear::new(config.scene.channels, s.squeeze_channels, Bias::With, init),
            patch: PatchConv2d::new(s.squeeze_channels, s.channels_per_height, s.patch, init),
            stack: RotaryStack::new(config.state_channels(), config.grid.cells[0], s.blocks, init),
        }
    }

    /// # Shapes
    /// - scene: `[B, C, Z, Y, X]`
    /// - output: `[B, N, D]`, tokens row-major (y outer), channels (z, c)
    pub fn forward(&self, scene: Tensor<5>, config: &BevVaeConfig) -> Tensor<3> {
        self.stack.forward(self.tokens(scene), &rotary_angles(config))
    }

    /// The tokens before the transformer.
    pub fn tokens(&self, scene: Tensor<5>) -> Tensor<3> {
        let [b, _, z, y, x] = scene.dims();
        let squeezed = ops::gelu(self.squeeze.forward(volume_channels_last(scene)));
        let [.., m] = squeezed.dims();
        let slices = squeezed.reshape([b * z, y, x, m]).permute([0, 3, 1, 2]);
        let patches = self.patch.forward(slices);
        let [_, h, w, c] = patches.dims();
        patches.reshape([b, z, h * w, c]).swap_dims(1, 2).reshape([b, h * w, z * c])
    }
}

/// BEV tokens to voxels.
#[derive(Module, Debug)]
pub struct StateDecoder {
    /// Mixes BEV tokens.
    pub stack: RotaryStack,
    /// One patch filter shared by all height slices.
    pub unpatch: PatchDeconv2d,
    /// Few channels to voxel channels.
    pub expand: Linear,
}

impl StateDecoder {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let s = &config.state;
        Self {
            stack: RotaryStack::new(config.state_channels(), config.grid.cells[0], s.blocks, init),
            unpatch: PatchDeconv2d::new(s.channels_per_height, s.squeeze_channels, s.patch, init),
            expand: Linear::new(s.squeeze_channels, config.scene.channels, Bias::With, init),
        }
    }

    /// # Shapes
    /// - state: `[B, N, D]`
    /// - output: `[B, C, Z, Y, X]`
    pub fn forward(&self, state: Tensor<3>, config: &BevVaeConfig) -> Tensor<5> {
        self.voxels(self.stack.forward(state, &rotary_angles(config)), config)
    }

    /// The voxels of tokens that left the transformer.
    pub fn voxels(&self, tokens: Tensor<3>, config: &BevVaeConfig) -> Tensor<5> {
        let [b, n, _] = tokens.dims();
        let [z, y, x] = config.grid.cells;
        let [h, w] = config.state_tokens();
        let c = config.state.channels_per_height;
        let slices = tokens.reshape([b, n, z, c]).swap_dims(1, 2).reshape([b * z, h, w, c]);
        let squeezed = ops::gelu(self.unpatch.forward(slices));
        let voxels = self.expand.forward(channels_last(squeezed));
        volume_channels_first(voxels.reshape([b, z, y, x, config.scene.channels]))
    }
}

/// A diagonal Gaussian over the latent.
#[derive(Debug, Clone)]
pub struct DiagonalGaussian {
    /// `[B, N, L]`
    pub mean: Tensor<3>,
    /// `[B, N, L]`, clamped to [−30, 20]
    pub log_var: Tensor<3>,
}

impl DiagonalGaussian {
    /// Splits moments `[B, N, 2L]` into mean and clamped log variance.
    pub fn from_moments(moments: Tensor<3>) -> Self {
        let [b, n, double] = moments.dims();
        let l = double / 2;
        Self {
            mean: moments.clone().slice([0..b, 0..n, 0..l]),
            log_var: moments.slice([0..b, 0..n, l..double]).clamp(-30.0, 20.0),
        }
    }

    /// mean + exp(log_var / 2) · noise.
    pub fn sample(&self, noise: Tensor<3>) -> Tensor<3> {
        self.mean.clone() + (self.log_var.clone() * 0.5).exp() * noise
    }

    /// KL divergence from N(0, I): summed over the latent, per sample, `[B]`. Equation of section 5, item 1.
    pub fn kl(&self) -> Tensor<1> {
        let [b, n, l] = self.mean.dims();
        let terms = self.mean.clone().square() + self.log_var.clone().exp() - 1.0 - self.log_var.clone();
        ops::sum_dim(terms.reshape([b, n * l]), 1).reshape([b]) * 0.5
    }
}

/// `[B, N, L]` to the latent picture `[B, L, h, w]` (axis 2 = y, axis 3 = x).
pub fn latent_picture(latent: Tensor<3>, config: &BevVaeConfig) -> Tensor<4> {
    let [b, _, l] = latent.dims();
    let [h, w] = config.state_tokens();
    latent.swap_dims(1, 2).reshape([b, l, h, w])
}

/// `[B, L, h, w]` to `[B, N, L]`.
pub fn latent_tokens(latent: Tensor<4>) -> Tensor<3> {
    let [b, l, h, w] = latent.dims();
    latent.reshape([b, l, h * w]).swap_dims(1, 2)
}
