//! The convolutions of VGG-16 as a fixed measuring instrument: features after ReLU at the end of each block, and the
//! perceptual loss between two sets of images.
//!
//! Network: Simonyan & Zisserman, "Very Deep Convolutional Networks for Large-Scale Image Recognition", table 1,
//! column D; the fully connected layers are not used. Parity: `tests/it/vgg16.rs`. Shapes: N images, H and W pixels.

use std::collections::BTreeMap;
use std::path::Path;

use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor, TensorData};
use nn::weights::{Mismatch, WeightError, WeightFile};
use serde::{Deserialize, Serialize};

/// Output channels of the convolutions of each block; every block ends in a tap and a 2×2 max pool.
const BLOCKS: [&[usize]; 5] = [&[64, 64], &[128, 128], &[256; 3], &[512; 3], &[512; 3]];

/// Input channels (RGB).
const COLOURS: usize = 3;

/// Parameters that come with complete torchvision files and are no part of the convolutions.
const CLASSIFIER_PREFIX: &str = "classifier.";

/// Where features are read: after the last ReLU of a block.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Tap {
    /// 64 channels at full size.
    #[serde(rename = "relu1_2")]
    Relu1_2,
    /// 128 channels at half size.
    #[serde(rename = "relu2_2")]
    Relu2_2,
    /// 256 channels at a quarter.
    #[serde(rename = "relu3_3")]
    Relu3_3,
    /// 512 channels at an eighth.
    #[serde(rename = "relu4_3")]
    Relu4_3,
    /// 512 channels at a sixteenth.
    #[serde(rename = "relu5_3")]
    Relu5_3,
}

impl Tap {
    /// All taps from the shallowest to the deepest.
    pub const ALL: [Self; 5] = [Self::Relu1_2, Self::Relu2_2, Self::Relu3_3, Self::Relu4_3, Self::Relu5_3];
}

/// What the kernels expect of an image. It belongs to the weights, so it comes from the layout of their file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Preprocessing {
    /// RGB in [0, 1], minus the ImageNet mean, divided by its deviation (torchvision's training).
    Torchvision,
    /// BGR in [0, 255] minus the ImageNet mean, undivided (the Oxford release, trained with Caffe).
    Caffe,
}

impl Preprocessing {
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: the same, as the kernels expect it
    #[must_use]
    pub fn apply(self, images: Tensor<4>) -> Tensor<4> {
        let device = images.device();
        let per_channel =
            |values: [f32; COLOURS]| Tensor::<1>::from_floats(values, &device).reshape([1, COLOURS, 1, 1]);
        match self {
            Self::Torchvision => (images - per_channel([0.485, 0.456, 0.406])) / per_channel([0.229, 0.224, 0.225]),
            Self::Caffe => images.flip([1]) * 255.0 - per_channel([103.939, 116.779, 123.68]),
        }
    }
}

/// One 3×3 convolution with padding 1.
#[derive(Debug, Clone)]
struct Conv {
    weight: Tensor<4>,
    bias: Tensor<1>,
}

/// Frozen VGG-16 convolutions. Its weights are constants: no gradient is kept or computed for them.
#[derive(Debug, Clone)]
pub struct Vgg16 {
    /// Without a tape; lifted onto one only when the images are on one.
    blocks: Vec<Vec<Conv>>,
    preprocessing: Preprocessing,
}

impl Vgg16 {
    /// Loads a safetensors or torch file in one of two layouts, told apart by the names: torchvision's
    /// (`features.{0,2,5,…}.{weight,bias}`, [`Preprocessing::Torchvision`]; a classifier beside them is not read) or
    /// the Oxford release's (`block{b}_conv{c}.{weight,bias}`, [`Preprocessing::Caffe`]).
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, [`WeightError::Layout`] when the first kernel has neither name, and
    /// [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?;
        let preprocessing = detect_layout(&file)?;
        let mismatch = compare_names(&file, preprocessing);
        if !mismatch.is_empty() {
            return Err(WeightError::Mismatch(Box::new(mismatch)));
        }
        Self::from_values(preprocessing, device, |name, _| Ok(file.tensor(name)?.data))
    }

    /// Builds the network from `values(name, shape)`, named as in the files of this preprocessing. Kernels are
    /// `[out, in, 3, 3]`.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        preprocessing: Preprocessing,
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        let device = device.clone().without_autodiff();
        let mut checked = |name: String, shape: &[usize]| {
            let data = values(&name, shape)?;
            if data.len() != shape.iter().product::<usize>() {
                return Err(WeightError::Count { name, shape: shape.to_vec(), found: data.len() });
            }
            Ok(TensorData::new(data, shape.to_vec()))
        };
        let mut blocks = Vec::with_capacity(BLOCKS.len());
        for block in conv_shapes(preprocessing) {
            let mut convs = Vec::with_capacity(block.len());
            for (name, [channels_out, channels_in]) in block {
                let weight = checked(format!("{name}.weight"), &[channels_out, channels_in, 3, 3])?;
                let bias = checked(format!("{name}.bias"), &[channels_out])?;
                convs.push(Conv { weight: Tensor::from_data(weight, &device), bias: Tensor::from_data(bias, &device) });
            }
            blocks.push(convs);
        }
        Ok(Self { blocks, preprocessing })
    }

    /// What [`Vgg16::forward`] does to images first.
    #[must_use]
    pub fn preprocessing(&self) -> Preprocessing {
        self.preprocessing
    }

    /// Features at every tap up to `last`; deeper blocks are not computed.
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]; H and W at least `2^k` for `k` pools before the last tap
    /// - output k: `[N, C_k, ⌊H / 2^k⌋, ⌊W / 2^k⌋]`, C = 64, 128, 256, 512, 512
    #[must_use]
    pub fn forward(&self, images: Tensor<4>, last: Tap) -> Vec<Tensor<4>> {
        self.forward_preprocessed(self.preprocessing.apply(images), last)
    }

    /// As [`Vgg16::forward`] for input that is already what the kernels expect.
    #[must_use]
    pub fn forward_preprocessed(&self, input: Tensor<4>, last: Tap) -> Vec<Tensor<4>> {
        assert_eq!(input.dims()[1], COLOURS, "VGG-16 looks at images [N, 3, H, W], got {:?}", input.dims());
        let depth = last as usize + 1;
        let mut taps: Vec<Tensor<4>> = Vec::with_capacity(depth);
        for block in &self.blocks[..depth] {
            let start = taps.last().map_or_else(|| input.clone(), |tap| max_pool2d(tap.clone(), halve()));
            taps.push(block.iter().fold(start, |x, conv| conv.forward(x)));
        }
        taps
    }

    /// Sum over the taps up to `last` of the mean squared difference of features, differentiable with respect to
    /// `prediction`; `target` is a constant.
    ///
    /// # Shapes
    /// - target, prediction: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: `[1]`
    #[must_use]
    pub fn perceptual_loss(&self, target: Tensor<4>, prediction: Tensor<4>, last: Tap) -> Tensor<1> {
        assert_eq!(target.dims(), prediction.dims(), "target and prediction");
        let on_tape = prediction.is_autodiff();
        let wanted = self.forward(target.without_autodiff(), last);
        let found = self.forward(prediction, last);
        let per_tap = wanted.into_iter().zip(found).map(|(wanted, found)| {
            let wanted = if on_tape { Tensor::from_inner(wanted) } else { wanted };
            (found - wanted).square().mean()
        });
        per_tap.reduce(|sum, tap| sum + tap).expect("there is at least the first tap")
    }
}

impl Conv {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let (mut weight, mut bias) = (self.weight.clone(), self.bias.clone());
        if x.is_autodiff() {
            (weight, bias) = (Tensor::from_inner(weight), Tensor::from_inner(bias));
        }
        relu(ops::conv2d(x, weight, Some(bias), [1; 2], [1; 2]))
    }
}

fn halve() -> MaxPoolOptions<2> {
    MaxPoolOptions::new([2, 2])
}

/// Name and `[out, in]` channels of every convolution, by block.
fn conv_shapes(preprocessing: Preprocessing) -> Vec<Vec<(String, [usize; 2])>> {
    let mut channels_in = COLOURS;
    // torchvision numbers convolutions, ReLUs and pools in one sequence.
    let mut layer = 0;
    let mut blocks = Vec::with_capacity(BLOCKS.len());
    for (b, block) in BLOCKS.iter().enumerate() {
        let mut convs = Vec::with_capacity(block.len());
        for (c, &channels_out) in block.iter().enumerate() {
            let name = match preprocessing {
                Preprocessing::Torchvision => format!("features.{layer}"),
                Preprocessing::Caffe => format!("block{}_conv{}", b + 1, c + 1),
            };
            convs.push((name, [channels_out, channels_in]));
            channels_in = channels_out;
            layer += 2;
        }
        layer += 1;
        blocks.push(convs);
    }
    blocks
}

fn detect_layout(file: &WeightFile) -> Result<Preprocessing, WeightError> {
    let layouts = [Preprocessing::Torchvision, Preprocessing::Caffe];
    let first_kernel = |layout| format!("{}.weight", conv_shapes(layout)[0][0].0);
    layouts.into_iter().find(|&layout| file.shape(&first_kernel(layout)).is_some()).ok_or_else(|| {
        let looked_for = layouts.map(first_kernel).join(" nor ");
        WeightError::Layout { reason: format!("neither {looked_for} is there"), path: file.path().to_path_buf() }
    })
}

fn compare_names(file: &WeightFile, layout: Preprocessing) -> Mismatch {
    let mut wanted = BTreeMap::new();
    for (name, [channels_out, channels_in]) in conv_shapes(layout).into_iter().flatten() {
        wanted.insert(format!("{name}.weight"), vec![channels_out, channels_in, 3, 3]);
        wanted.insert(format!("{name}.bias"), vec![channels_out]);
    }
    let found = file
        .names()
        .filter(|name| layout != Preprocessing::Torchvision || !name.starts_with(CLASSIFIER_PREFIX))
        .filter_map(|name| Some((name.to_owned(), file.shape(name)?.to_vec())));
    Mismatch { path: Some(file.path().to_path_buf()), ..Mismatch::between(&wanted, &found.collect()) }
}
