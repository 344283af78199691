//! `rigscape evaluate`: pictures against pictures, every number with its protocol.

mod labels;
mod reports;
mod sides;
mod statistics;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant as Clock;

use anyhow::{Context, bail};
use clap::Parser;
use metrics::{NovelViewSummary, Protocol};
use sha2::{Digest, Sha256};
use train::{DeviceConfig, head_commit};

use self::labels::labels;
use self::reports::{Evaluated, write_reports};
use self::sides::{Sides, model, novel_views, painted, stored};
use self::statistics::{replaced, save_statistics};
use super::common::{DataArgs, LoadedModel, UsageError, say};
use super::views::parse_angle;
use crate::evaluate::{
    NetworkFolder, Pass, PassOptions, PictureSource, Report, Side, draw_report, needs_pairs, numbers,
};

/// Compare two sets of pictures, or a checkpoint's reconstructions with what it was shown, by named protocols
#[derive(Debug, Parser)]
pub struct EvaluateArgs {
    /// Folder of real pictures
    #[arg(long, value_name = "DIR")]
    pub real: Option<PathBuf>,
    /// Folder of generated pictures
    #[arg(long, value_name = "DIR")]
    pub generated: Option<PathBuf>,
    /// Real pictures as a dataset: a TOML file with `[[data]]` tables
    #[arg(long, value_name = "FILE", conflicts_with = "real")]
    pub real_data: Option<PathBuf>,
    /// Generated pictures as a dataset: a TOML file with `[[data]]` tables
    #[arg(long, value_name = "FILE", conflicts_with = "generated")]
    pub generated_data: Option<PathBuf>,
    /// Run or checkpoint folder: its reconstructions are measured against the pictures it was shown
    #[arg(long, value_name = "DIR", conflicts_with_all = ["real", "generated", "real_data", "generated_data"])]
    pub checkpoint: Option<PathBuf>,
    /// Result file of a detector in the nuScenes benchmark's form: its detection score on --nuscenes and --split
    #[arg(long, value_name = "FILE", requires = "nuscenes", conflicts_with_all = ["real", "generated", "checkpoint"])]
    pub detections: Option<PathBuf>,
    /// Folder of a bird's-eye-view segmenter's rasters: for every frame of the data `<frame>.npy`, probabilities of road and vehicle
    /// [2, 200, 200], row 0 ahead, column 0 left, 0.5 m a cell
    #[arg(long, value_name = "DIR", conflicts_with_all = ["real", "generated", "checkpoint"])]
    pub segmentation: Option<PathBuf>,
    /// With both: the W-CODA score, from this Frechet video distance of the same pictures
    #[arg(long, value_name = "FVD", requires = "detections", requires = "segmentation")]
    pub wcoda_fvd: Option<f64>,
    /// Turns of the rig for views that no camera took, degrees, for --checkpoint; where the data can render their truth [default: the
    /// experiment's]
    #[arg(long, value_name = "DEG", value_delimiter = ',', allow_hyphen_values = true, requires = "checkpoint", value_parser = parse_angle)]
    pub yaw: Vec<f64>,
    /// Data for --checkpoint [default: the experiment's held-out data], --detections and --segmentation
    #[command(flatten)]
    pub data: DataArgs,
    /// Statistics of the real set instead of its pictures: .safetensors of --save-stats or .npz of pytorch-fid
    #[arg(long, value_name = "FILE", conflicts_with_all = ["real", "real_data", "checkpoint"])]
    pub real_stats: Option<PathBuf>,
    /// Save mean and covariance of the measured set's features: .safetensors, or .npz for pytorch-fid; with --generated alone
    /// nothing else is done
    #[arg(long, value_name = "FILE")]
    pub save_stats: Option<PathBuf>,
    /// Protocols by name, separated by commas [default: what pairs and weights allow]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    pub protocol: Vec<String>,
    /// TOML file with further `[[protocol]]` tables
    #[arg(long, value_name = "FILE")]
    pub protocols: Option<PathBuf>,
    /// Print every protocol and stop
    #[arg(long)]
    pub list: bool,
    /// Folder of network weights; may be repeated [default: the environment variable RIGSCAPE_WEIGHTS]
    #[arg(long, value_name = "DIR")]
    pub weights: Vec<PathBuf>,
    /// Bring all pictures to this size first, rows x columns
    #[arg(long, value_name = "HxW", value_parser = parse_size)]
    pub size: Option<[usize; 2]>,
    /// The sides are sets, not pairs: metrics of whole sets only
    #[arg(long)]
    pub unpaired: bool,
    /// Frames of each scene, the first ones; 0 for all
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub frames: usize,
    /// Pictures that go through a network at once
    #[arg(long, value_name = "N", default_value_t = 16)]
    pub batch: usize,
    /// Of the choice of subsets
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Worst pairs that are drawn
    #[arg(long, value_name = "N", default_value_t = 6)]
    pub worst: usize,
    /// Folder for report.json, report.md and report.png
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Where networks compute [default: as the run was trained, else flex]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// Largest side of --size, px.
const MOST_SIDE: usize = 8192;

fn parse_size(text: &str) -> Result<[usize; 2], String> {
    let sides: Option<Vec<usize>> = text.split(['x', 'X']).map(|side| side.trim().parse().ok()).collect();
    match sides.as_deref() {
        Some([height, width]) if [height, width].iter().all(|side| (1..=MOST_SIDE).contains(*side)) => {
            Ok([*height, *width])
        }
        _ => Err(format!("write rows x columns, for example 256x256, at most {MOST_SIDE}")),
    }
}

/// Consistency of neighbouring views, for models that paint whole rigs.
const RIG_DEFAULT: &str = "mvsc/v1";
/// Protocols of pairs that need no weights.
const PAIR_DEFAULTS: [&str; 3] = ["psnr/bev-vae", "ssim/skimage7", "ssim/gauss11"];
/// Protocol of sets that any folder fits.
const SET_DEFAULT: &str = "fid/plain";

/// Runs the command.
///
/// # Errors
/// Unknown protocols, missing weights, pictures that cannot be read or paired, sets that are too small.
pub fn evaluate(args: &EvaluateArgs) -> anyhow::Result<()> {
    let known = known_protocols(args)?;
    if args.list {
        return known.iter().try_for_each(|protocol| say(format_args!("{:<20} {}", protocol.name, protocol.text)));
    }
    if args.detections.is_some() || args.segmentation.is_some() {
        return labels(args);
    }
    let folders = weight_folders(args);
    let protocols = chosen(args, &known, !folders.is_empty())?;
    for protocol in &protocols {
        say(format_args!("{}: {} [{}]", protocol.name, protocol.text, protocol.source))?;
    }
    match &args.checkpoint {
        Some(path) => {
            let loaded = LoadedModel::open(path, args.device)?;
            let networks = NetworkFolder { folders, device: loaded.device.clone() };
            let mut reports = Vec::new();
            for dataset in loaded.datasets(&args.data)? {
                let sides = painted(&loaded, &dataset, args.frames);
                let novel = || novel_views(&loaded, &dataset, &args.yaw, args.frames);
                reports.extend(run(args, &protocols, &networks, sides, (model(path), &novel))?);
            }
            write_reports(args.out.as_deref(), &reports)
        }
        None => {
            let device = args.device.unwrap_or_default().open()?;
            let networks = NetworkFolder { folders, device };
            let evaluated = run(args, &protocols, &networks, stored(args)?, (BTreeMap::new(), &|| Ok(Vec::new())))?;
            write_reports(args.out.as_deref(), evaluated.as_slice())
        }
    }
}

fn known_protocols(args: &EvaluateArgs) -> anyhow::Result<Vec<Protocol>> {
    let mut known = Protocol::built_in()?;
    if let Some(path) = &args.protocols {
        let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
        let further = Protocol::parse(&text).with_context(|| format!("in {}", path.display()))?;
        if let Some(twice) = further.iter().find(|one| known.iter().any(|other| other.name == one.name)) {
            let name = &twice.name;
            bail!(UsageError::of(format!(
                "{name} is a built-in protocol; changed settings need a new name, {name}/v2: {}",
                path.display()
            )));
        }
        known.extend(further);
    }
    Ok(known)
}

fn weight_folders(args: &EvaluateArgs) -> Vec<PathBuf> {
    let asked = || args.weights.clone();
    let usual = || std::env::var_os("RIGSCAPE_WEIGHTS").map(PathBuf::from).into_iter().collect();
    if args.weights.is_empty() { usual() } else { asked() }
}

fn chosen(args: &EvaluateArgs, known: &[Protocol], has_weights: bool) -> anyhow::Result<Vec<Protocol>> {
    let alone = args.unpaired || args.real_stats.is_some() || !has_real(args);
    let mut names: Vec<&str> = args.protocol.iter().map(|name| name.trim()).collect();
    if names.is_empty() {
        names.extend(PAIR_DEFAULTS.iter().filter(|_| !alone));
        names.extend([SET_DEFAULT].iter().filter(|_| has_weights || alone));
        names.extend([RIG_DEFAULT].iter().filter(|_| has_weights && args.checkpoint.is_some()));
    }
    let one = |name: &&str| {
        let found = known.iter().find(|protocol| protocol.name == **name).cloned();
        found.ok_or_else(|| UsageError::of(format!("there is no protocol {name:?}; --list shows all of them")))
    };
    let found: Vec<Protocol> = names.iter().map(one).collect::<anyhow::Result<_>>()?;
    if alone && let Some(pairs) = found.iter().find(|protocol| needs_pairs(protocol)) {
        return Err(UsageError::of(format!(
            "{} compares pairs of pictures; give both sides without --unpaired",
            pairs.name
        )));
    }
    Ok(found)
}

fn has_real(args: &EvaluateArgs) -> bool {
    args.checkpoint.is_some() || args.real.is_some() || args.real_data.is_some()
}

fn run(
    args: &EvaluateArgs,
    protocols: &[Protocol],
    networks: &NetworkFolder,
    (real, generated): Sides<'_>,
    (model, novel_views): (BTreeMap<String, String>, &dyn Fn() -> anyhow::Result<Vec<NovelViewSummary>>),
) -> anyhow::Result<Option<Evaluated>> {
    let clock = Clock::now();
    let options = PassOptions {
        protocols: protocols.to_vec(),
        size: args.size,
        batch: args.batch,
        seed: args.seed,
        worst: args.worst,
    };
    let mut pass = Pass::new(&options, networks)?;
    let frames_sha256 = list_hash(&*generated)?;
    match &real {
        Some(real) if !args.unpaired => pass.paired(&**real, &*generated)?,
        real => {
            if let Some(real) = real {
                pass.alone(Side::Real, &**real)?;
            }
            pass.alone(Side::Generated, &*generated)?;
        }
    }
    let replaced = replaced(args, &pass)?;
    if let Some(path) = &args.save_stats {
        save_statistics(path, args, &pass, &*generated, &frames_sha256)?;
    }
    if real.is_none() && args.real_stats.is_none() {
        return Ok(None);
    }
    let novel_views = novel_views()?;
    let report = Report {
        code: code_version(),
        real: real.as_ref().map_or_else(|| describe_file(args.real_stats.as_deref()), |real| real.describe()),
        generated: generated.describe(),
        model,
        frames_sha256,
        frames: pass.frames,
        pictures: pass.pictures,
        skipped: pass.skipped.clone(),
        seed: args.seed,
        size: args.size,
        metrics: numbers(&pass, protocols, &replaced, args.seed)?,
        novel_views,
        wall_seconds: clock.elapsed().as_secs_f64(),
    };
    say(report.markdown())?;
    let sides = real.as_ref().filter(|_| !args.unpaired).map(|real| (&**real, &*generated));
    let picture = args.out.as_ref().map(|_| draw_report(&report, &pass.scalars, sides)).transpose()?;
    Ok(Some(Evaluated { report, picture }))
}

fn describe_file(path: Option<&Path>) -> String {
    path.map_or_else(String::new, |path| format!("statistics {}", path.display()))
}

/// Version and commit of the checkout the program was built from, wherever it is called.
fn code_version() -> String {
    let commit = head_commit(Path::new(env!("CARGO_MANIFEST_DIR"))).unwrap_or_else(|| "unknown".to_owned());
    format!("rigscape {} commit {commit}", env!("CARGO_PKG_VERSION"))
}

fn list_hash(source: &dyn PictureSource) -> anyhow::Result<String> {
    let mut hash = Sha256::new();
    for index in 0..source.len() {
        hash.update(source.name(index)?);
        hash.update([0]);
    }
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}
