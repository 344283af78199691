//! EfficientNet-Lite0: a small ImageNet classifier whose pooled features serve as a stand-in for Inception's.
//!
//! Network: Tan & Le, "EfficientNet", in the Lite variant of the TensorFlow repository (ReLU6, no squeeze-and-excitation, stem
//! and head not scaled). Parity: `tests/it/small_nets.rs`. Shapes: N images.

use std::path::Path;

use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};
use ops::{PixelCentres, resize_bilinear};

use crate::conv::{Conv2d, Padding};
use crate::frozen::{NORM_COUNTER, Values, beside, load_strict};
use crate::inception::spatial_mean;

/// Side of the network's input.
pub const EFFICIENTNET_SIZE: usize = 224;

const EPSILON: f64 = 1e-3;
const STEM: usize = 32;
const WIDTH: usize = 1280;
const CLASSES: usize = 1000;

/// Repeats, kernel, stride of the first repeat, expansion, channels in and out.
const STAGES: [[usize; 6]; 7] = [
    [1, 3, 1, 1, 32, 16],
    [2, 3, 2, 6, 16, 24],
    [2, 5, 2, 6, 24, 40],
    [3, 3, 2, 6, 40, 80],
    [3, 5, 1, 6, 80, 112],
    [4, 5, 2, 6, 112, 192],
    [1, 3, 1, 6, 192, 320],
];

/// An inverted residual block.
#[derive(Debug, Clone)]
struct Block {
    expand: Option<Conv2d>,
    depthwise: Conv2d,
    project: Conv2d,
    is_residual: bool,
}

/// One block's place in the table above.
#[derive(Debug, Clone, Copy)]
struct BlockShape {
    kernel: usize,
    stride: usize,
    expansion: usize,
    channels: usize,
    out: usize,
}

impl Block {
    fn read(values: &mut Values<'_>, name: &str, shape: BlockShape) -> Result<Self, WeightError> {
        let BlockShape { kernel, stride, expansion, channels, out } = shape;
        let wide = channels * expansion;
        let mut conv = |layer: &str, shape: [usize; 4], norm: &str, stride: usize| {
            let folded = values.folded(&format!("{name}.{layer}"), shape, &format!("{name}.{norm}"), EPSILON)?;
            Ok::<_, WeightError>(Conv2d::folded(folded, stride, Padding::Same))
        };
        let expand = (expansion > 1).then(|| conv("_expand_conv", [wide, channels, 1, 1], "_bn0", 1)).transpose()?;
        let depthwise = conv("_depthwise_conv", [wide, 1, kernel, kernel], "_bn1", stride)?.depthwise();
        let project = conv("_project_conv", [out, wide, 1, 1], "_bn2", 1)?;
        Ok(Self { expand, depthwise, project, is_residual: stride == 1 && channels == out })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let wide = self.expand.as_ref().map_or_else(|| x.clone(), |expand| relu6(expand.forward(x.clone())));
        let y = self.project.forward(relu6(self.depthwise.forward(wide)));
        if self.is_residual { y + x } else { y }
    }
}

fn relu6(x: Tensor<4>) -> Tensor<4> {
    x.clamp(0.0, 6.0)
}

/// Frozen EfficientNet-Lite0. Its weights are constants: no gradient is kept or computed for them.
#[derive(Debug, Clone)]
pub struct EfficientNetLite0 {
    stem: Conv2d,
    blocks: Vec<Block>,
    head: Conv2d,
    classes: (Tensor<2>, Tensor<1>),
}

impl EfficientNetLite0 {
    /// Loads the names of the lukemelas PyTorch code (`_conv_stem.weight`, `_blocks.0._depthwise_conv.weight`, …).
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, and [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?;
        load_strict(&file, device, |name| name.ends_with(NORM_COUNTER), Self::read)
    }

    /// Builds the network from `values(name, shape)`.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        Self::read(&mut Values::new(device, &mut values))
    }

    fn read(values: &mut Values<'_>) -> Result<Self, WeightError> {
        let stem = values.folded("_conv_stem", [STEM, 3, 3, 3], "_bn0", EPSILON)?;
        let mut blocks = Vec::new();
        for [repeats, kernel, first_stride, expansion, channels, out] in STAGES {
            for repeat in 0..repeats {
                let (stride, channels) = if repeat == 0 { (first_stride, channels) } else { (1, out) };
                let shape = BlockShape { kernel, stride, expansion, channels, out };
                blocks.push(Block::read(values, &format!("_blocks.{}", blocks.len()), shape)?);
            }
        }
        let head = values.folded("_conv_head", [WIDTH, 320, 1, 1], "_bn1", EPSILON)?;
        Ok(Self {
            stem: Conv2d::folded(stem, 2, Padding::Same),
            blocks,
            head: Conv2d::folded(head, 1, Padding::Same),
            classes: (values.tensor("_fc.weight", [CLASSES, WIDTH])?, values.tensor("_fc.bias", [CLASSES])?),
        })
    }

    /// Resizes bilinearly to 224×224 without antialiasing and gives [`EfficientNetLite0::pooled`].
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: `[N, 1280]`
    #[must_use]
    pub fn features(&self, images: Tensor<4>) -> Tensor<2> {
        self.pooled(resize_bilinear(images, [EFFICIENTNET_SIZE; 2], PixelCentres::Half))
    }

    /// Mean over positions of the last feature map.
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]; trained on 224×224
    /// - output: `[N, 1280]`
    #[must_use]
    pub fn pooled(&self, images: Tensor<4>) -> Tensor<2> {
        let input = (images * 255.0 - 127.0) / 128.0;
        let x = self.blocks.iter().fold(relu6(self.stem.forward(input)), |x, block| block.forward(x));
        spatial_mean(relu6(self.head.forward(x)))
    }

    /// Class scores.
    ///
    /// # Shapes
    /// - pooled: `[N, 1280]`
    /// - output: `[N, 1000]`
    #[must_use]
    pub fn logits(&self, pooled: Tensor<2>) -> Tensor<2> {
        let (weight, bias) = (beside(&self.classes.0, &pooled), beside(&self.classes.1, &pooled));
        pooled.matmul(weight.transpose()) + bias.unsqueeze::<2>()
    }
}
