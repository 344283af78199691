//! `rigscape reconstruct`: encodes frames and decodes the same cameras.

use std::path::PathBuf;

use clap::Parser;
use train::DeviceConfig;

use super::UsageError;
use super::common::{DataArgs, LoadedModel, say};
use super::pictures::PictureArgs;
use crate::bev_vae::{PresentView, Viewer};
use crate::sheet::Sheet;

/// Encode frames of a dataset and decode the same cameras: input over reconstruction, one pair of rows per frame
#[derive(Debug, Parser)]
pub struct ReconstructArgs {
    /// Run folder (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Where pictures go
    #[command(flatten)]
    pub pictures: PictureArgs,
    /// Data to encode [default: the experiment's held-out data]
    #[command(flatten)]
    pub data: DataArgs,
    /// Frames per dataset, spread evenly over it; 0 for all
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub frames: usize,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// Runs the command.
///
/// # Errors
/// Missing or damaged checkpoint, unreadable data, unwritable output.
pub fn reconstruct(args: &ReconstructArgs) -> anyhow::Result<()> {
    args.pictures.check()?;
    let loaded = LoadedModel::open(&args.checkpoint, args.device)?;
    let viewer = Viewer::new(&loaded.experiment, &loaded.model, &loaded.device);
    let size = loaded.experiment.image_size();
    let mut sheet = Sheet::new(size.height as usize, size.width as usize);
    let mut psnr = metrics::Psnr::default();
    for frame in viewer.frames(&loaded.datasets(&args.data)?, args.frames) {
        let frame = frame?;
        let coded = viewer.encode(&frame)?;
        let decoded = viewer.decode(&coded, coded.input());
        for PresentView { view, picture, counted, .. } in coded.present() {
            psnr.update_where(&decoded[view], picture, counted);
        }
        args.pictures.save("reconstruction", &frame, &frame.rig(), &decoded, size)?;
        sheet.row(coded.pictures());
        sheet.row(decoded.iter().map(Vec::as_slice));
        sheet.space();
    }
    let Some(db) = psnr.summary().mean_db else {
        return Err(UsageError::of("there is no picture to reconstruct; --frames and the data's split say which"));
    };
    sheet.save(&args.pictures.out)?;
    say(format_args!("PSNR {db:.2} dB over {} pictures", psnr.summary().images))?;
    say(format_args!("rows: input, reconstruction; written to {}", args.pictures.out.display()))
}
