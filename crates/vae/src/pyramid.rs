//! Feature pyramids: image tokens upsampled to three levels, the voxel grid downsampled to three levels.
//!
//! Every level ends with: 1×1 to C channels, group norm, SiLU, 3-wide convolution.

use burn::module::Module;
use burn::tensor::Tensor;
use nn::layout::{channels_first, channels_last, volume_channels_first, volume_channels_last};
use nn::{Bias, Conv3x3, Conv3x3x3, GroupNorm, Init, Linear, PatchConv3d, PatchDeconv2d};

use crate::BevVaeConfig;

/// Epsilon of the pyramids' group norms.
const EPSILON: f32 = 1e-5;

/// 1×1, group norm, SiLU, 3×3.
#[derive(Module, Debug)]
pub struct ImageHead {
    /// The 1×1 convolution.
    pub pointwise: Linear,
    /// After it.
    pub norm: GroupNorm,
    /// Smooths the level.
    pub conv: Conv3x3,
}

impl ImageHead {
    fn new(c_in: usize, config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            pointwise: Linear::new(c_in, c, Bias::With, init),
            norm: GroupNorm::new(c, config.scene.norm_groups, EPSILON, init),
            conv: Conv3x3::new(c, c, init),
        }
    }

    /// `[B, C_in, h, w]` to `[B, C, h, w]`.
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = channels_first(self.pointwise.forward(channels_last(x)));
        self.conv.forward(self.norm.forward_silu(x))
    }
}

/// One doubling of resolution: transposed convolution, group norm, SiLU.
#[derive(Module, Debug)]
pub struct Upsample {
    /// Kernel and stride 2, halves the channels.
    pub deconv: PatchDeconv2d,
    /// After it.
    pub norm: GroupNorm,
}

impl Upsample {
    fn new(c_in: usize, config: &BevVaeConfig, init: &mut Init) -> Self {
        Self {
            deconv: PatchDeconv2d::new(c_in, c_in / 2, 2, init),
            norm: GroupNorm::new(c_in / 2, config.scene.norm_groups, EPSILON, init),
        }
    }

    /// `[B, C, h, w]` to `[B, C/2, 2h, 2w]`.
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.norm.forward_silu(self.deconv.forward(channels_last(x)))
    }
}

/// The image pyramid: tokens at 4×, 2× and 1× resolution.
#[derive(Module, Debug)]
pub struct ImagePyramid {
    /// To 4×, first step.
    pub fine_up_1: Upsample,
    /// To 4×, second step.
    pub fine_up_2: Upsample,
    /// Head of the 4× level.
    pub fine: ImageHead,
    /// To 2×.
    pub middle_up: Upsample,
    /// Head of the 2× level.
    pub middle: ImageHead,
    /// Before the head of the 1× level.
    pub coarse_norm: GroupNorm,
    /// Head of the 1× level.
    pub coarse: ImageHead,
}

impl ImagePyramid {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let e = config.image.channels;
        Self {
            fine_up_1: Upsample::new(e, config, init),
            fine_up_2: Upsample::new(e / 2, config, init),
            fine: ImageHead::new(e / 4, config, init),
            middle_up: Upsample::new(e, config, init),
            middle: ImageHead::new(e / 2, config, init),
            coarse_norm: GroupNorm::new(e, config.scene.norm_groups, EPSILON, init),
            coarse: ImageHead::new(e, config, init),
        }
    }

    /// # Shapes
    /// - features: `[B·V, E, h, w]`
    /// - output: `[B·V, C, 4h, 4w]`, `[B·V, C, 2h, 2w]`, `[B·V, C, h, w]`
    pub fn forward(&self, features: Tensor<4>) -> [Tensor<4>; 3] {
        let fine = self.fine_up_2.forward(self.fine_up_1.forward(features.clone()));
        let middle = self.middle_up.forward(features.clone());
        let coarse = self.coarse_norm.forward_silu(features);
        [self.fine.forward(fine), self.middle.forward(middle), self.coarse.forward(coarse)]
    }
}

/// 1×1×1, group norm, SiLU, 3×3×3.
#[derive(Module, Debug)]
pub struct SceneHead {
    /// The 1×1×1 convolution.
    pub pointwise: Linear,
    /// After it.
    pub norm: GroupNorm,
    /// Smooths the level.
    pub conv: Conv3x3x3,
}

impl SceneHead {
    fn new(c_in: usize, config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            pointwise: Linear::new(c_in, c, Bias::With, init),
            norm: GroupNorm::new(c, config.scene.norm_groups, EPSILON, init),
            conv: Conv3x3x3::new(c, c, init),
        }
    }

    /// `[B, C_in, z, y, x]` to `[B, C, z, y, x]`.
    fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        let x = volume_channels_first(self.pointwise.forward(volume_channels_last(x)));
        self.conv.forward(self.norm.forward_silu(x))
    }
}

/// One halving of resolution: convolution of stride 2, group norm, SiLU.
#[derive(Module, Debug)]
pub struct Downsample {
    /// Kernel and stride 2, doubles the channels.
    pub conv: PatchConv3d,
    /// After it.
    pub norm: GroupNorm,
}

impl Downsample {
    fn new(c_in: usize, config: &BevVaeConfig, init: &mut Init) -> Self {
        Self {
            conv: PatchConv3d::new(c_in, 2 * c_in, 2, init),
            norm: GroupNorm::new(2 * c_in, config.scene.norm_groups, EPSILON, init),
        }
    }

    /// `[B, C, z, y, x]` to `[B, 2C, z/2, y/2, x/2]`.
    fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        self.norm.forward_silu(volume_channels_first(self.conv.forward(x)))
    }
}

/// The scene pyramid: the voxel grid at 1/4, 1/2 and full resolution.
#[derive(Module, Debug)]
pub struct ScenePyramid {
    /// To 1/4, first step.
    pub coarse_down_1: Downsample,
    /// To 1/4, second step.
    pub coarse_down_2: Downsample,
    /// Head of the 1/4 level.
    pub coarse: SceneHead,
    /// To 1/2.
    pub middle_down: Downsample,
    /// Head of the 1/2 level.
    pub middle: SceneHead,
    /// Before the head of the full level.
    pub fine_norm: GroupNorm,
    /// Head of the full level.
    pub fine: SceneHead,
}

impl ScenePyramid {
    /// Sizes from the config.
    pub fn new(config: &BevVaeConfig, init: &mut Init) -> Self {
        let c = config.scene.channels;
        Self {
            coarse_down_1: Downsample::new(c, config, init),
            coarse_down_2: Downsample::new(2 * c, config, init),
            coarse: SceneHead::new(4 * c, config, init),
            middle_down: Downsample::new(c, config, init),
            middle: SceneHead::new(2 * c, config, init),
            fine_norm: GroupNorm::new(c, config.scene.norm_groups, EPSILON, init),
            fine: SceneHead::new(c, config, init),
        }
    }

    /// # Shapes
    /// - scene: `[B, C, Z, Y, X]`
    /// - output: `[B, C, Z/4, Y/4, X/4]`, `[B, C, Z/2, Y/2, X/2]`, `[B, C, Z, Y, X]`
    pub fn forward(&self, scene: Tensor<5>) -> [Tensor<5>; 3] {
        let coarse = self.coarse_down_2.forward(self.coarse_down_1.forward(scene.clone()));
        let middle = self.middle_down.forward(scene.clone());
        let fine = self.fine_norm.forward_silu(scene);
        [self.coarse.forward(coarse), self.middle.forward(middle), self.fine.forward(fine)]
    }
}
