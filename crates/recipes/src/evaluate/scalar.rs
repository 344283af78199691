//! Metrics with one number per pair of pictures.

use anyhow::{Context, bail};
use metrics::{
    Histogram, ImageSize, Mean, MetricChoice, PictureStep, Protocol, Raster, Worst, image_mse, ms_ssim, psnr_db, ssim,
};

/// Bins of the histograms.
const BINS: usize = 60;
/// dB; beyond it two pictures of 8 bits cannot differ.
const MOST_DB: f64 = 60.0;

/// Collects one metric over all pairs.
#[derive(Debug, Clone)]
pub struct ScalarMetric {
    /// How it is computed.
    pub protocol: Protocol,
    /// Over pictures; those equal to their counterpart are left out of PSNR.
    pub mean: Mean,
    /// Equal pairs of PSNR.
    pub identical: u64,
    /// How the values spread.
    pub histogram: Histogram,
    /// `index:channel` of the worst pairs.
    pub worst: Worst,
}

impl ScalarMetric {
    /// `None` for a metric that is no number per pair.
    pub fn of(protocol: &Protocol, keep_worst: usize) -> Option<Self> {
        let range = match protocol.metric {
            MetricChoice::Psnr => (0.0, MOST_DB),
            MetricChoice::Ssim { .. } | MetricChoice::MsSsim => (0.0, 1.0),
            _ => return None,
        };
        Some(Self {
            protocol: protocol.clone(),
            mean: Mean::default(),
            identical: 0,
            histogram: Histogram::new(range.0, range.1, BINS),
            worst: Worst::new(keep_worst, true),
        })
    }

    /// Takes the value of a pair in.
    pub fn add(&mut self, value: f64, place: &str) {
        if value == f64::INFINITY {
            self.identical += 1;
            return;
        }
        self.mean.add(value);
        self.histogram.add(value);
        self.worst.add(value, place);
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

/// The value of one pair.
///
/// # Errors
/// Pictures of different sizes, or too small for the metric.
pub fn measure(protocol: &Protocol, real: &Raster<u8>, generated: &Raster<u8>) -> anyhow::Result<f64> {
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
        _ => bail!("{} is no metric of pairs", protocol.name),
    }
}
