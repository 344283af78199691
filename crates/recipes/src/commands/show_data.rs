//! `rigscape show-data`: a frame as a picture: all views with boxes, map and occupancy, and the same from above.

use std::path::PathBuf;

use clap::Parser;

use super::common::{UsageError, say};
use super::frame_choice::FrameArgs;
use crate::sheet::save_picture;
use crate::show::{Layer, PageContent, PageOptions, draw_page};

/// Draw a frame: every view in ring order with boxes, map and occupancy projected into it, and the same from above
#[derive(Debug, Parser)]
pub struct ShowDataArgs {
    /// Frame to show
    #[command(flatten)]
    pub frame: FrameArgs,
    /// Picture to write, .png or .jpg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Width of the picture, px
    #[arg(long, value_name = "PX", default_value_t = 2400, value_parser = clap::value_parser!(u32).range(320..=20_000))]
    pub width: u32,
    /// How far the view from above and the map reach, metres
    #[arg(long, value_name = "M", default_value_t = 50.0)]
    pub range: f64,
    /// What is drawn
    #[arg(long, value_name = "LIST", value_enum, value_delimiter = ',', default_value = "boxes,map,occupancy,masks")]
    pub layers: Vec<Layer>,
}

/// Runs the command.
///
/// # Errors
/// Unreadable data, naming the file; a frame that does not exist; unwritable output.
pub fn show_data(args: &ShowDataArgs) -> anyhow::Result<()> {
    if !(args.range.is_finite() && args.range > 0.0) {
        return Err(UsageError::of(format!("--range {} is no distance", args.range)));
    }
    let (dataset, index) = args.frame.open()?;
    let options = PageOptions { width: args.width, range_m: args.range, layers: args.layers.clone() };
    let content = PageContent::read(&*dataset, index, &options)?;
    let id = content.frame.id.clone();
    let boxes = content.frame.boxes.as_ref().map_or_else(|| "no".to_owned(), |boxes| boxes.len().to_string());
    let lines = content.map.lines.len();
    save_picture(&draw_page(content, &options)?, &args.out)?;
    say(format_args!(
        "frame {index} of {} ({} / {}): {boxes} boxes, {lines} map lines; written to {}",
        id.dataset,
        id.scene,
        id.frame,
        args.out.display()
    ))
}
