//! What an evaluation leaves behind: every number with everything it depends on.

mod markdown;

use std::collections::BTreeMap;

use metrics::{
    FeatureStatistics, FrechetDistance, KidSubsets, MetricChoice, NovelViewSummary, Protocol, frechet_distance, kid,
    mvsc, precision_recall,
};
use serde::Serialize;

use super::network::WeightsUsed;
use super::pass::Pass;
use super::streams::{FeatureStream, SeamStream, Side};

/// Printed beside every number of a stand-in network.
pub const STAND_IN: &str =
    "computed with a stand-in network: good for comparisons inside this project, never beside published numbers";

/// One number.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MetricReport {
    /// `fid` only with the official weights, else `fid-<network>`.
    pub name: String,
    /// Name of the protocol, with `@HxW` where pictures were brought to a size first.
    pub protocol: String,
    /// Full precision; `None` where there is none, with the reason in the notes.
    pub value: Option<f64>,
    /// Deviation over pictures or subsets.
    pub deviation: Option<f64>,
    /// The value of each camera, where pairs are compared and cameras have names.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub cameras: BTreeMap<String, Option<f64>>,
    /// Unit of the value.
    pub unit: &'static str,
    /// Which direction is good.
    pub higher_is_better: bool,
    /// Pictures, clips or samples that count, generated side.
    pub samples: u64,
    /// The same of the real side, where the sides are compared as sets.
    pub real_samples: Option<u64>,
    /// Pictures that do not count.
    pub skipped: u64,
    /// True for a number that must not be called by the metric's own name.
    pub is_proxy: bool,
    /// Weights it was computed with.
    pub weights: Option<WeightsUsed>,
    /// The whole protocol.
    pub settings: Protocol,
    /// Warnings and explanations.
    pub notes: Vec<String>,
}

/// The whole evaluation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// Version and commit of the program.
    pub code: String,
    /// What was compared with.
    pub real: String,
    /// What was measured.
    pub generated: String,
    /// Checkpoint and how it painted, where a model did.
    pub model: BTreeMap<String, String>,
    /// SHA-256 of the names of all frames in order.
    pub frames_sha256: String,
    /// Frames of the generated side.
    pub frames: u64,
    /// Their pictures.
    pub pictures: u64,
    /// Why frames did not count, and how often.
    pub skipped: BTreeMap<String, u64>,
    /// Of the choice of subsets.
    pub seed: u64,
    /// Pictures of both sides were first brought to these rows and columns.
    pub size: Option<[usize; 2]>,
    /// From the first picture to the last number.
    pub wall_seconds: f64,
    /// One entry per number.
    pub metrics: Vec<MetricReport>,
    /// Views that no camera took against their rendering, one entry per motion of the rig (protocol `nvs/toy`).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub novel_views: Vec<NovelViewSummary>,
}

/// Statistics per stream and side, where a file replaces a side.
pub type Replaced = BTreeMap<Side, FeatureStatistics>;

/// Every number of a pass, in the order of the protocols.
///
/// # Errors
/// Sets that are too small for any number, features of different networks.
pub fn numbers(
    pass: &Pass,
    protocols: &[Protocol],
    replaced: &Replaced,
    seed: u64,
) -> anyhow::Result<Vec<MetricReport>> {
    let mut found = Vec::new();
    for protocol in protocols {
        match &protocol.metric {
            MetricChoice::Mvsc | MetricChoice::Vms => {
                found.extend(pass.seams.as_ref().map(|seams| consistency(protocol, seams)));
            }
            _ => {
                let scalar = pass.scalars.iter().find(|scalar| scalar.protocol == *protocol);
                if let Some(scalar) = scalar {
                    let mut report = start(protocol, scalar.mean.count() + scalar.identical);
                    if let Some(loaded) = &scalar.network {
                        report = report.looked_through(&loaded.weights, loaded.stand_in.as_ref());
                    }
                    (report.value, report.deviation) = (scalar.mean.mean(), scalar.mean.deviation());
                    let named = scalar.cameras.iter().filter(|(camera, _)| !camera.is_empty());
                    report.cameras = named.map(|(camera, mean)| (camera.clone(), mean.mean())).collect();
                    if scalar.identical > 0 {
                        let identical = scalar.identical;
                        report
                            .notes
                            .push(format!("{identical} pictures equal their counterpart and are left out of the mean"));
                        report.skipped = identical;
                    }
                    found.push(report);
                } else if let Some(stream) = pass.stream_of(protocol) {
                    found.extend(of_stream(protocol, stream, replaced, seed)?);
                }
            }
        }
    }
    Ok(found)
}

fn start(protocol: &Protocol, samples: u64) -> MetricReport {
    let (name, unit, higher_is_better) = match protocol.metric {
        MetricChoice::Psnr => ("psnr", "dB", true),
        MetricChoice::Ssim { .. } => ("ssim", "1", true),
        MetricChoice::MsSsim => ("ms_ssim", "1", true),
        MetricChoice::Lpips { .. } => ("lpips", "1", false),
        MetricChoice::Fid { .. } => ("fid", "1", false),
        MetricChoice::Kid { .. } => ("kid", "1", false),
        MetricChoice::PrecisionRecall { .. } => ("precision", "1", true),
        MetricChoice::Fvd { .. } => ("fvd", "1", false),
        MetricChoice::Mvsc => ("mvsc", "1", true),
        MetricChoice::Vms => ("vms", "%", true),
    };
    let mut notes = Vec::new();
    if let Some(usual) = protocol.samples.filter(|usual| *usual != samples) {
        notes.push(format!("published numbers of this protocol count {usual} samples, this one {samples}"));
    }
    MetricReport {
        name: name.to_owned(),
        protocol: protocol.name.clone(),
        value: None,
        deviation: None,
        cameras: BTreeMap::new(),
        unit,
        higher_is_better,
        samples,
        real_samples: None,
        skipped: 0,
        is_proxy: false,
        weights: None,
        settings: protocol.clone(),
        notes,
    }
}

impl MetricReport {
    fn looked_through(mut self, weights: &WeightsUsed, stand_in: Option<&String>) -> Self {
        self.weights = Some(weights.clone());
        if let Some(network) = stand_in {
            self.name = match self.settings.metric {
                MetricChoice::Fvd { .. } => format!("fvd-frames-{network}"),
                MetricChoice::Mvsc | MetricChoice::Vms => format!("{}_proxy({network})", self.name),
                MetricChoice::Lpips { .. } => format!("perceptual_distance({network})"),
                _ => format!("{}-{network}", self.name),
            };
            self.is_proxy = true;
            self.notes.push(STAND_IN.to_owned());
        }
        self
    }
}

fn consistency(protocol: &Protocol, seams: &SeamStream) -> MetricReport {
    let report = start(protocol, seams.generated.samples());
    let mut report = report.looked_through(&seams.weights, seams.stand_in.as_ref());
    report.real_samples = Some(seams.real.samples());
    report.value = match protocol.metric {
        MetricChoice::Mvsc => mvsc(&seams.generated, &seams.real),
        _ => seams.generated.mean().map(|mean| 100.0 * mean),
    };
    if report.value.is_none() {
        report.notes.push("nothing matches in the real pictures, so there is no ratio".to_owned());
    }
    let (real, generated) = (&seams.real, &seams.generated);
    let (pairs, empty) = (seams.pairs, [real.without_match(), generated.without_match()]);
    report.notes.push(format!(
        "{pairs} pairs of views of both sides; samples without match: {} real, {} generated; matches: {} real, {} generated; \
         the right half of a view is the matcher's first input, the left half of its clockwise neighbour the second",
        empty[0],
        empty[1],
        real.matches(),
        generated.matches()
    ));
    report
}

fn of_stream(
    protocol: &Protocol,
    stream: &FeatureStream,
    replaced: &Replaced,
    seed: u64,
) -> anyhow::Result<Vec<MetricReport>> {
    let (real, generated) = (stream.side(Side::Real), stream.side(Side::Generated));
    let report = start(protocol, generated.moments.count() as u64);
    let mut report = report.looked_through(&stream.loaded.weights, stream.loaded.stand_in.as_ref());
    report.real_samples = Some(real.moments.count() as u64);
    match &protocol.metric {
        MetricChoice::Kid { subsets, .. } => {
            let subsets = KidSubsets { seed: subsets.seed.wrapping_add(seed), ..*subsets };
            let found = kid(&generated.pool.rows(), &real.pool.rows(), &subsets)?;
            (report.value, report.deviation) = (Some(found.mean), Some(found.deviation));
            report.notes.push(format!("{} subsets of {} samples of each side", subsets.count, found.subset_size));
            Ok(vec![report])
        }
        MetricChoice::PrecisionRecall { neighbours, most, .. } => {
            let found =
                precision_recall(&real.pool.rows().first(*most), &generated.pool.rows().first(*most), *neighbours)?;
            let recall = report.name.replacen("precision", "recall", 1);
            report.value = Some(found.precision);
            let recall = MetricReport { name: recall, value: Some(found.recall), ..report.clone() };
            Ok(vec![report, recall])
        }
        _ => {
            let [real, generated] = [(Side::Real, "the real set"), (Side::Generated, "the generated set")].map(
                |(side, what)| match replaced.get(&side) {
                    Some(statistics) => Ok(statistics.clone()),
                    None => stream.side(side).moments.statistics(what),
                },
            );
            let (real, generated) = (real?, generated?);
            report.real_samples = real.count.map(|count| count as u64);
            let found = frechet_distance(&generated, &real)?;
            report.value = Some(found.value);
            report.notes.extend(rank_warning(&found, [&generated, &real]));
            Ok(vec![report])
        }
    }
}

/// Fewer samples than features leave directions without any spread, which biases the distance upwards.
fn rank_warning(found: &FrechetDistance, sets: [&FeatureStatistics; 2]) -> Option<String> {
    let width = sets[0].width();
    let small = sets.iter().any(|set| set.count.is_some_and(|count| count <= width));
    let counts = sets.map(|set| set.count.map_or("an unknown number of".to_owned(), |count| count.to_string()));
    small.then(|| {
        format!(
            "warning: {} generated and {} real samples for {width} features; the covariances have rank {} and {}, so the distance is \
             biased upwards and depends on the number of samples",
            counts[0], counts[1], found.ranks[0], found.ranks[1]
        )
    })
}
