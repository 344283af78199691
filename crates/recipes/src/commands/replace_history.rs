//! `rigscape replace-history`: a nuScenes folder in which a share of the past frames shows generated pictures.

use std::path::PathBuf;

use clap::{Parser, ValueEnum};
use data::export::{HistoryConfig, LinkKind, replace_history as replace};
use data::nuscenes::{NuScenes, NuScenesConfig};

use super::common::{only_version, say};

/// Kinds of links by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Link {
    /// By name; works over file systems
    Symbolic,
    /// A second name of the same file; needs one file system
    Hard,
}

/// Link a nuScenes folder anew with generated pictures in place of a share of the past frames; nothing is copied, originals stay as they are
#[derive(Debug, Parser)]
pub struct ReplaceHistoryArgs {
    /// Folder of the real dataset (the one that holds `samples` and `v1.0-...`)
    #[arg(long, value_name = "DIR")]
    pub nuscenes: PathBuf,
    /// Folder that `rigscape synthesize --export nuscenes` made of the same frames
    #[arg(long, value_name = "DIR")]
    pub generated: PathBuf,
    /// Folder to make
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Name of the folder with the tables [default: the only v1.0-... folder of the real dataset]
    #[arg(long, value_name = "NAME")]
    pub version: Option<String>,
    /// Official split whose frames may be replaced, or `all`
    #[arg(long, value_name = "NAME", default_value = "all")]
    pub split: String,
    /// Probability that a past frame is replaced, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5)]
    pub share: f64,
    /// Which frames
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Kind of links
    #[arg(long, value_enum, default_value = "symbolic")]
    pub link: Link,
    /// Replace the folder if this tool made it
    #[arg(long)]
    pub force: bool,
}

/// Runs the command.
///
/// # Errors
/// Unreadable datasets, naming the file; generated frames that are missing; an output that exists.
pub fn replace_history(args: &ReplaceHistoryArgs) -> anyhow::Result<()> {
    let version = args.version.clone().map_or_else(|| only_version(&args.nuscenes), Ok)?;
    let open = |root: &PathBuf| {
        let config = NuScenesConfig { split: args.split.clone(), ..NuScenesConfig::new(root.clone(), &*version) };
        NuScenes::open(&config)
    };
    let link = match args.link {
        Link::Symbolic => LinkKind::Symbolic,
        Link::Hard => LinkKind::Hard,
    };
    let config = HistoryConfig { out: args.out.clone(), force: args.force, share: args.share, seed: args.seed, link };
    let manifest = replace(&open(&args.nuscenes)?, &open(&args.generated)?, &config)?;
    say(format_args!(
        "{} of {} past frames replaced; written to {}",
        manifest.replaced.len(),
        manifest.past_frames,
        args.out.display()
    ))
}
