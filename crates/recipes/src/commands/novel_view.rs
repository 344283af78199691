//! `rigscape novel-view`: decodes cameras that were not there: the rig turned, shifted, or another car's rig.

use std::path::PathBuf;

use clap::Parser;
use train::DeviceConfig;

use super::UsageError;
use super::common::{DataArgs, LoadedModel};
use super::pictures::PictureArgs;
use super::views::{Asked, MotionArgs, Views};
use crate::rigs::{RIG_HELP, RigChoice};

/// Encode frames and decode cameras that took no picture: the rig turned or shifted, or another car's rig
#[derive(Debug, Parser)]
pub struct NovelViewArgs {
    /// Run folder (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Where pictures go
    #[command(flatten)]
    pub pictures: PictureArgs,
    /// Turns and shifts of the own rig
    #[command(flatten)]
    pub motion: MotionArgs,
    /// Other cameras; the help text names the choices.
    #[arg(long, value_name = "RIG", help = format!("{RIG_HELP}; may be repeated"))]
    pub rig: Vec<RigChoice>,
    /// Data to encode [default: the experiment's held-out data]
    #[command(flatten)]
    pub data: DataArgs,
    /// Frames per dataset, spread evenly over it; 0 for all
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub frames: usize,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// Runs the command.
///
/// # Errors
/// Missing or damaged checkpoint, unreadable data, nothing asked for, unwritable output.
pub fn novel_view(args: &NovelViewArgs) -> anyhow::Result<()> {
    if args.motion.is_empty() && args.rig.is_empty() {
        return Err(UsageError::of("say which views: --yaw=-30,30, --shift=0,1,0 or --rig argoverse2"));
    }
    args.pictures.check()?;
    let others = args.rig.iter().map(|choice| Ok(Asked { name: choice.name(), rig: choice.open()? }));
    let others = others.collect::<anyhow::Result<Vec<Asked>>>()?;
    let loaded = LoadedModel::open(&args.checkpoint, args.device)?;
    let mut views = Views::new(&loaded, &args.pictures);
    for frame in views.viewer.frames(&loaded.datasets(&args.data)?, args.frames) {
        let frame = frame?;
        let mut asked = args.motion.of("own rig", &frame.rig());
        asked.extend(others.iter().cloned());
        views.add(&frame, &asked)?;
    }
    views.finish()
}
