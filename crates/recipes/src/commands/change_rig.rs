//! `rigscape change-rig`: what one car saw, through the cameras of another (cross-rig decoding, BEV-VAE section 4.4).

use std::path::PathBuf;

use clap::Parser;
use train::DeviceConfig;

use super::common::{DataArgs, LoadedModel};
use super::pictures::PictureArgs;
use super::views::{Asked, MotionArgs, Views};
use crate::rigs::{RIG_HELP, RigChoice};

/// Encode what one car's cameras saw and decode it for the cameras of another car
#[derive(Debug, Parser)]
#[command(
    after_help = "Example:\n  rigscape change-rig --checkpoint runs/toy-vae --rig waymo --rig my_car.json --out sheet.png --pictures views"
)]
pub struct ChangeRigArgs {
    /// Run folder (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Other cameras; the help text names the choices.
    #[arg(long, value_name = "RIG", required = true, help = format!("{RIG_HELP}; may be repeated"))]
    pub rig: Vec<RigChoice>,
    /// Where pictures go
    #[command(flatten)]
    pub pictures: PictureArgs,
    /// Turns and shifts of the other rig, besides the rig as it is mounted
    #[command(flatten)]
    pub motion: MotionArgs,
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
/// An unusable rig, missing or damaged checkpoint, unreadable data, unwritable output.
pub fn change_rig(args: &ChangeRigArgs) -> anyhow::Result<()> {
    args.pictures.check()?;
    let mut asked = Vec::new();
    for choice in &args.rig {
        let (name, rig) = (choice.name(), choice.open()?);
        asked.push(Asked { name: name.clone(), rig: rig.clone() });
        asked.extend(args.motion.of(&name, &rig));
    }
    let loaded = LoadedModel::open(&args.checkpoint, args.device)?;
    let mut views = Views::new(&loaded, &args.pictures);
    for frame in views.viewer.frames(&loaded.datasets(&args.data)?, args.frames) {
        views.add(&frame?, &asked)?;
    }
    views.finish()
}
