//! Metrics with one number per pair of pictures.

use std::collections::BTreeMap;

use anyhow::{Context, bail};
use metrics::{
    Histogram, ImageSize, Mean, MetricChoice, PictureStep, Protocol, Raster, Worst, image_mse, ms_ssim, psnr_db, ssim,
};

use super::network::{Loaded, NetworkFolder, PairNetwork, Pictures};

/// Bins of the histograms.
const BINS: usize = 60;
/// dB; beyond it two pictures of 8 bits cannot differ.
const MOST_DB: f64 = 60.0;

/// Collects one metric over all pairs.
pub struct ScalarMetric {
    /// How it is computed.
    pub protocol: Protocol,
    /// What LPIPS looks through.
    pub network: Option<Loaded<dyn PairNetwork>>,
    /// Over pictures; those equal to their counterpart are left out of PSNR.
    pub mean: Mean,
    /// The same for each camera; a single unnamed one for folders.
    pub cameras: BTreeMap<String, Mean>,
    /// Equal pairs of PSNR.
    pub identical: u64,
    /// How the values spread.
    pub histogram: Histogram,
    /// `index:channel` of the worst pairs.
    pub worst: Worst,
}

impl ScalarMetric {
    /// `None` for a metric that is no number per pair.
    ///
    /// # Errors
    /// Missing or wrong weights of LPIPS.
    pub fn of(protocol: &Protocol, keep_worst: usize, networks: &NetworkFolder) -> anyhow::Result<Option<Self>> {
        let Some((range, higher_is_better)) = pair_range(&protocol.metric) else { return Ok(None) };
        let network = match &protocol.metric {
            MetricChoice::Lpips { network } => Some(networks.pairs(network)?),
            _ => None,
        };
        Ok(Some(Self {
            protocol: protocol.clone(),
            network,
            mean: Mean::default(),
            cameras: BTreeMap::new(),
            identical: 0,
            histogram: Histogram::new(range.0, range.1, BINS),
            worst: Worst::new(keep_worst, higher_is_better),
        }))
    }

    /// The value of one pair.
    ///
    /// # Errors
    /// As [`measure`].
    pub fn measure(&self, real: &Raster<u8>, generated: &Raster<u8>) -> anyhow::Result<f64> {
        let Some(loaded) = &self.network else { return measure(&self.protocol, real, generated) };
        let (real, generated) = same_size(&self.protocol, real, generated)?;
        let unit = |raster: &Raster<u8>| raster.map(|value| f32::from(value) / 255.0).planes();
        let (height, width) = (real.height, real.width);
        let (real, generated) = (unit(&real), unit(&generated));
        let pictures = |values| Pictures { count: 1, height, width, values };
        loaded.network.distance(pictures(&real), pictures(&generated))
    }

    /// Takes the value of a pair in: that of an instant's camera.
    pub fn add(&mut self, value: f64, index: usize, channel: &str) {
        if value == f64::INFINITY {
            self.identical += 1;
            return;
        }
        self.mean.add(value);
        self.cameras.entry(channel.to_owned()).or_default().add(value);
        self.histogram.add(value);
        self.worst.add(value, &format!("{index}:{channel}"));
    }
}

/// Steps of a protocol applied to a picture.
///
/// # Errors
/// A crop that reaches beyond the picture.
pub fn prepared(picture: &Raster<u8>, steps: &[PictureStep]) -> anyhow::Result<Raster<u8>> {
    steps.iter().try_fold(picture.clone(), |picture, step| {
        step.apply(&picture).with_context(|| {
            format!("the protocol's crop {step:?} does not fit a picture of {}x{}", picture.height, picture.width)
        })
    })
}

/// Ends of the histogram and whether higher is better; `None` for a metric that is no number per pair.
fn pair_range(metric: &MetricChoice) -> Option<((f64, f64), bool)> {
    match metric {
        MetricChoice::Psnr => Some(((0.0, MOST_DB), true)),
        MetricChoice::Ssim { .. } | MetricChoice::MsSsim => Some(((0.0, 1.0), true)),
        MetricChoice::Lpips { .. } => Some(((0.0, 1.0), false)),
        _ => None,
    }
}

/// Whether a protocol compares pairs of pictures.
pub fn needs_pairs(protocol: &Protocol) -> bool {
    pair_range(&protocol.metric).is_some()
}

/// Both pictures after the protocol's steps.
fn same_size(
    protocol: &Protocol,
    real: &Raster<u8>,
    generated: &Raster<u8>,
) -> anyhow::Result<(Raster<u8>, Raster<u8>)> {
    let (real, generated) = (prepared(real, &protocol.real)?, prepared(generated, &protocol.generated)?);
    if (real.height, real.width) != (generated.height, generated.width) {
        bail!(
            "the real picture is {}x{}, the generated one {}x{}; bring both to one size with --size HxW or choose a protocol that does",
            real.height,
            real.width,
            generated.height,
            generated.width
        );
    }
    Ok((real, generated))
}

/// The value of one pair for a metric without a network.
///
/// # Errors
/// Pictures of different sizes, or too small for the metric.
pub fn measure(protocol: &Protocol, real: &Raster<u8>, generated: &Raster<u8>) -> anyhow::Result<f64> {
    let (real, generated) = same_size(protocol, real, generated)?;
    let size = ImageSize { channels: 3, height: real.height, width: real.width };
    let (target, prediction) = (real.planes(), generated.planes());
    match protocol.metric {
        MetricChoice::Psnr => Ok(psnr_db(image_mse(&prediction, &target))),
        MetricChoice::Ssim { window } => {
            let side = window.side();
            if size.height.min(size.width) < side {
                bail!("{} needs pictures of at least {side} px, got {}x{}", protocol.name, size.height, size.width);
            }
            Ok(ssim(&prediction, &target, size, window))
        }
        MetricChoice::MsSsim => Ok(ms_ssim(&prediction, &target, size)?),
        _ => bail!("{} is no metric of pairs without a network", protocol.name),
    }
}
