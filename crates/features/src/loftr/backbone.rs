//! The residual network below the transformer, down to an eighth of the size.

use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use nn::weights::WeightError;

use crate::conv::{Conv2d, Padding};
use crate::frozen::Values;

const EPSILON: f64 = 1e-5;

/// Channels in and out and stride of the three stages; each has two residual blocks.
const STAGES: [[usize; 3]; 3] = [[128, 128, 1], [128, 196, 2], [196, 256, 2]];

/// 3×3, 3×3, and a 1×1 shortcut where the size changes.
#[derive(Debug, Clone)]
struct Residual {
    convs: [Conv2d; 2],
    shortcut: Option<Conv2d>,
}

impl Residual {
    fn read(values: &mut Values<'_>, name: &str, [channels, out, stride]: [usize; 3]) -> Result<Self, WeightError> {
        let mut conv = |layer: &str, norm: &str, shape: [usize; 4], stride: usize| {
            let folded = values.folded(&format!("{name}.{layer}"), shape, &format!("{name}.{norm}"), EPSILON)?;
            Ok::<_, WeightError>(Conv2d::folded(folded, stride, Padding::Zeros([shape[2] / 2; 2])))
        };
        let convs = [conv("conv1", "bn1", [out, channels, 3, 3], stride)?, conv("conv2", "bn2", [out, out, 3, 3], 1)?];
        let shortcut = (stride != 1).then(|| conv("downsample.0", "downsample.1", [out, channels, 1, 1], stride));
        Ok(Self { convs, shortcut: shortcut.transpose()? })
    }

    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [first, second] = &self.convs;
        let y = second.forward(relu(first.forward(x.clone())));
        let x = match &self.shortcut {
            Some(shortcut) => shortcut.forward(x),
            None => x,
        };
        relu(x + y)
    }
}

#[derive(Debug, Clone)]
pub(super) struct Backbone {
    stem: Conv2d,
    blocks: Vec<Residual>,
    lateral: Conv2d,
}

impl Backbone {
    pub fn read(values: &mut Values<'_>) -> Result<Self, WeightError> {
        let stem = values.folded("backbone.conv1", [128, 1, 7, 7], "backbone.bn1", EPSILON)?;
        let mut blocks = Vec::with_capacity(6);
        for (stage, [channels, out, stride]) in STAGES.into_iter().enumerate() {
            for (block, shape) in [[channels, out, stride], [out, out, 1]].into_iter().enumerate() {
                blocks.push(Residual::read(values, &format!("backbone.layer{}.{block}", stage + 1), shape)?);
            }
        }
        let lateral = Conv2d::plain(values, "backbone.layer3_outconv", [256, 256, 1, 1], 1, Padding::Zeros([0, 0]))?;
        Ok(Self { stem: Conv2d::folded(stem, 2, Padding::Zeros([3, 3])), blocks, lateral })
    }

    pub fn forward(&self, images: Tensor<4>) -> Tensor<4> {
        let x = relu(self.stem.forward(images));
        self.lateral.forward(self.blocks.iter().fold(x, |x, block| block.forward(x)))
    }
}
