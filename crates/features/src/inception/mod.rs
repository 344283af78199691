//! Inception-v3 as the Fréchet inception distance uses it: the graph TensorFlow published on 2015-12-05.
//!
//! Network: Szegedy et al., "Rethinking the Inception Architecture for Computer Vision". It differs from torchvision's in the
//! average pools, which do not count padding, in the last block, which pools the maximum, and in 1008 classes.
//! Parity: `tests/it/inception.rs`. Shapes: N images.

mod blocks;
mod keras;

use std::path::Path;

use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};
use ops::{PixelCentres, resize_bilinear};

use crate::frozen::{NORM_COUNTER, Values, beside, load_strict};
use blocks::{Block, LastPool, Unit};

/// Side of the network's input.
pub const INCEPTION_SIZE: usize = 299;

/// Channels of the pooled feature.
const WIDTH: usize = 2048;
const CLASSES: usize = 1008;

/// Whose weights: they decide how images are prepared and how the last block pools.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InceptionWeights {
    /// The 2015 graph, names as in pytorch-fid and torch-fidelity (`Conv2d_1a_3x3.conv.weight`). Only with these may a number
    /// be called FID or KID.
    Fid2015,
    /// The 8-bit Keras network of nsfwjs (`conv2d_1/kernel`), a stand-in.
    Nsfwjs,
}

/// Frozen Inception-v3.
#[derive(Debug, Clone)]
pub struct Inception {
    /// Up to the first and second max pool.
    stem: [Vec<Unit>; 2],
    /// 5b, 5c, 5d, 6a, 6b, 6c, 6d, 6e, 7a, 7b, 7c.
    blocks: Vec<Block>,
    classes: Option<(Tensor<2>, Tensor<1>)>,
    weights: InceptionWeights,
}

/// Feature maps of one pass.
#[derive(Debug, Clone)]
pub struct InceptionMaps {
    /// `[N, 64, 73, 73]`, after the first max pool.
    pub pool1: Tensor<4>,
    /// `[N, 192, 35, 35]`, after the second max pool.
    pub pool2: Tensor<4>,
    /// `[N, 768, 17, 17]`
    pub mixed_6e: Tensor<4>,
    /// `[N, 2048, 8, 8]`; its mean over positions is the feature of the Fréchet distance.
    pub mixed_7c: Tensor<4>,
}

impl Inception {
    /// Loads `pt_inception-2015-12-05-6726825d.pth` (or the same names as safetensors), or the nsfwjs stand-in.
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, [`WeightError::Layout`] for other names, and [`WeightError::Mismatch`] with every
    /// missing, unexpected and wrongly shaped name. The auxiliary head of training (`AuxLogits`) is left out.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?;
        if file.shape("Conv2d_1a_3x3.conv.weight").is_some() {
            let unused = |name: &str| name.ends_with(NORM_COUNTER) || name.starts_with("AuxLogits.");
            return load_strict(&file, device, unused, |values| Self::read(InceptionWeights::Fid2015, values));
        }
        if file.shape("conv2d_1/kernel").is_some() {
            let quantised = keras::Quantised::new(&file)?;
            let mut read = |name: &str, shape: &[usize]| quantised.values(name, shape);
            return Self::read(InceptionWeights::Nsfwjs, &mut Values::new(device, &mut read));
        }
        let reason = "neither Conv2d_1a_3x3.conv.weight nor conv2d_1/kernel is there".to_owned();
        Err(WeightError::Layout { reason, path: file.path().to_path_buf() })
    }

    /// Builds the 2015 network from `values(name, shape)`.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        Self::read(InceptionWeights::Fid2015, &mut Values::new(device, &mut values))
    }

    fn read(weights: InceptionWeights, values: &mut Values<'_>) -> Result<Self, WeightError> {
        let mut unit = |name: &str, shape: [usize; 4], stride: usize, padding: usize| {
            Unit::read(values, name, shape, stride, [padding; 2])
        };
        let stem = [
            vec![
                unit("Conv2d_1a_3x3", [32, 3, 3, 3], 2, 0)?,
                unit("Conv2d_2a_3x3", [32, 32, 3, 3], 1, 0)?,
                unit("Conv2d_2b_3x3", [64, 32, 3, 3], 1, 1)?,
            ],
            vec![unit("Conv2d_3b_1x1", [80, 64, 1, 1], 1, 0)?, unit("Conv2d_4a_3x3", [192, 80, 3, 3], 1, 0)?],
        ];
        let last = match weights {
            InceptionWeights::Fid2015 => LastPool::Maximum,
            InceptionWeights::Nsfwjs => LastPool::Average,
        };
        let blocks = blocks::read_all(values, last)?;
        let classes = match weights {
            InceptionWeights::Fid2015 => {
                Some((values.tensor("fc.weight", [CLASSES, WIDTH])?, values.tensor("fc.bias", [CLASSES])?))
            }
            InceptionWeights::Nsfwjs => None,
        };
        Ok(Self { stem, blocks, classes, weights })
    }

    /// Whose weights these are.
    #[must_use]
    pub fn weights(&self) -> InceptionWeights {
        self.weights
    }

    /// The network's input from images, as pytorch-fid makes it: bilinear to 299×299 with half-pixel centres and without
    /// antialiasing, then `2x − 1` (the stand-in looks at [0, 1]).
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: `[N, 3, 299, 299]`
    #[must_use]
    pub fn prepare(&self, images: Tensor<4>) -> Tensor<4> {
        let resized = resize_bilinear(images, [INCEPTION_SIZE; 2], PixelCentres::Half);
        match self.weights {
            InceptionWeights::Fid2015 => resized * 2.0 - 1.0,
            InceptionWeights::Nsfwjs => resized,
        }
    }

    /// The feature of the Fréchet distance.
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: `[N, 2048]`
    #[must_use]
    pub fn features(&self, images: Tensor<4>) -> Tensor<2> {
        spatial_mean(self.maps(self.prepare(images)).mixed_7c)
    }

    /// # Shapes
    /// - input: `[N, 3, 299, 299]` as [`Inception::prepare`] makes it, or by another rule
    #[must_use]
    pub fn maps(&self, input: Tensor<4>) -> InceptionMaps {
        let [first, second] = &self.stem;
        let pool1 = reduce(through(first, input));
        let pool2 = reduce(through(second, pool1.clone()));
        let (upper, lower) = self.blocks.split_at(self.blocks.len() - 3);
        let mixed_6e = upper.iter().fold(pool2.clone(), |x, block| block.forward(x));
        let mixed_7c = lower.iter().fold(mixed_6e.clone(), |x, block| block.forward(x));
        InceptionMaps { pool1, pool2, mixed_6e, mixed_7c }
    }

    /// Class scores without and with the bias; none for the stand-in, whose classes are of another task.
    ///
    /// # Shapes
    /// - features: `[N, 2048]`
    /// - output: `[N, 1008]` twice
    #[must_use]
    pub fn logits(&self, features: Tensor<2>) -> Option<(Tensor<2>, Tensor<2>)> {
        let (weight, bias) = self.classes.as_ref()?;
        let (weight, bias) = (beside(weight, &features), beside(bias, &features));
        let unbiased = features.matmul(weight.transpose());
        Some((unbiased.clone(), unbiased + bias.unsqueeze::<2>()))
    }
}

/// # Shapes
/// - map: `[N, C, H, W]`
/// - output: `[N, C]`
pub(crate) fn spatial_mean(map: Tensor<4>) -> Tensor<2> {
    let [images, channels, height, width] = map.dims();
    ops::mean_dim(map.reshape([images, channels, height * width]), 2).reshape([images, channels])
}

fn through(units: &[Unit], x: Tensor<4>) -> Tensor<4> {
    units.iter().fold(x, |x, unit| unit.forward(x))
}

/// The 3×3 max pool with stride 2 between the parts of the network.
fn reduce(x: Tensor<4>) -> Tensor<4> {
    max_pool2d(x, MaxPoolOptions::new([3, 3]).with_stride([2, 2]))
}
