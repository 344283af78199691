//! Affine layers: linear, patch convolutions (stride equal to kernel) and 3-wide convolutions.
//!
//! Weights keep PyTorch's layout, so that released files load without transposing and saved files open anywhere.

use burn::module::{Module, Param};
use burn::tensor::Tensor;

use crate::Init;
use crate::layout::{blocks_from_volume, image_from_patches, patches_from_image};
use crate::lora::Adapters;

/// `y = x Wᵀ + b` over the last axis.
#[derive(Module, Debug)]
pub struct Linear {
    /// `[out, in]`
    pub weight: Param<Tensor<2>>,
    /// `[out]`
    pub bias: Option<Param<Tensor<1>>>,
    /// None unless [`crate::lora::attach`] puts them there.
    pub lora: Adapters,
}

/// Whether an affine layer adds a learned offset.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bias {
    /// `x W`
    Without,
    /// `x W + b`
    With,
}

impl Bias {
    fn init(self, width: usize, bound: f64, init: &mut Init) -> Option<Param<Tensor<1>>> {
        (self == Self::With).then(|| init.uniform([width], bound))
    }
}

impl Linear {
    /// Weights and bias U(±1/√in).
    pub fn new(d_in: usize, d_out: usize, bias: Bias, init: &mut Init) -> Self {
        let bound = 1.0 / (d_in as f64).sqrt();
        let weight = init.uniform([d_out, d_in], bound);
        Self { weight, bias: bias.init(d_out, bound, init), lora: Adapters::none() }
    }

    /// Weights and bias 0: the last layer of a residual branch that starts as the identity.
    pub fn zeros(d_in: usize, d_out: usize, bias: Bias, init: &mut Init) -> Self {
        let bias = (bias == Bias::With).then(|| init.constant([d_out], 0.0));
        Self { weight: init.constant([d_out, d_in], 0.0), bias, lora: Adapters::none() }
    }

    /// Passes its input through unchanged at the start; no bias.
    pub fn identity(width: usize, init: &mut Init) -> Self {
        Self { weight: init.diagonal(width), bias: None, lora: Adapters::none() }
    }

    /// # Shapes
    /// - x: `[.., in]`
    /// - output: `[.., out]`
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let matrix = self.lora.matrix(&self.weight);
        self.lora.add_to_rows(x, |x| ops::linear(x, matrix, self.bias.as_ref().map(Param::val)))
    }
}

/// Convolution whose stride equals its kernel: one matrix product over patches.
#[derive(Module, Debug)]
pub struct PatchConv2d {
    /// `[out, in, k, k]`
    pub weight: Param<Tensor<4>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
    /// None unless [`crate::lora::attach`] puts them there.
    pub lora: Adapters,
}

impl PatchConv2d {
    /// U(±1/√fan_in), fan_in = in·k².
    pub fn new(c_in: usize, c_out: usize, patch: usize, init: &mut Init) -> Self {
        let bound = 1.0 / ((c_in * patch * patch) as f64).sqrt();
        let weight = init.uniform([c_out, c_in, patch, patch], bound);
        Self { weight, bias: init.uniform([c_out], bound), lora: Adapters::none() }
    }

    /// # Shapes
    /// - image: `[B, in, h·k, w·k]`
    /// - output: `[B, h, w, out]`, channels last
    pub fn forward(&self, image: Tensor<4>) -> Tensor<4> {
        let k = self.weight.dims()[3];
        let matrix = self.lora.matrix(&self.weight);
        self.lora.add_to_rows(patches_from_image(image, k), |x| ops::linear(x, matrix, Some(self.bias.val())))
    }
}

/// Transposed convolution whose stride equals its kernel: one matrix product, then patches are laid side by side.
#[derive(Module, Debug)]
pub struct PatchDeconv2d {
    /// `[in, out, k, k]`
    pub weight: Param<Tensor<4>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
}

impl PatchDeconv2d {
    /// U(±1/√fan_in) with the framework's fan_in of transposed convolutions, out·k².
    pub fn new(c_in: usize, c_out: usize, patch: usize, init: &mut Init) -> Self {
        let bound = 1.0 / ((c_out * patch * patch) as f64).sqrt();
        Self { weight: init.uniform([c_in, c_out, patch, patch], bound), bias: init.uniform([c_out], bound) }
    }

    /// Weights and bias 0: a picture that starts as one colour.
    pub fn zeros(c_in: usize, c_out: usize, patch: usize, init: &mut Init) -> Self {
        Self { weight: init.constant([c_in, c_out, patch, patch], 0.0), bias: init.constant([c_out], 0.0) }
    }

    /// # Shapes
    /// - x: `[B, h, w, in]`, channels last
    /// - output: `[B, out, h·k, w·k]`, channels first
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        let [c_in, c_out, k, _] = weight.dims();
        let patches = ops::linear(x, weight.reshape([c_in, c_out * k * k]).transpose(), None);
        image_from_patches(patches, k) + self.bias.val().reshape([1, c_out, 1, 1])
    }
}

/// 3-D convolution whose stride equals its kernel.
#[derive(Module, Debug)]
pub struct PatchConv3d {
    /// `[out, in, k, k, k]`
    pub weight: Param<Tensor<5>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
}

impl PatchConv3d {
    /// U(±1/√fan_in), fan_in = in·k³.
    pub fn new(c_in: usize, c_out: usize, k: usize, init: &mut Init) -> Self {
        let bound = 1.0 / ((c_in * k * k * k) as f64).sqrt();
        Self { weight: init.uniform([c_out, c_in, k, k, k], bound), bias: init.uniform([c_out], bound) }
    }

    /// # Shapes
    /// - volume: `[B, in, z·k, y·k, x·k]`
    /// - output: `[B, z, y, x, out]`, channels last
    pub fn forward(&self, volume: Tensor<5>) -> Tensor<5> {
        let weight = self.weight.val();
        let [c_out, c_in, k, _, _] = weight.dims();
        ops::linear(blocks_from_volume(volume, k), weight.reshape([c_out, c_in * k * k * k]), Some(self.bias.val()))
    }
}

/// 3×3 convolution, padding 1, stride 1.
#[derive(Module, Debug)]
pub struct Conv3x3 {
    /// `[out, in, 3, 3]`
    pub weight: Param<Tensor<4>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
    /// None unless [`crate::lora::attach`] puts them there.
    pub lora: Adapters,
}

impl Conv3x3 {
    /// U(±1/√(9·in)).
    pub fn new(c_in: usize, c_out: usize, init: &mut Init) -> Self {
        let bound = 1.0 / ((c_in * 9) as f64).sqrt();
        let weight = init.uniform([c_out, c_in, 3, 3], bound);
        Self { weight, bias: init.uniform([c_out], bound), lora: Adapters::none() }
    }

    /// # Shapes
    /// - image: `[B, in, H, W]`
    /// - output: `[B, out, H, W]`
    pub fn forward(&self, image: Tensor<4>) -> Tensor<4> {
        let kernel = self.lora.kernel(&self.weight);
        let base = |image| ops::conv2d(image, kernel, Some(self.bias.val()), [1; 2], [1; 2]);
        self.lora.add_to_conv2d(image, ([3; 2], [1; 2], [1; 2]), base)
    }
}

/// 3×3×3 convolution, padding 1, stride 1.
#[derive(Module, Debug)]
pub struct Conv3x3x3 {
    /// `[out, in, 3, 3, 3]`
    pub weight: Param<Tensor<5>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
}

impl Conv3x3x3 {
    /// U(±1/√(27·in)).
    pub fn new(c_in: usize, c_out: usize, init: &mut Init) -> Self {
        let bound = 1.0 / ((c_in * 27) as f64).sqrt();
        Self { weight: init.uniform([c_out, c_in, 3, 3, 3], bound), bias: init.uniform([c_out], bound) }
    }

    /// # Shapes
    /// - volume: `[B, in, Z, Y, X]`
    /// - output: `[B, out, Z, Y, X]`
    pub fn forward(&self, volume: Tensor<5>) -> Tensor<5> {
        ops::conv3d(volume, self.weight.val(), Some(self.bias.val()), [1; 3], [1; 3])
    }
}
