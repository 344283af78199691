//! Convolution and the two ways to change size. Shapes: N items, C channels, H W pixels.

use burn::module::{Module, Param};
use burn::tensor::Tensor;
use burn::tensor::module::interpolate;
use burn::tensor::ops::{InterpolateMode, InterpolateOptions, PadMode};
use nn::Init;
use nn::lora::Adapters;

/// Square convolution with a bias.
#[derive(Module, Debug)]
pub struct Conv2d {
    /// `[out, in, k, k]`
    pub weight: Param<Tensor<4>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
    /// None unless [`nn::lora::attach`] puts them there.
    pub lora: Adapters,
    stride: usize,
    padding: usize,
}

impl Conv2d {
    /// Size-keeping convolution of odd kernel; U(±1/√fan_in).
    pub fn new(c_in: usize, c_out: usize, kernel: usize, init: &mut Init) -> Self {
        Self::with_stride(c_in, c_out, kernel, 1, kernel / 2, init)
    }

    /// Any stride and (symmetric) padding; U(±1/√fan_in).
    pub fn with_stride(
        c_in: usize,
        c_out: usize,
        kernel: usize,
        stride: usize,
        padding: usize,
        init: &mut Init,
    ) -> Self {
        let bound = 1.0 / ((c_in * kernel * kernel) as f64).sqrt();
        let weight = init.uniform([c_out, c_in, kernel, kernel], bound);
        Self { weight, bias: init.uniform([c_out], bound), lora: Adapters::none(), stride, padding }
    }

    /// Size-keeping convolution that starts as 0: a branch that changes nothing before it is trained.
    pub fn zeros(c_in: usize, c_out: usize, kernel: usize, init: &mut Init) -> Self {
        let weight = init.constant([c_out, c_in, kernel, kernel], 0.0);
        Self { weight, bias: init.constant([c_out], 0.0), lora: Adapters::none(), stride: 1, padding: kernel / 2 }
    }

    /// # Shapes
    /// - x: `[N, in, H, W]`
    /// - output: `[N, out, H', W']`
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let (stride, padding) = ([self.stride; 2], [self.padding; 2]);
        let [_, _, height, width] = self.weight.dims();
        let kernel = self.lora.kernel(&self.weight);
        let base = |x| ops::conv2d(x, kernel, Some(self.bias.val()), stride, padding);
        self.lora.add_to_conv2d(x, ([height, width], stride, padding), base)
    }
}

/// Where a halving convolution pads.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum DownPadding {
    /// One pixel on every side: the UNet.
    AllSides,
    /// One pixel right and below: the autoencoder. Symmetric padding would shift its latent by half a pixel.
    RightBottom,
}

/// Halves the size by a 3×3 convolution of stride 2, rounding up on all-sides padding and down otherwise.
#[derive(Module, Debug)]
pub struct Downsample {
    /// Channels to the same number of channels.
    pub conv: Conv2d,
    #[module(skip)]
    padding: DownPadding,
}

impl Downsample {
    pub(crate) fn new(channels: usize, padding: DownPadding, init: &mut Init) -> Self {
        let inside = usize::from(padding == DownPadding::AllSides);
        Self { conv: Conv2d::with_stride(channels, channels, 3, 2, inside, init), padding }
    }

    /// # Shapes
    /// - x: `[N, C, H, W]`
    /// - output: `[N, C, ⌈H/2⌉, ⌈W/2⌉]` in the UNet, `[N, C, ⌊H/2⌋, ⌊W/2⌋]` in the autoencoder
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        self.conv.forward(match self.padding {
            DownPadding::AllSides => x,
            DownPadding::RightBottom => x.pad([(0, 1), (0, 1)], PadMode::Constant(0.0)),
        })
    }
}

/// Nearest-neighbour resize, then a 3×3 convolution.
#[derive(Module, Debug)]
pub struct Upsample {
    /// Channels to the same number of channels.
    pub conv: Conv2d,
}

impl Upsample {
    pub(crate) fn new(channels: usize, init: &mut Init) -> Self {
        Self { conv: Conv2d::new(channels, channels, 3, init) }
    }

    /// # Shapes
    /// - x: `[N, C, H, W]`
    /// - output: `[N, C, size]`; pixel i of the new size shows pixel ⌊i·H/H'⌋
    pub fn forward(&self, x: Tensor<4>, size: [usize; 2]) -> Tensor<4> {
        let options = InterpolateOptions::new(InterpolateMode::Nearest).with_output_size(size);
        self.conv.forward(interpolate(x, options))
    }
}
