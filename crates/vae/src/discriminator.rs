//! StyleGAN2-type discriminator on single pictures (section 5.2): residual blocks with blurred downsampling and equalised
//! learning rates. No statistics across the batch: the views of one scene are not independent, and padded views would enter.
//!
//! Shapes: N pictures, C channels, H W pixels.

use burn::module::{Module, Param};
use burn::tensor::activation::leaky_relu;
use burn::tensor::{Tensor, TensorData};
use nn::Init;

use crate::config::ConfigError;

/// Side of the smallest feature map.
const END: usize = 4;

/// Convolution whose stored weight is N(0, 1) and is scaled by 1/√fan_in when used.
#[derive(Module, Debug)]
pub struct EqualConv {
    /// `[out, in, k, k]`
    pub weight: Param<Tensor<4>>,
    /// `[out]`
    pub bias: Option<Param<Tensor<1>>>,
    stride: usize,
    padding: usize,
}

impl EqualConv {
    fn new(c_in: usize, c_out: usize, k: usize, stride: usize, padding: usize, init: &mut Init) -> Self {
        let bias = Some(init.constant([c_out], 0.0));
        Self { weight: init.normal([c_out, c_in, k, k], 1.0), bias, stride, padding }
    }

    fn without_bias(self) -> Self {
        Self { bias: None, ..self }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let weight = self.weight.val();
        let [_, c_in, k, _] = weight.dims();
        let scale = 1.0 / ((c_in * k * k) as f64).sqrt();
        ops::conv2d(x, weight * scale, self.bias.as_ref().map(Param::val), [self.stride; 2], [self.padding; 2])
    }
}

/// Linear layer with the same equalised learning rate.
#[derive(Module, Debug)]
pub struct EqualLinear {
    /// `[out, in]`
    pub weight: Param<Tensor<2>>,
    /// `[out]`
    pub bias: Param<Tensor<1>>,
}

impl EqualLinear {
    fn new(d_in: usize, d_out: usize, init: &mut Init) -> Self {
        Self { weight: init.normal([d_out, d_in], 1.0), bias: init.constant([d_out], 0.0) }
    }

    fn forward(&self, x: Tensor<2>) -> Tensor<2> {
        let weight = self.weight.val();
        let scale = 1.0 / (weight.dims()[1] as f64).sqrt();
        ops::linear(x, weight * scale, Some(self.bias.val()))
    }
}

/// Leaky ReLU of slope 0.2 times √2, which keeps the variance.
fn activate<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    leaky_relu(x, 0.2) * std::f64::consts::SQRT_2
}

/// The [1, 3, 3, 1] ⊗ [1, 3, 3, 1] / 64 filter on every channel.
fn blur(x: Tensor<4>, padding: usize, stride: usize) -> Tensor<4> {
    let [b, c, h, w] = x.dims();
    let line = [1.0_f32, 3.0, 3.0, 1.0];
    let kernel: Vec<f32> = line.iter().flat_map(|a| line.map(|b| a * b / 64.0)).collect();
    let kernel = Tensor::<4>::from_data(TensorData::new(kernel, [1, 1, 4, 4]), &x.device());
    let y = ops::conv2d(x.reshape([b * c, 1, h, w]), kernel, None, [stride; 2], [padding; 2]);
    let [_, _, h, w] = y.dims();
    y.reshape([b, c, h, w])
}

/// One halving of resolution.
#[derive(Module, Debug)]
pub struct DiscriminatorBlock {
    /// 3×3 at full resolution.
    pub conv_1: EqualConv,
    /// 3×3 with stride 2 after the blur.
    pub conv_2: EqualConv,
    /// 1×1 on the blurred, halved input.
    pub skip: EqualConv,
}

impl DiscriminatorBlock {
    fn new(c_in: usize, c_out: usize, init: &mut Init) -> Self {
        Self {
            conv_1: EqualConv::new(c_in, c_in, 3, 1, 1, init),
            conv_2: EqualConv::new(c_in, c_out, 3, 2, 0, init),
            skip: EqualConv::new(c_in, c_out, 1, 1, 0, init).without_bias(),
        }
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let branch = activate(self.conv_1.forward(x.clone()));
        let branch = activate(self.conv_2.forward(blur(branch, 2, 1)));
        let skip = self.skip.forward(blur(x, 1, 2));
        (branch + skip) / std::f64::consts::SQRT_2
    }
}

/// Scores single pictures: high for real ones.
#[derive(Module, Debug)]
pub struct Discriminator {
    /// 1×1 from RGB.
    pub from_rgb: EqualConv,
    /// Down to 4 pixels on the short side.
    pub blocks: Vec<DiscriminatorBlock>,
    /// 3×3 at the end size.
    pub conv: EqualConv,
    /// To a vector.
    pub dense: EqualLinear,
    /// To the score.
    pub score: EqualLinear,
}

impl Discriminator {
    /// `base` channels at full resolution, doubled at each halving up to 8·base.
    ///
    /// # Errors
    /// A picture size that does not halve evenly down to 4 pixels on its short side.
    pub fn new(height: usize, width: usize, base: usize, init: &mut Init) -> Result<Self, ConfigError> {
        let halvings = (height.min(width) / END).checked_ilog2().unwrap_or(0);
        let scale = 1 << halvings;
        let even = height.is_multiple_of(scale) && width.is_multiple_of(scale) && height.min(width) == END * scale;
        if base == 0 || !even {
            return Err(ConfigError(format!(
                "the discriminator halves pictures down to {END} pixels, so the short side must be {END} times a power of two \
                 and the long side divisible by it; {width}x{height} with {base} base channels is not"
            )));
        }
        let channels = |level: u32| (base << level).min(8 * base);
        let end = channels(halvings);
        let from_rgb = EqualConv::new(3, channels(0), 1, 1, 0, init);
        let blocks =
            (0..halvings).map(|level| DiscriminatorBlock::new(channels(level), channels(level + 1), init)).collect();
        Ok(Self {
            from_rgb,
            blocks,
            conv: EqualConv::new(end, end, 3, 1, 1, init),
            dense: EqualLinear::new(end * (height / scale) * (width / scale), end, init),
            score: EqualLinear::new(end, 1, init),
        })
    }

    /// # Shapes
    /// - images: `[N, 3, H, W]`, ImageNet-normalised
    /// - output: `[N]`
    pub fn forward(&self, images: Tensor<4>) -> Tensor<1> {
        let x = activate(self.from_rgb.forward(images));
        let x = self.blocks.iter().fold(x, |x, block| block.forward(x));
        let x = activate(self.conv.forward(x));
        let [n, c, h, w] = x.dims();
        let x = activate(self.dense.forward(x.reshape([n, c * h * w])));
        self.score.forward(x).reshape([n])
    }
}
