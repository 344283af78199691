//! Matches across seams.

use std::path::Path;

use anyhow::Context;
use burn::tensor::{Device, Tensor, TensorData};
use features::{LOFTR_CELL, Loftr, MatchRules, Tap, Vgg16, mutual_matches};
use metrics::Seam;

use super::{Pictures, SeamMatcher};

/// LoFTR's coarse matches.
pub(super) struct LoftrSeams {
    network: Loftr,
    device: Device,
}

impl LoftrSeams {
    pub(super) fn load(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let network =
            Loftr::load(path, device).with_context(|| format!("cannot use the weights {}", path.display()))?;
        Ok(Self { network, device: device.clone() })
    }
}

impl SeamMatcher for LoftrSeams {
    fn confidences(&self, seams: &[Seam]) -> anyhow::Result<Vec<Vec<f32>>> {
        let one = |seam: &Seam| {
            let shape = [1, 1, seam.height, seam.width];
            let tensor = |half: &Vec<f32>| -> Tensor<4> {
                Tensor::from_data(TensorData::new(half.clone(), shape), &self.device)
            };
            let confidence = self.network.confidence(tensor(&seam.left), tensor(&seam.right));
            matched(confidence, [seam.height / LOFTR_CELL, seam.width / LOFTR_CELL])
        };
        Ok(seams.iter().map(one).collect())
    }
}

fn matched<const D: usize>(confidence: Tensor<D>, grid: [usize; 2]) -> Vec<f32> {
    let values: Vec<f32> = confidence.into_data().iter::<f32>().collect();
    mutual_matches(&values, [grid; 2], MatchRules::default()).iter().map(|one| one.confidence).collect()
}

/// Dual softmax over unit-length features of VGG-16 at an eighth of the size.
pub(super) struct VggSeams {
    vgg: Vgg16,
    device: Device,
}

/// Sharpness of the softmax, as in LoFTR.
const TEMPERATURE: f32 = 0.1;

impl VggSeams {
    pub(super) fn load(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let vgg = Vgg16::load(path, device).with_context(|| format!("cannot use the weights {}", path.display()))?;
        Ok(Self { vgg, device: device.clone() })
    }

    /// `[cells, C]`, unit length along C, and the grid.
    fn features(&self, half: &[f32], seam: &Seam) -> anyhow::Result<(Tensor<2>, [usize; 2])> {
        let rgb = [half, half, half].concat();
        let input = Pictures { count: 1, height: seam.height, width: seam.width, values: &rgb };
        let taps = self.vgg.forward(input.tensor(&self.device)?, Tap::Relu4_3);
        let last = taps.into_iter().last().context("VGG-16 gave no features")?;
        let [_, channels, rows, columns] = last.dims();
        let cells = last.reshape([channels, rows * columns]).transpose();
        let length = ops::sum_dim(cells.clone().square(), 1).sqrt().clamp_min(1e-10);
        Ok((cells / length, [rows, columns]))
    }
}

impl SeamMatcher for VggSeams {
    fn confidences(&self, seams: &[Seam]) -> anyhow::Result<Vec<Vec<f32>>> {
        let one = |seam: &Seam| {
            let (left, grid) = self.features(&seam.left, seam)?;
            let (right, _) = self.features(&seam.right, seam)?;
            let similarity = left.matmul(right.transpose()) / TEMPERATURE;
            let over_left = ops::softmax(similarity.clone().transpose()).transpose();
            Ok(matched(ops::softmax(similarity) * over_left, grid))
        };
        seams.iter().map(one).collect()
    }
}
