//! What every training command does around its task: options, data, run folder, loop.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, bail};
use burn::tensor::Device;
use clap::Args;
use data::{DatasetConfig, LoaderConfig, Mixture, SceneBatch, SceneDataset};
use serde::Serialize;
use serde::de::DeserializeOwned;
use train::{
    BatchSource, DeviceConfig, Interrupt, OnExisting, Outcome, RunDir, RunSetup, Task, TrainConfig, TrainError,
};

use super::common::{open_all, say};
use crate::LoaderSource;
use crate::bev_vae::{DataConfig, RunConfig};
use crate::config_file;

/// Options of every training command.
#[derive(Debug, Clone, Args)]
pub struct TrainArgs {
    /// Experiment file (TOML), for example one of configs/toy
    #[arg(long, value_name = "FILE")]
    pub config: PathBuf,
    /// Change one setting, for example `--set train.steps=200`; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub overrides: Vec<String>,
    /// Go on from the newest checkpoint of the run's folder
    #[arg(long)]
    pub resume: bool,
    /// Where to compute: flex, or a backend that was compiled in (ndarray, wgpu, vulkan, metal, cuda, rocm)
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
    /// Stop, saved and ready for --resume, after this many steps of the whole run
    #[arg(long, value_name = "STEPS")]
    pub stop_after: Option<u64>,
    /// Print the experiment with the defaults of all settings it leaves out, and stop
    #[arg(long)]
    pub print_config: bool,
}

/// What every experiment file has.
pub(super) trait TrainExperiment: Serialize + DeserializeOwned {
    fn seed(&self) -> u64;
    fn device(&mut self) -> &mut DeviceConfig;
    fn run(&self) -> &RunConfig;
    fn data(&self) -> &DataConfig;
    fn train(&self) -> &TrainConfig;
    fn loader(&self) -> LoaderConfig;

    /// Whether every run reads its datasets; one that may have all it needs from elsewhere opens them itself.
    const READS_DATASETS: bool = true;

    /// The experiment, if its settings go together.
    fn checked(self) -> anyhow::Result<Self> {
        Ok(self)
    }
}

/// Implements [`TrainExperiment`] for an experiment whose fields have the usual names; the second form checks it too, the third also
/// leaves the datasets closed.
macro_rules! train_experiment {
    ($type:ty $(, $checked:ident $(, $reads:literal)?)?) => {
        impl $crate::commands::training::TrainExperiment for $type {
            $($(const READS_DATASETS: bool = $reads;)?)?
            fn seed(&self) -> u64 {
                self.seed
            }
            fn device(&mut self) -> &mut train::DeviceConfig {
                &mut self.device
            }
            fn run(&self) -> &$crate::bev_vae::RunConfig {
                &self.run
            }
            fn data(&self) -> &$crate::bev_vae::DataConfig {
                &self.data
            }
            fn train(&self) -> &train::TrainConfig {
                &self.train
            }
            fn loader(&self) -> data::LoaderConfig {
                self.loader_config()
            }
            $(fn checked(self) -> anyhow::Result<Self> {
                Self::$checked(self)
            })?
        }
    };
}
pub(super) use train_experiment;

/// A run that is ready to start.
pub(super) struct Prepared<E> {
    pub experiment: E,
    pub training: Vec<Arc<dyn SceneDataset>>,
    pub validation: Vec<Arc<dyn SceneDataset>>,
    /// Without a tape.
    pub device: Device,
    pub run_dir: RunDir,
    text: String,
    interrupt: Interrupt,
}

/// The experiment as a run would take it.
fn read<E: TrainExperiment>(args: &TrainArgs) -> anyhow::Result<E> {
    let experiment: E = config_file::load(&args.config, &args.overrides)?;
    let mut experiment = experiment.checked().with_context(|| format!("in the config {}", args.config.display()))?;
    if let Some(device) = args.device {
        *experiment.device() = device;
    }
    Ok(experiment)
}

/// Prints the experiment as TOML with its defaults: a config again. Settings without a value are not listed.
pub(super) fn print_config<E: TrainExperiment>(args: &TrainArgs) -> anyhow::Result<()> {
    say(toml::to_string(&read::<E>(args)?).context("cannot write the resolved config")?.trim_end())
}

/// Reads the experiment, opens device and data, and makes the run's folder.
pub(super) fn prepare<E: TrainExperiment>(args: &TrainArgs) -> anyhow::Result<Prepared<E>> {
    let mut experiment: E = read(args)?;
    let data = experiment.data();
    if E::READS_DATASETS && (data.train.is_empty() || data.validation.is_empty()) {
        bail!("data.train and data.validation need at least one dataset each: {}", args.config.display());
    }
    let interrupt = Interrupt::listen()?;
    let device = experiment.device().open()?;
    let open = |place: &str, configs: &[DatasetConfig]| -> anyhow::Result<Vec<Arc<dyn SceneDataset>>> {
        if E::READS_DATASETS { open_all(configs).with_context(|| format!("in {place}")) } else { Ok(Vec::new()) }
    };
    let training = open("data.train", &experiment.data().train)?;
    let validation = open("data.validation", &experiment.data().validation)?;
    let text = toml::to_string(&experiment).context("cannot write the resolved config")?;
    let on_existing = if args.resume { OnExisting::Resume } else { OnExisting::NextFreeName };
    let run_dir = RunDir::create(&experiment.run().root, &experiment.run().name, on_existing)?;
    tracing::info!(folder = %run_dir.path().display(), "run");
    run_dir.write_config(&text, Path::new("."))?;
    Ok(Prepared { experiment, training, validation, device, run_dir, text, interrupt })
}

impl<E: TrainExperiment> Prepared<E> {
    /// Runs the loop to its end or to an interruption.
    pub fn train<T: Task<Batch = SceneBatch>>(&self, task: &mut T, args: &TrainArgs) -> anyhow::Result<Outcome> {
        let (loader, seed) = (self.experiment.loader(), self.experiment.seed());
        let mixture = &self.experiment.data().mixture;
        let mixture = Arc::new(Mixture::new(self.training.clone(), mixture, loader.batch_size, seed)?);
        self.train_from(task, |position| LoaderSource::open(mixture, loader, position), args)
    }

    /// The same on batches of any kind.
    pub fn train_from<T: Task, S: BatchSource<Batch = T::Batch>>(
        &self,
        task: &mut T,
        open_source: impl FnOnce(u64) -> Result<S, TrainError>,
        args: &TrainArgs,
    ) -> anyhow::Result<Outcome> {
        let setup = RunSetup {
            config: self.experiment.train(),
            run_dir: &self.run_dir,
            seed: self.experiment.seed(),
            config_text: &self.text,
            resume: args.resume,
            interrupt: self.interrupt.clone(),
            pause_after: args.stop_after,
        };
        Ok(train::train(task, open_source, &setup)?)
    }
}

/// Figures of the loop, as every `summary.json` holds them.
#[derive(Debug, Serialize)]
pub(super) struct LoopFigures {
    steps: u64,
    seconds: f64,
    images_per_second: f64,
    data_wait_fraction: f64,
    peak_rss_bytes: Option<u64>,
    device: String,
    seed: u64,
}

impl LoopFigures {
    /// Of a run that came to its end.
    pub fn of<E: TrainExperiment>(run: &mut Prepared<E>, outcome: &Outcome) -> Self {
        Self {
            steps: outcome.steps,
            seconds: outcome.seconds,
            images_per_second: outcome.images_per_second,
            data_wait_fraction: outcome.data_wait_fraction,
            peak_rss_bytes: outcome.peak_rss_bytes,
            device: run.experiment.device().to_string(),
            seed: run.experiment.seed(),
        }
    }
}

/// Writes `summary.json` into the run's folder.
pub(super) fn write_summary(run_dir: &RunDir, summary: &impl Serialize) -> anyhow::Result<()> {
    let path = run_dir.path().join("summary.json");
    let part = run_dir.path().join(".summary.json.part");
    std::fs::write(&part, serde_json::to_string_pretty(summary)?)
        .and_then(|()| std::fs::rename(&part, &path))
        .with_context(|| format!("cannot write {}", path.display()))
}

/// The last line of every run's table.
pub(super) fn loop_line(outcome: &Outcome) -> String {
    let memory = outcome.peak_rss_bytes.map_or_else(|| "unknown".to_owned(), |b| format!("{:.2} GB", b as f64 / 1e9));
    format!(
        "{} steps, {:.0} s, {:.1} images/s, {:.1} % waiting for data, peak memory {memory}",
        outcome.steps,
        outcome.seconds,
        outcome.images_per_second,
        outcome.data_wait_fraction * 100.0
    )
}
