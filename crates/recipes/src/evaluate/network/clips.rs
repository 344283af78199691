//! Features of clips.

use std::path::Path;

use anyhow::{Context, bail};
use burn::tensor::{Device, Tensor};
use features::{I3D_MIN_FRAMES, I3d, I3dEpsilon};
use metrics::Feature;

use super::{FeatureNetwork, Pictures};

/// I3D: 400 logits, or 1,024 pooled numbers where the protocol's layer is `pool1024`.
pub(super) struct I3dClips {
    network: I3d,
    feature: Feature,
    pooled: bool,
    device: Device,
}

impl I3dClips {
    pub(super) fn load(path: &Path, wanted: &Feature, device: &Device) -> anyhow::Result<Self> {
        let network = I3d::load(path, I3dEpsilon::Port, device)
            .with_context(|| format!("cannot use the weights {}", path.display()))?;
        let pooled = match wanted.layer.as_str() {
            "logits400" => false,
            "pool1024" => true,
            other => bail!("I3D has the layers logits400 and pool1024, not {other}"),
        };
        Ok(Self { network, feature: wanted.clone(), pooled, device: device.clone() })
    }
}

impl FeatureNetwork for I3dClips {
    fn feature(&self) -> &Feature {
        &self.feature
    }

    fn width(&self) -> usize {
        if self.pooled { 1024 } else { 400 }
    }

    fn features(&self, frames: Pictures<'_>) -> anyhow::Result<Vec<f32>> {
        if frames.count < I3D_MIN_FRAMES {
            let count = frames.count;
            bail!(
                "I3D needs clips of at least {I3D_MIN_FRAMES} frames, got {count}; choose a protocol that repeats frames"
            );
        }
        let shape = [1, frames.count, 3, frames.height, frames.width];
        let clip: Tensor<5> = frames.tensor(&self.device)?.reshape(shape);
        let found = self.network.features(clip);
        let row = if self.pooled { ops::mean_dim(found.pooled, 2).into_data() } else { found.logits.into_data() };
        Ok(row.iter::<f32>().collect())
    }
}

/// A stand-in for a network of clips: the mean of the frames' features, and the mean of their changes from frame to frame.
pub(super) struct FrameChanges {
    frames: Box<dyn FeatureNetwork>,
}

impl FrameChanges {
    pub(super) fn new(frames: Box<dyn FeatureNetwork>) -> Self {
        Self { frames }
    }
}

impl FeatureNetwork for FrameChanges {
    fn feature(&self) -> &Feature {
        self.frames.feature()
    }

    fn width(&self) -> usize {
        2 * self.frames.width()
    }

    fn features(&self, frames: Pictures<'_>) -> anyhow::Result<Vec<f32>> {
        let width = self.frames.width();
        let rows = self.frames.features(frames)?;
        let (mut level, mut change) = (vec![0.0; width], vec![0.0; width]);
        let mut before: Option<&[f32]> = None;
        for row in rows.chunks_exact(width.max(1)) {
            level.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value));
            let steps = before.into_iter().flatten().zip(row);
            change.iter_mut().zip(steps).for_each(|(sum, (a, b))| *sum += f64::from(b - a).abs());
            before = Some(row);
        }
        let (frames, steps) = (frames.count.max(1) as f64, frames.count.max(2) as f64 - 1.0);
        let level = level.iter().map(|sum| (sum / frames) as f32);
        Ok(level.chain(change.iter().map(|sum| (sum / steps) as f32)).collect())
    }
}
