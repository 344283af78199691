//! LPIPS: the distance of unit-normalised features, weighted per channel by learned heads.
//!
//! Paper: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", section 3 and equation 1.
//! Parity: `tests/it/lpips.rs`. Shapes: N images, H and W pixels.

use std::path::Path;

use burn::tensor::{Device, Tensor};
use nn::weights::{WeightError, WeightFile};

use crate::frozen::beside;
use crate::{Preprocessing, SqueezeNet, Tap, Vgg16};

/// Keeps the direction of a feature that is zero everywhere defined.
const EPSILON: f32 = 1e-10;

/// Channels of VGG-16's and SqueezeNet's taps.
const VGG_CHANNELS: &[usize] = &[64, 128, 256, 512, 512];
const SQUEEZE_CHANNELS: &[usize] = &[64, 128, 256, 384, 384, 512, 512];

/// The network that LPIPS looks through.
#[derive(Debug, Clone)]
pub enum LpipsBackbone {
    /// `vgg`
    Vgg(Vgg16),
    /// `squeeze`
    Squeeze(Box<SqueezeNet>),
}

impl LpipsBackbone {
    /// What the heads of this network are called in the release.
    #[must_use]
    pub fn name(&self) -> &'static str {
        match self {
            Self::Vgg(_) => "vgg",
            Self::Squeeze(_) => "squeeze",
        }
    }

    /// Whether the heads were trained on this layout's weights. On others the number is no LPIPS.
    #[must_use]
    pub fn fits_the_heads(&self) -> bool {
        let preprocessing = match self {
            Self::Vgg(network) => network.preprocessing(),
            Self::Squeeze(network) => network.preprocessing(),
        };
        preprocessing == Preprocessing::Torchvision
    }

    fn channels(&self) -> &'static [usize] {
        match self {
            Self::Vgg(_) => VGG_CHANNELS,
            Self::Squeeze(_) => SQUEEZE_CHANNELS,
        }
    }

    fn taps(&self, input: Tensor<4>) -> Vec<Tensor<4>> {
        match self {
            Self::Vgg(network) => network.forward_preprocessed(input, Tap::Relu5_3),
            Self::Squeeze(network) => network.taps_preprocessed(input),
        }
    }
}

/// A backbone with its heads.
#[derive(Debug, Clone)]
pub struct Lpips {
    backbone: LpipsBackbone,
    /// One `[1, C, 1, 1]` per tap.
    heads: Vec<Tensor<4>>,
}

impl Lpips {
    /// Reads the heads from the release's file for this network (`lin0.model.1.weight`, …; version 0.1), or from one file for
    /// all networks (`vgg.lin0.model.1.weight`).
    ///
    /// # Errors
    /// What [`WeightFile::open`] reports, [`WeightError::MissingTensor`], or [`WeightError::Layout`] for a head of another
    /// size.
    pub fn load(backbone: LpipsBackbone, heads: impl AsRef<Path>, device: &Device) -> Result<Self, WeightError> {
        let file = WeightFile::open(heads)?;
        let device = device.clone().without_autodiff();
        let mut read = Vec::new();
        for (at, channels) in backbone.channels().iter().enumerate() {
            let plain = format!("lin{at}.model.1.weight");
            let name = if file.shape(&plain).is_some() { plain } else { format!("{}.{plain}", backbone.name()) };
            let head = file.tensor(&name)?;
            if head.shape != [1, *channels, 1, 1] {
                let reason = format!("{name} is {:?}, {} needs [1, {channels}, 1, 1]", head.shape, backbone.name());
                return Err(WeightError::Layout { reason, path: file.path().to_path_buf() });
            }
            read.push(Tensor::from_data(burn::tensor::TensorData::new(head.data, head.shape), &device));
        }
        Ok(Self { backbone, heads: read })
    }

    /// The network below the heads.
    #[must_use]
    pub fn backbone(&self) -> &LpipsBackbone {
        &self.backbone
    }

    /// Distance of each pair, differentiable with respect to both. 0 for equal images; symmetric.
    ///
    /// # Shapes
    /// - a, b: `[N, 3, H, W]`, RGB in [0, 1]
    /// - output: `[N]`
    #[must_use]
    pub fn forward(&self, a: Tensor<4>, b: Tensor<4>) -> Tensor<1> {
        assert_eq!(a.dims(), b.dims(), "the two sets of images");
        let (a, b) = (self.backbone.taps(scaled(a)), self.backbone.taps(scaled(b)));
        let per_tap = a.into_iter().zip(b).zip(&self.heads).map(|((a, b), head)| {
            let difference = (unit(a) - unit(b)).square();
            let head = beside(head, &difference);
            let [images, _, height, width] = difference.dims();
            ops::mean_dim(ops::sum_dim(difference * head, 1).reshape([images, height * width]), 1).reshape([images])
        });
        per_tap.reduce(|sum, tap| sum + tap).expect("every backbone has taps")
    }
}

/// The release's scaling: [−1, 1], then a fixed shift and scale.
fn scaled(images: Tensor<4>) -> Tensor<4> {
    let device = images.device();
    let per_channel = |values: [f32; 3]| Tensor::<1>::from_floats(values, &device).reshape([1, 3, 1, 1]);
    (images * 2.0 - 1.0 - per_channel([-0.030, -0.088, -0.188])) / per_channel([0.458, 0.448, 0.450])
}

/// Divided by the length over channels.
fn unit(feature: Tensor<4>) -> Tensor<4> {
    // The root of an exact zero has no slope; this one's is large and meets a factor of zero.
    let length = (ops::sum_dim(feature.clone().square(), 1) + EPSILON * EPSILON).sqrt();
    feature / (length + EPSILON)
}
