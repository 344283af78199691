//! Perceptual distances of pairs.

use std::path::Path;

use anyhow::Context;
use burn::tensor::Device;
use features::{Lpips, LpipsBackbone, SqueezeNet, Vgg16};

use super::{PairNetwork, Pictures};

/// LPIPS, one pair at a time.
pub(super) struct LpipsPairs {
    lpips: Lpips,
    device: Device,
}

impl LpipsPairs {
    pub(super) fn load(backbone: &Path, heads: &Path, is_vgg: bool, device: &Device) -> anyhow::Result<Self> {
        let unusable = |path: &Path| format!("cannot use the weights {}", path.display());
        let network = if is_vgg {
            LpipsBackbone::Vgg(Vgg16::load(backbone, device).with_context(|| unusable(backbone))?)
        } else {
            LpipsBackbone::Squeeze(Box::new(SqueezeNet::load(backbone, device).with_context(|| unusable(backbone))?))
        };
        let lpips = Lpips::load(network, heads, device).with_context(|| unusable(heads))?;
        Ok(Self { lpips, device: device.clone() })
    }
}

impl PairNetwork for LpipsPairs {
    fn distance(&self, real: Pictures<'_>, generated: Pictures<'_>) -> anyhow::Result<f64> {
        let found = self.lpips.forward(real.tensor(&self.device)?, generated.tensor(&self.device)?);
        found.into_data().iter::<f32>().next().map(f64::from).context("LPIPS gave no distance")
    }
}
