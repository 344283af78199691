//! `rigscape import`: official checkpoints become ours.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use burn::module::Module;
use clap::{Args, Parser, Subcommand, ValueEnum};
use data::{LoaderConfig, PoseMode};
use nn::Init;
use serde::Deserialize;
use train::{CheckpointState, CheckpointStore, DeviceConfig};
use vae::official::{Average, OfficialCheckpoint, OfficialError};
use vae::{BevVae, Preset};

use super::UsageError;
use super::common::say;
use crate::bev_vae::{DataConfig, Experiment, RunConfig};
use crate::evaluate::write_file;
use crate::{ModelChoice, config_file, differences};

/// Turn a released checkpoint into one that every other command opens
#[derive(Debug, Parser)]
pub struct ImportArgs {
    /// Which release
    #[command(subcommand)]
    pub model: ImportModel,
}

/// Releases that can be read.
#[derive(Debug, Subcommand)]
pub enum ImportModel {
    /// A BEV-VAE checkpoint of the public code (PyTorch Lightning, .ckpt), read without Python and without executing anything in it
    BevVae(ImportBevVaeArgs),
}

/// Options of `import bev-vae`.
#[derive(Debug, Args)]
#[command(
    after_help = "Example:\n  rigscape import bev-vae bevvae.ckpt --out runs/official\n  rigscape reconstruct --checkpoint runs/official --nuscenes DIR --out sheet.png"
)]
pub struct ImportBevVaeArgs {
    /// The released file
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Run folder to make; it must not hold a checkpoint yet
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// TOML file with a [model] table, for a file of other sizes than the release; its preset must be "paper" [default: the preset
    /// paper as it is]
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Change one setting of the model, for example `--set model.latent_channels=8`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Which weights the commands shall use
    #[arg(long, value_enum, default_value = "auto")]
    pub weights: Weights,
    /// Also write the key-by-key report here, whether the file fits or not (Markdown)
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

/// Weights of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Weights {
    /// Averaged ones if the file has them
    Auto,
    /// Averaged ones (EMA), or an error
    Ema,
    /// Those of the last step
    Current,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelFile {
    model: ModelChoice,
}

/// Runs the command.
///
/// # Errors
/// A file that is damaged or does not fit, with every key that does not; another preset; an output that holds a checkpoint. Nothing
/// is written then but the report that was asked for.
pub fn import(args: &ImportArgs) -> anyhow::Result<()> {
    match &args.model {
        ImportModel::BevVae(args) => import_bev_vae(args),
    }
}

fn import_bev_vae(args: &ImportBevVaeArgs) -> anyhow::Result<()> {
    let choice = model_of(args)?;
    if args.out.join("checkpoints").exists() {
        bail!("{} holds checkpoints already; choose another --out", args.out.display());
    }
    let device = DeviceConfig::Flex.open()?;
    // Without values: the file has them.
    let config = choice.config.clone();
    let empty = || BevVae::new(&config, &mut Init::lazy(0, &device));
    let file = open(args, &empty())?;
    let average = match args.weights {
        Weights::Current => None,
        Weights::Auto => file.average(),
        Weights::Ema => Some(file.need_average()?),
    };
    let text = toml::to_string(&experiment(args, choice)).context("cannot write the config")?;
    let store = CheckpointStore::open(&args.out, 1)?;
    let folder = store.save(CheckpointState::default(), &text, |writer| {
        // One after the other: at the paper's size each is a gigabyte.
        let current = file.current(empty()).map_err(train::TrainError::task)?;
        writer.module("model", &current)?;
        let used = match average {
            Some(_) => file.averaged(empty()).map_err(train::TrainError::task)?,
            None => current,
        };
        writer.module("ema", &used)
    })?;
    write_file(&args.out.join("config.toml"), text.as_bytes())?;
    write_file(&args.out.join("import.md"), page(&args.file, &file, average).as_bytes())?;
    say(summary(&file, average, args.weights))?;
    say(format_args!(
        "{} parameters written to {}; every key: {}",
        empty().num_params(),
        folder.display(),
        args.out.join("import.md").display()
    ))
}

/// The model that the file is held against: preset `paper`, as it is or with changed sizes.
fn model_of(args: &ImportBevVaeArgs) -> anyhow::Result<ModelChoice> {
    let choice = match &args.config {
        Some(path) => config_file::load::<ModelFile>(path, &args.overrides)?.model,
        None => config_file::parse::<ModelFile>("[model]\npreset = \"paper\"\n", &args.overrides)?.model,
    };
    if choice.preset == Preset::Paper {
        return Ok(choice);
    }
    let lines = differences(&Preset::Paper.config(), &choice.config)?;
    Err(UsageError::of(format!(
        "the public code's checkpoints fit the preset paper only; {:?} differs in\n  {}",
        choice.preset,
        lines.join("\n  ")
    )))
}

/// Opens the file; writes the report that was asked for, also when keys do not fit.
fn open(args: &ImportBevVaeArgs, model: &BevVae) -> anyhow::Result<OfficialCheckpoint> {
    let opened = OfficialCheckpoint::open(&args.file, model);
    if let Some(path) = &args.report {
        match &opened {
            Ok(file) => write_file(path, file.report().markdown().as_bytes())?,
            Err(OfficialError::Keys { report, .. }) => write_file(path, report.markdown().as_bytes())?,
            Err(_) => {}
        }
    }
    Ok(opened?)
}

/// The experiment that the checkpoint carries: the network and the public code's poses; no data, which the file does not name.
fn experiment(args: &ImportBevVaeArgs, model: ModelChoice) -> Experiment {
    let name = args.out.file_name().map_or_else(|| "imported".to_owned(), |name| name.to_string_lossy().into_owned());
    let root = args.out.parent().filter(|root| !root.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Experiment {
        seed: 0,
        device: DeviceConfig::default(),
        run: RunConfig { name, root: root.to_owned() },
        init_from: None,
        model,
        data: DataConfig {
            train: Vec::new(),
            validation: Vec::new(),
            mixture: data::MixtureConfig::default(),
            loader: LoaderConfig { pose_mode: PoseMode::Static, ..LoaderConfig::default() },
        },
        loss: Default::default(),
        checkpointing: false,
        optimizer: Default::default(),
        ema: Default::default(),
        train: Default::default(),
        evaluation: Default::default(),
    }
}

fn summary(file: &OfficialCheckpoint, average: Option<&Average>, asked: Weights) -> String {
    let report = file.report();
    let keys = format!("{} keys taken, {} ignored by design", report.taken(), report.ignored());
    match (average, asked) {
        (Some(Average { place, surplus: 0 }), _) => format!("{keys}; averaged weights from {place}"),
        (Some(Average { place, surplus }), _) => {
            format!("{keys}; averaged weights from {place}, which holds {surplus} tensors of other networks besides")
        }
        (None, Weights::Current) => format!("{keys}; non-EMA weights, as asked for"),
        (None, _) => format!("{keys}; non-EMA weights: the file holds no averaged ones"),
    }
}

fn page(path: &Path, file: &OfficialCheckpoint, average: Option<&Average>) -> String {
    let place = average.map_or("state_dict (non-EMA weights)", |average| average.place.as_str());
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    format!("# Import of {name}\n\nWeights in use: {place}\n\n{}", file.report().markdown())
}
