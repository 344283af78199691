//! Features of single pictures.

use std::path::Path;

use anyhow::Context;
use burn::tensor::Device;
use features::{EFFICIENTNET_SIZE, EfficientNetLite0, Inception, InceptionWeights};
use metrics::{Feature, ResizeFilter};

use super::{FeatureNetwork, Pictures};

/// Pooled features of Inception-v3, 2048 numbers.
pub(super) struct InceptionPool {
    network: Inception,
    feature: Feature,
    device: Device,
}

impl InceptionPool {
    pub(super) fn load(path: &Path, wanted: &Feature, device: &Device) -> anyhow::Result<Self> {
        let network =
            Inception::load(path, device).with_context(|| format!("cannot use the weights {}", path.display()))?;
        let feature = match network.weights() {
            InceptionWeights::Fid2015 => wanted.clone(),
            InceptionWeights::Nsfwjs => Feature {
                network: "inception_v3_nsfwjs".to_owned(),
                filter: ResizeFilter::PilBicubic,
                range: [0.0, 1.0],
                ..wanted.clone()
            },
        };
        Ok(Self { network, feature, device: device.clone() })
    }
}

impl FeatureNetwork for InceptionPool {
    fn feature(&self) -> &Feature {
        &self.feature
    }

    fn width(&self) -> usize {
        2048
    }

    fn features(&self, pictures: Pictures<'_>) -> anyhow::Result<Vec<f32>> {
        let [low, high] = self.feature.range;
        let input = pictures.tensor(&self.device)? * (high - low) + low;
        let last = self.network.maps(input).mixed_7c;
        Ok(ops::mean_dim(ops::mean_dim(last, 3), 2).into_data().iter::<f32>().collect())
    }
}

/// Pooled features of EfficientNet-Lite0, 1280 numbers.
pub(super) struct EfficientNetPool {
    network: EfficientNetLite0,
    feature: Feature,
    device: Device,
}

impl EfficientNetPool {
    pub(super) fn load(path: &Path, device: &Device) -> anyhow::Result<Self> {
        let network = EfficientNetLite0::load(path, device)
            .with_context(|| format!("cannot use the weights {}", path.display()))?;
        let feature = Feature {
            network: "efficientnet_lite0".to_owned(),
            layer: "pool1280".to_owned(),
            filter: ResizeFilter::PilBicubic,
            size: [EFFICIENTNET_SIZE; 2],
            // (byte - 127) / 128
            range: [-127.0 / 128.0, 1.0],
        };
        Ok(Self { network, feature, device: device.clone() })
    }
}

impl FeatureNetwork for EfficientNetPool {
    fn feature(&self) -> &Feature {
        &self.feature
    }

    fn width(&self) -> usize {
        1280
    }

    fn features(&self, pictures: Pictures<'_>) -> anyhow::Result<Vec<f32>> {
        Ok(self.network.pooled(pictures.tensor(&self.device)?).into_data().iter::<f32>().collect())
    }
}
