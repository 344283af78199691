//! What several subcommands share: logging, choice of data, opening a checkpoint.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::Arc;

use anyhow::{Context, bail};
use burn::tensor::Device;
use clap::Args;
use data::nuscenes::NuScenesConfig;
use data::{DatasetConfig, SceneDataset};
use nn::Init;
use serde::Deserialize;
use train::{DeviceConfig, find_checkpoint};
use vae::BevVae;

use crate::bev_vae::Experiment;
use crate::config_file;

/// Starts logging, runs a command and prints its error with every cause.
pub fn run_main(command: impl FnOnce() -> anyhow::Result<()>) -> ExitCode {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info,wgpu=warn,cubecl=warn,naga=warn"));
    tracing_subscriber::fmt().with_env_filter(filter).with_target(false).with_writer(std::io::stderr).init();
    ops::keep_freed_memory();
    match command() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // The reader of the message may be gone (a closed pipe); there is nobody left to tell.
            let _ = writeln!(std::io::stderr(), "error: {error:#}");
            if error.is::<UsageError>() { ExitCode::from(USAGE_EXIT) } else { ExitCode::FAILURE }
        }
    }
}

/// What the option parser exits with, too.
const USAGE_EXIT: u8 = 2;

/// A command that was asked for something that makes no sense, in options or config files. Exit code 2 instead of 1.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(String);

impl UsageError {
    pub(super) fn of(text: impl Into<String>) -> anyhow::Error {
        Self(text.into()).into()
    }

    /// The whole chain of causes as the complaint.
    pub(super) fn wrap(error: anyhow::Error) -> anyhow::Error {
        Self::of(format!("{error:#}"))
    }
}

/// Prints a line on standard output; a closed pipe ends the program quietly through the error.
pub(super) fn say(text: impl std::fmt::Display) -> anyhow::Result<()> {
    writeln!(std::io::stdout(), "{text}").context("cannot write to standard output")
}

/// Which data a command looks at.
#[derive(Debug, Clone, Args)]
pub struct DataArgs {
    /// TOML file with one or more `[[data]]` tables, as in an experiment's `[[data.train]]`
    #[arg(long, value_name = "FILE")]
    pub data: Option<PathBuf>,
    /// Root folder of a dataset in the nuScenes layout (the folder that holds `samples` and `v1.0-...`)
    #[arg(long, value_name = "DIR", conflicts_with = "data")]
    pub nuscenes: Option<PathBuf>,
    /// Name of the folder with the nuScenes tables [default: the only v1.0-... folder there]
    #[arg(long, value_name = "NAME", requires = "nuscenes")]
    pub version: Option<String>,
    /// Official nuScenes split, or `all`
    #[arg(long, value_name = "NAME", requires = "nuscenes", default_value = "all")]
    pub split: String,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct DataFile {
    data: Vec<DatasetConfig>,
}

impl DataArgs {
    /// The named datasets; none when no option was given.
    pub fn configs(&self) -> anyhow::Result<Vec<DatasetConfig>> {
        if let Some(file) = &self.data {
            return Ok(config_file::load::<DataFile>(file, &[])?.data);
        }
        let Some(root) = &self.nuscenes else { return Ok(Vec::new()) };
        let version = match &self.version {
            Some(version) => version.clone(),
            None => only_version(root)?,
        };
        let config = NuScenesConfig { split: self.split.clone(), ..NuScenesConfig::new(root, version) };
        Ok(vec![DatasetConfig::NuScenes(config)])
    }
}

pub(super) fn only_version(root: &Path) -> anyhow::Result<String> {
    let entries = std::fs::read_dir(root).with_context(|| format!("cannot list {}", root.display()))?;
    let mut versions: Vec<String> = entries
        .filter_map(|entry| Some(entry.ok()?.file_name().to_string_lossy().into_owned()))
        .filter(|name| name.starts_with("v1.0-"))
        .collect();
    versions.sort();
    match versions.as_slice() {
        [one] => Ok(one.clone()),
        [] => bail!("there is no v1.0-... folder; name the folder of the tables with --version: {}", root.display()),
        several => bail!("choose one of {} with --version: {}", several.join(", "), root.display()),
    }
}

/// Opens datasets in order.
pub(super) fn open_all(configs: &[DatasetConfig]) -> anyhow::Result<Vec<Arc<dyn SceneDataset>>> {
    configs.iter().map(|config| Ok(data::open(config)?)).collect()
}

/// A model with averaged weights out of a checkpoint, and the experiment it came from.
#[derive(Debug)]
pub struct LoadedModel {
    /// The experiment as it was resolved.
    pub experiment: Experiment,
    /// Averaged weights, no tape.
    pub model: BevVae,
    /// Where it computes.
    pub device: Device,
}

impl LoadedModel {
    /// Opens a checkpoint folder, or the newest checkpoint of a run folder.
    ///
    /// # Errors
    /// Names the folder or file that is missing or damaged.
    pub fn open(path: &Path, device: Option<DeviceConfig>) -> anyhow::Result<Self> {
        let reader = find_checkpoint(path)?;
        let text = reader.config_text("model")?;
        let experiment: Experiment = config_file::parse(&text, &[])
            .with_context(|| format!("in the config that the checkpoint carries: {}", reader.folder().display()))?;
        let device = device.unwrap_or(experiment.device).open()?;
        let model = BevVae::new(&experiment.model.config, &mut Init::new(0, &device));
        let model = reader.module("ema", model)?;
        tracing::info!(step = reader.state().step, checkpoint = %reader.folder().display(), "averaged weights loaded");
        Ok(Self { experiment, model, device })
    }

    /// The datasets asked for, or the experiment's held-out ones.
    pub fn datasets(&self, args: &DataArgs) -> anyhow::Result<Vec<Arc<dyn SceneDataset>>> {
        let asked = args.configs()?;
        let configs = if asked.is_empty() { &self.experiment.data.validation } else { &asked };
        if configs.is_empty() {
            return Err(UsageError::of(
                "the checkpoint names no held-out data; say which with --data FILE or --nuscenes DIR",
            ));
        }
        open_all(configs)
    }
}
