//! `rigscape sample`: paints the cameras of a rig from captions.

use std::path::PathBuf;

use anyhow::{Context, ensure};
use clap::Parser;
use data::{PadViews, Sample, SampleOptions, assemble};
use train::DeviceConfig;

use super::common::{DataArgs, open_all, say};
use crate::latent_diffusion::Painter;
use crate::sheet::Sheet;

/// Paint all cameras of a rig from captions with a model of train-unet: one row per caption
#[derive(Debug, Parser)]
pub struct SampleArgs {
    /// Run folder of train-unet (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// What to paint; may be repeated [default: the caption of the frame whose cameras are used]
    #[arg(long = "caption", value_name = "TEXT")]
    pub captions: Vec<String>,
    /// Contact sheet to write, .png or .jpg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Data whose first frame lends its cameras [default: the experiment's held-out data]
    #[command(flatten)]
    pub data: DataArgs,
    /// Another number paints another picture of the same caption
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// How strongly the caption guides, 1 for not at all [default: as the experiment says]
    #[arg(long, value_name = "SCALE")]
    pub guidance: Option<f64>,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// Runs the command.
///
/// # Errors
/// Missing or damaged checkpoint, unreadable data, unwritable output.
pub fn sample(args: &SampleArgs) -> anyhow::Result<()> {
    let mut painter = Painter::open(&args.checkpoint, args.device)?;
    if let Some(guidance) = args.guidance {
        ensure!(guidance.is_finite(), "--guidance {guidance}: needs a number");
        painter.experiment.sampling.guidance = guidance;
    }
    let asked = args.data.configs()?;
    let datasets = open_all(if asked.is_empty() { &painter.experiment.data.validation } else { &asked })?;
    let dataset = datasets.first().context("there is no dataset to take cameras from")?;
    let frame = dataset.frame(0)?;
    let captions = if args.captions.is_empty() { vec![frame.caption()] } else { args.captions.clone() };
    let options = SampleOptions { size: painter.experiment.image, pose_mode: painter.experiment.data.loader.pose_mode };
    let batch = assemble(vec![Sample::load(&frame, &options)?], PadViews::Largest)?;
    let mut sheet = Sheet::new(options.size.height as usize, options.size.width as usize);
    for caption in &captions {
        sheet.row(painter.paint(caption, &batch, args.seed)?.iter().map(Vec::as_slice));
    }
    sheet.save(&args.out)?;
    say(format_args!("{} captions, {} cameras: {}", captions.len(), frame.views.len(), args.out.display()))
}
