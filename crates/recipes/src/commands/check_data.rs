//! `rigscape check-data`: lists everything that is missing or damaged before a training run meets it.

use std::path::PathBuf;

use anyhow::bail;
use clap::Parser;
use data::{DatasetConfig, ImageSize, PoseMode, Sample, SampleOptions};

use super::common::{DataArgs, say};
use crate::bev_vae::Experiment;
use crate::config_file;

/// Look at every file of the datasets of an experiment, or of one dataset, and list all that is missing or damaged
#[derive(Debug, Parser)]
pub struct CheckDataArgs {
    /// Experiment file whose training and held-out data are checked
    #[arg(long, value_name = "FILE", conflicts_with_all = ["data", "nuscenes"])]
    pub config: Option<PathBuf>,
    /// Data to check
    #[command(flatten)]
    pub data: DataArgs,
    /// Pictures of each scene that are decoded completely; all others are checked for existence, size and end
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub images: usize,
}

/// Runs the command; ends in an error when anything is wrong.
///
/// # Errors
/// Broken tables at once; missing or damaged pictures after all of them have been listed.
pub fn check_data(args: &CheckDataArgs) -> anyhow::Result<()> {
    let configs = match &args.config {
        Some(path) => {
            let experiment: Experiment = config_file::load(path, &[])?;
            [experiment.data.train, experiment.data.validation].concat()
        }
        None => args.data.configs()?,
    };
    if configs.is_empty() {
        bail!("say what to check: --config FILE, --nuscenes DIR or --data FILE");
    }
    let mut problems = 0;
    for config in &configs {
        problems += check(config, args.images)?;
    }
    if problems > 0 {
        bail!("{problems} problems");
    }
    say("everything is there")
}

fn check(config: &DatasetConfig, images: usize) -> anyhow::Result<usize> {
    let dataset = data::open(config)?;
    if let DatasetConfig::Procedural(settings) = config {
        let options = SampleOptions { size: ImageSize::square(16), pose_mode: PoseMode::default() };
        Sample::load(&dataset.frame(0)?, &options)?;
        say(format_args!("{}: {} frames, made when asked for", settings.name, dataset.len()))?;
        return Ok(0);
    }
    let report = data::check(&*dataset, images)?;
    say(format_args!(
        "{}: {} scenes, {} frames, {} pictures ({} decoded completely), {} views without a picture, {} missing, {} damaged",
        dataset.name(),
        report.scenes,
        report.frames,
        report.pictures,
        report.decoded,
        report.absent_views,
        report.missing(),
        report.damaged()
    ))?;
    for problem in &report.problems {
        say(format_args!("  {problem}"))?;
    }
    Ok(report.problems.len())
}
