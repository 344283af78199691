//! `rigscape sweep-guidance`: quality of sampled pictures against the guidance scale.

use std::path::PathBuf;

use anyhow::Context;
use clap::Parser;
use metrics::Protocol;
use train::DeviceConfig;

use super::common::{UsageError, say};
use super::frame_choice::FrameArgs;
use crate::evaluate::{Curve, NetworkFolder, draw_curves, write_file};
use crate::sheet::save_picture;
use crate::synthesis::{SamplingArgs, Synthesiser, sweep_guidance as sweep};

/// Sample the layouts of some frames at several guidance scales with equal noise; table and plot of quality against scale
#[derive(Debug, Parser)]
pub struct SweepGuidanceArgs {
    /// Run folder of train-dit (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Run folder or checkpoint of the autoencoder [default: where it was during training]
    #[arg(long, value_name = "DIR")]
    pub autoencoder: Option<PathBuf>,
    /// Dataset whose layouts are sampled and whose pictures are the measure
    #[command(flatten)]
    pub frame: FrameArgs,
    /// Frames, spread evenly over the dataset
    #[arg(long, value_name = "N", default_value_t = 32)]
    pub frames: usize,
    /// Scales
    #[arg(long, value_name = "LIST", value_delimiter = ',', default_value = "0,1,2,3,4,5,6,7,8,9")]
    pub scales: Vec<f64>,
    /// Seed of the noise
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// How samples are made
    #[command(flatten)]
    pub sampling: SamplingArgs,
    /// Folder of network weights: distances in the features of Inception-v3 or its stand-in [default: mean colours of 4x4 cells]
    #[arg(long, value_name = "DIR")]
    pub weights: Option<PathBuf>,
    /// Folder to write sweep.json and sweep.png into
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// The protocol whose network looks at the pictures.
const PROTOCOL: &str = "fid/plain";

/// Runs the command.
///
/// # Errors
/// Names the option, file or frame that is at fault.
pub fn sweep_guidance(args: &SweepGuidanceArgs) -> anyhow::Result<()> {
    if let Some(scale) = args.scales.iter().find(|scale| !(scale.is_finite() && **scale >= 0.0)) {
        return Err(UsageError::of(format!("--scales: {scale} is no guidance scale, they begin at 0")));
    }
    let synthesiser = Synthesiser::open(&args.checkpoint, args.autoencoder.as_deref(), &args.sampling, args.device)?;
    let (dataset, _) = args.frame.open()?;
    let network = args.weights.clone().map(|folder| {
        let folders = NetworkFolder { folders: vec![folder], device: synthesiser.dit.device.clone() };
        let protocols = Protocol::built_in()?;
        let protocol = protocols.iter().find(|protocol| protocol.name == PROTOCOL);
        folders.pictures(protocol.and_then(Protocol::feature).context("the protocol has no network")?)
    });
    let network = network.transpose()?;
    let mut progress = |done: usize, total: usize| tracing::info!("{done} of {total} frames");
    let looks = network.as_ref().map(|loaded| &*loaded.network);
    let scene = (&synthesiser, &*dataset, args.seed);
    let report = sweep(scene, args.frames, &args.scales, looks, &mut progress)?;
    write_file(&args.out.join("sweep.json"), &serde_json::to_vec_pretty(&report)?)?;
    let curve = |name: &str, of: &dyn Fn(usize) -> f64| {
        let points = report.points.iter().enumerate().map(|(at, point)| [point.scale, of(at)]).collect();
        vec![Curve { name: name.to_owned(), points }]
    };
    let value = |at: usize, of: fn(&crate::synthesis::SweepPoint) -> f64| report.points.get(at).map_or(f64::NAN, of);
    let charts = [
        (
            "Frechet distance to the dataset's pictures, by guidance".to_owned(),
            curve("distance, smaller is better", &|at| value(at, |point| point.distance)),
        ),
        ("mean absolute change against guidance 0".to_owned(), curve("change", &|at| value(at, |point| point.change))),
    ];
    let title =
        format!("{} frames, {} pictures per scale; features: {}", report.frames, report.pictures, report.features);
    save_picture(&draw_curves(&title, &charts), &args.out.join("sweep.png"))?;
    say("| guidance | distance | change |\n|---|---|---|")?;
    for point in &report.points {
        say(format_args!("| {} | {:.4} | {:.4} |", point.scale, point.distance, point.change))?;
    }
    say(format_args!("written to {}", args.out.display()))
}
