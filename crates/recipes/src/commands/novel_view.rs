//! `rigscape novel-view`: decodes cameras that were not there: the rig turned, shifted, or another car's rig.

use std::path::PathBuf;

use anyhow::bail;
use clap::Parser;
use geometry::glam::DVec3;
use geometry::{CameraRig, RigPreset, Rigid};
use train::DeviceConfig;

use super::common::{DataArgs, LoadedModel, say};
use crate::bev_vae::{Viewer, pictures_of};
use crate::sheet::Sheet;

/// Encode frames and decode cameras that took no picture: the rig turned or shifted, or another car's rig
#[derive(Debug, Parser)]
pub struct NovelViewArgs {
    /// Run folder (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Contact sheet to write, .png or .jpg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Turns of the rig in degrees, left positive, for example --yaw=-30,30
    #[arg(long, value_name = "DEG", value_delimiter = ',', allow_hyphen_values = true)]
    pub yaw: Vec<f64>,
    /// Shift of the rig in metres as x,y,z (forward, left, up); may be repeated
    #[arg(long, value_name = "X,Y,Z", value_parser = parse_shift, allow_hyphen_values = true)]
    pub shift: Vec<DVec3>,
    /// Decode with the cameras of another car: nuscenes, argoverse2, nuplan, wayve_scenes101, waymo; may be repeated
    #[arg(long, value_name = "RIG", value_parser = parse_rig)]
    pub rig: Vec<RigPreset>,
    /// Data to encode [default: the experiment's held-out data]
    #[command(flatten)]
    pub data: DataArgs,
    /// Frames per dataset, spread evenly over it
    #[arg(long, value_name = "N", default_value_t = 2)]
    pub frames: usize,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

fn parse_shift(text: &str) -> Result<DVec3, String> {
    let numbers: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse::<f64>()).collect();
    match numbers.map_err(|e| e.to_string())?.as_slice() {
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => Ok(DVec3::new(*x, *y, *z)),
        _ => Err("write three finite numbers, x,y,z".to_owned()),
    }
}

pub(super) fn parse_rig(text: &str) -> Result<RigPreset, String> {
    let names: Vec<&str> = RigPreset::ALL.iter().map(|preset| preset.name()).collect();
    RigPreset::ALL
        .into_iter()
        .find(|preset| preset.name() == text)
        .ok_or_else(|| format!("there is no rig {text:?}, only {}", names.join(", ")))
}

/// Runs the command.
///
/// # Errors
/// Missing or damaged checkpoint, unreadable data, nothing asked for, unwritable output.
pub fn novel_view(args: &NovelViewArgs) -> anyhow::Result<()> {
    if args.yaw.is_empty() && args.shift.is_empty() && args.rig.is_empty() {
        bail!("say which views: --yaw=-30,30, --shift=0,1,0 or --rig argoverse2");
    }
    if let Some(bad) = args.yaw.iter().find(|yaw| !yaw.is_finite()) {
        bail!("--yaw {bad} is not an angle");
    }
    let loaded = LoadedModel::open(&args.checkpoint, args.device)?;
    let viewer = Viewer::new(&loaded.experiment, &loaded.model, &loaded.device);
    let size = loaded.experiment.image_size();
    let mut sheet = Sheet::new(size.height as usize, size.width as usize);
    let mut psnr = metrics::Psnr::default();
    for frame in viewer.frames(&loaded.datasets(&args.data)?, args.frames) {
        let frame = frame?;
        let coded = viewer.encode(&frame)?;
        sheet.row(coded.pictures());
        for rig in asked_rigs(args, &frame.rig()) {
            let decoded = viewer.decode(&coded, &viewer.cameras(&rig)?);
            sheet.row(decoded.iter().map(Vec::as_slice));
            if let Some(truth) = viewer.truth(&frame, &rig)? {
                for (picture, truth) in decoded.iter().zip(pictures_of(&truth)) {
                    psnr.update(picture, truth);
                }
                sheet.row(pictures_of(&truth));
            }
        }
        sheet.space();
    }
    sheet.save(&args.out)?;
    if let Some(db) = psnr.summary().mean_db {
        say(format_args!("PSNR {db:.2} dB against rendered truth over {} pictures", psnr.summary().images))?;
    }
    say(format_args!(
        "rows: input, then per asked rig the decoded views and, where it can be rendered, their truth; written to {}",
        args.out.display()
    ))
}

fn asked_rigs(args: &NovelViewArgs, own: &CameraRig) -> Vec<CameraRig> {
    let turned = args.yaw.iter().map(|yaw| own.rotated(yaw.to_radians()));
    let shifted = args.shift.iter().map(|shift| own.moved(&Rigid::from_yaw(0.0, *shift)));
    let others = args.rig.iter().map(|preset| preset.rig());
    turned.chain(shifted).chain(others).collect()
}
