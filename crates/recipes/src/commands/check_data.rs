//! `rigscape check-data`: everything that a training run would meet in its data, before it does.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Parser;
use data::{BatchMemory, CheckOptions, CheckReport, ImageSize, LoaderConfig, batch_memory, check_all};
use serde::Serialize;

use super::check_table;
use super::common::say;
use super::data_source::{DataSource, Named};

/// Read every frame of datasets, look at every picture, and say what is there, what is broken and what is odd
#[derive(Debug, Parser)]
#[command(after_help = "Exit code 0: training could start; 1: it could not; 2: wrong options or settings.")]
pub struct CheckDataArgs {
    /// What is checked
    #[command(flatten)]
    pub source: DataSource,
    /// Random pictures of each scene that are decoded completely; all others are checked for existence, size and end
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub images: usize,
    /// Frames of each scene whose map and occupancy labels are read
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub labels: usize,
    /// Seed of the choice of pictures
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Lines printed of each list; the JSON file holds all of them
    #[arg(long, value_name = "N", default_value_t = 20)]
    pub lines: usize,
    /// Picture side for the memory estimate where the file is no experiment, px
    #[arg(long, value_name = "PX", default_value_t = 256)]
    pub picture_side: u32,
    /// Also write everything that was found as JSON
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
}

/// What the JSON file holds.
#[derive(Debug, Serialize)]
struct Findings {
    could_train: bool,
    datasets: Vec<Found>,
    memory: Option<BatchMemory>,
}

/// One dataset: a report, or why it cannot be opened.
#[derive(Debug, Serialize)]
struct Found {
    place: String,
    error: Option<String>,
    report: Option<CheckReport>,
}

impl Found {
    fn is_sound(&self) -> bool {
        self.report.as_ref().is_some_and(CheckReport::could_train)
    }
}

/// Runs the command; ends in an error when training could not start.
///
/// # Errors
/// Datasets that cannot be opened, are empty or hold broken frames or files, after all of them have been listed.
pub fn check_data(args: &CheckDataArgs) -> anyhow::Result<()> {
    let chosen = args.source.choose()?;
    let mut datasets = Vec::new();
    for named in &chosen.datasets {
        let found = look(named, args);
        print(&found, args.lines)?;
        datasets.push(found);
    }
    let side = LoaderConfig { size: ImageSize::square(args.picture_side), ..LoaderConfig::default() };
    let memory = memory(&datasets, &chosen.loader.unwrap_or(side));
    for line in memory.iter().flat_map(check_table::memory) {
        say(line)?;
    }
    let findings = Findings { could_train: datasets.iter().all(Found::is_sound), datasets, memory };
    if let Some(path) = &args.json {
        write_json(&findings, path)?;
    }
    let broken = findings.datasets.iter().filter(|found| !found.is_sound()).count();
    if broken > 0 {
        bail!("training could not start: {broken} of {} datasets cannot be used as they are", findings.datasets.len());
    }
    say("training could start")
}

fn look(named: &Named, args: &CheckDataArgs) -> Found {
    let options = CheckOptions { decode: args.images, labels: args.labels, seed: args.seed };
    let mut last_percent = 0;
    let mut progress = |done: usize, total: usize| {
        let percent = done * 100 / total.max(1);
        // Small sets are done before anybody asks.
        if total >= 20 && percent >= last_percent + 10 {
            last_percent = percent;
            tracing::info!("{}: {percent} % of {total} scenes", named.place);
        }
    };
    let report = data::open(&named.config).map(|dataset| check_all(&*dataset, &options, &mut progress));
    let place = named.place.clone();
    match report {
        Ok(report) => Found { place, error: None, report: Some(report) },
        Err(error) => Found { place, error: Some(error.to_string()), report: None },
    }
}

fn print(found: &Found, most_lines: usize) -> anyhow::Result<()> {
    if let Some(error) = &found.error {
        return say(format_args!("{}: cannot be opened: {error}\n", found.place));
    }
    let lines = found.report.iter().flat_map(|report| check_table::report(&found.place, report, most_lines));
    lines.chain([String::new()]).try_for_each(say)
}

/// Batches mix all datasets, so the largest rig and picture count.
fn memory(datasets: &[Found], loader: &LoaderConfig) -> Option<BatchMemory> {
    let reports = || datasets.iter().filter_map(|found| found.report.as_ref());
    let views = reports().map(|report| report.max_views).max()?;
    let raw = reports().map(|report| report.largest_picture);
    let raw = raw.max_by_key(|(width, height)| u64::from(*width) * u64::from(*height))?;
    Some(batch_memory(loader, views, raw))
}

fn write_json(findings: &Findings, path: &Path) -> anyhow::Result<()> {
    let text = serde_json::to_string_pretty(findings)?;
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).with_context(|| format!("cannot make the folder {}", parent.display()))?;
    }
    std::fs::write(path, text).with_context(|| format!("cannot write {}", path.display()))
}
