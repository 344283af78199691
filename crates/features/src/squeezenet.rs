//! SqueezeNet 1.1 as a fixed measuring instrument.
//!
//! Network: Iandola et al., "SqueezeNet", and its authors' release 1.1. Parity: `tests/it/small_nets.rs`. Shapes: N images.

use std::path::Path;

use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::MaxPoolOptions;
use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};

use crate::Preprocessing;
use crate::conv::{Conv2d, Padding};
use crate::frozen::{Values, load_strict};
use crate::inception::spatial_mean;

/// Fire modules 2 to 9: channels in, squeezed, and out of each of the two expansions.
const FIRES: [[usize; 3]; 8] = [
    [64, 16, 64],
    [128, 16, 64],
    [128, 32, 128],
    [256, 32, 128],
    [256, 48, 192],
    [384, 48, 192],
    [384, 64, 256],
    [512, 64, 256],
];

/// Places of the fire modules in torchvision's sequence `features`.
const PLACES: [usize; 8] = [3, 4, 6, 7, 9, 10, 11, 12];

/// A max pool stands before these fire modules, counted from 0.
const POOL_BEFORE: [usize; 3] = [0, 2, 4];

/// LPIPS looks after the first convolution and after these fire modules (3, 5, 6, 7, 8, 9).
const TAPS_AFTER: [usize; 6] = [1, 3, 4, 5, 6, 7];

const CLASSES: usize = 1000;

#[derive(Debug, Clone)]
struct Fire {
    squeeze: Conv2d,
    expand: [Conv2d; 2],
}

impl Fire {
    fn read(values: &mut Values<'_>, name: &str, [channels, squeezed, out]: [usize; 3]) -> Result<Self, WeightError> {
        let mut conv = |layer: &str, [out, from]: [usize; 2], kernel: usize| {
            let shape = [out, from, kernel, kernel];
            Conv2d::with_bias(values, &format!("{name}.{layer}"), shape, 1, Padding::Zeros([kernel / 2; 2]))
        };
        let squeeze = conv("squeeze1x1", [squeezed, channels], 1)?;
        Ok(Self { squeeze, expand: [conv("expand1x1", [out, squeezed], 1)?, conv("expand3x3", [out, squeezed], 3)?] })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let x = relu(self.squeeze.forward(x));
        Tensor::cat(self.expand.iter().map(|conv| relu(conv.forward(x.clone()))).collect(), 1)
    }
}

/// Frozen SqueezeNet 1.1. Its weights are constants: no gradient is kept or computed for them.
#[derive(Debug, Clone)]
pub struct SqueezeNet {
    first: Conv2d,
    fires: Vec<Fire>,
    classes: Conv2d,
    preprocessing: Preprocessing,
}

impl SqueezeNet {
    /// Loads one of two layouts, told apart by the names: torchvision's (`features.0.weight`,
    /// [`Preprocessing::Torchvision`]) or the one with the authors' names (`conv1.weight`, `fire2.squeeze1x1.weight`,
    /// [`Preprocessing::Caffe`]).
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, [`WeightError::Layout`] for other names, and [`WeightError::Mismatch`] with every
    /// missing, unexpected and wrongly shaped name.
    pub fn load(path: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(path)?;
        let layouts = [("features.0.weight", Preprocessing::Torchvision), ("conv1.weight", Preprocessing::Caffe)];
        let layout = layouts.into_iter().find(|(name, _)| file.shape(name).is_some());
        let Some((_, preprocessing)) = layout else {
            let reason = "neither features.0.weight nor conv1.weight is there".to_owned();
            return Err(WeightError::Layout { reason, path: file.path().to_path_buf() });
        };
        load_strict(&file, device, |_| false, |values| Self::read(preprocessing, values))
    }

    /// Builds the network from `values(name, shape)`, named as in the files of this preprocessing.
    ///
    /// # Errors
    /// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
    pub fn from_values(
        preprocessing: Preprocessing,
        device: &Device,
        mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
    ) -> Result<Self, WeightError> {
        Self::read(preprocessing, &mut Values::new(device, &mut values))
    }

    fn read(preprocessing: Preprocessing, values: &mut Values<'_>) -> Result<Self, WeightError> {
        let torchvision = preprocessing == Preprocessing::Torchvision;
        let (first, classes) = if torchvision { ("features.0", "classifier.1") } else { ("conv1", "conv10") };
        let none = Padding::Zeros([0, 0]);
        let first = Conv2d::with_bias(values, first, [64, 3, 3, 3], 2, none)?;
        let fire_name = |at: usize| {
            if torchvision { format!("features.{}", PLACES[at]) } else { format!("fire{}", at + 2) }
        };
        let fires =
            (0..FIRES.len()).map(|at| Fire::read(values, &fire_name(at), FIRES[at])).collect::<Result<_, _>>()?;
        let classes = Conv2d::with_bias(values, classes, [CLASSES, 512, 1, 1], 1, none)?;
        Ok(Self { first, fires, classes, preprocessing })
    }

    /// What [`SqueezeNet::taps`] does to images first.
    #[must_use]
    pub fn preprocessing(&self) -> Preprocessing {
        self.preprocessing
    }

    /// The seven features that LPIPS compares.
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]; H and W at least 17
    /// - output k: `[N, C_k, ..]`, C = 64, 128, 256, 384, 384, 512, 512
    #[must_use]
    pub fn taps(&self, images: Tensor<4>) -> Vec<Tensor<4>> {
        self.taps_preprocessed(self.preprocessing.apply(images))
    }

    /// As [`SqueezeNet::taps`] for input that is already what the kernels expect.
    #[must_use]
    pub fn taps_preprocessed(&self, input: Tensor<4>) -> Vec<Tensor<4>> {
        let mut x = relu(self.first.forward(input));
        let mut taps = vec![x.clone()];
        for (at, fire) in self.fires.iter().enumerate() {
            if POOL_BEFORE.contains(&at) {
                // torchvision rounds the size up, the other layout's package down; they differ for even sizes only.
                let options = MaxPoolOptions::new([3, 3]).with_stride([2, 2]);
                let ceil_mode = self.preprocessing == Preprocessing::Torchvision;
                x = max_pool2d(x, MaxPoolOptions { ceil_mode, ..options });
            }
            x = fire.forward(x);
            if TAPS_AFTER.contains(&at) {
                taps.push(x.clone());
            }
        }
        taps
    }

    /// Mean over positions of the last feature map, and class scores.
    ///
    /// # Shapes
    /// - images: `[N, 3, H, W]`, RGB in [0, 1]; trained on 224×224
    /// - output: `[N, 512]`, `[N, 1000]`
    #[must_use]
    pub fn pooled_and_logits(&self, images: Tensor<4>) -> (Tensor<2>, Tensor<2>) {
        let input = self.preprocessing.apply(images);
        let Some(last) = self.taps_preprocessed(input).pop() else {
            unreachable!("there is a tap after the first layer")
        };
        let scores = self.classes.forward(last.clone());
        let scores = if self.preprocessing == Preprocessing::Torchvision { relu(scores) } else { scores };
        (spatial_mean(last), spatial_mean(scores))
    }
}
