//! `rigscape show-data`: a frame as a picture: all views with boxes, map and occupancy, and the same from above.

use std::path::PathBuf;

use clap::Parser;
use data::SceneDataset;

use super::common::{UsageError, say};
use super::data_source::DataSource;
use crate::sheet::save_picture;
use crate::show::{Layer, PageContent, PageOptions, draw_page};

/// Draw a frame: every view in ring order with boxes, map and occupancy projected into it, and the same from above
#[derive(Debug, Parser)]
pub struct ShowDataArgs {
    /// Data to show
    #[command(flatten)]
    pub source: DataSource,
    /// Picture to write, .png or .jpg
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// Which of several datasets, counted from 0 in the file's order
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub dataset: usize,
    /// Frame, counted from 0 over all scenes, or within --scene
    #[arg(long, value_name = "N", conflicts_with = "time")]
    pub index: Option<usize>,
    /// Scene by name
    #[arg(long, value_name = "NAME")]
    pub scene: Option<String>,
    /// The frame nearest to this time after the scene's first frame, seconds [default scene: the first]
    #[arg(long, value_name = "SECS")]
    pub time: Option<f64>,
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
    let chosen = args.source.choose()?;
    let Some(named) = chosen.datasets.get(args.dataset) else {
        let text = format!("there is no dataset {}, only {}", args.dataset, chosen.datasets.len());
        return Err(UsageError::of(text));
    };
    let dataset = data::open(&named.config)?;
    let index = find(&*dataset, args)?;
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

/// The index of the frame that the options name.
fn find(dataset: &dyn SceneDataset, args: &ShowDataArgs) -> anyhow::Result<usize> {
    let mut range = 0..dataset.len();
    if let Some(name) = &args.scene {
        let mut known = Vec::new();
        let mut found = None;
        for scene in dataset.scene_ranges().into_iter().filter(|scene| !scene.is_empty()) {
            let id = dataset.frame(scene.start)?.id;
            if id.scene == *name {
                found = Some(scene);
                break;
            }
            known.push(id.scene);
        }
        range = found.ok_or_else(|| {
            let first: Vec<&str> = known.iter().take(20).map(String::as_str).collect();
            UsageError::of(format!("no scene is called {name:?}; the first are {}", first.join(", ")))
        })?;
    } else if args.time.is_some() {
        range = dataset.scene_ranges().into_iter().next().unwrap_or(0..0);
    }
    if range.is_empty() {
        return Err(UsageError::of(format!("{} has no frames", dataset.name())));
    }
    let Some(seconds) = args.time else {
        let index = args.index.unwrap_or(0);
        return range.clone().nth(index).ok_or_else(|| {
            UsageError::of(format!("there is no frame {index}, only {} (counted from 0)", range.len()))
        });
    };
    nearest(dataset, range, seconds)
}

fn nearest(dataset: &dyn SceneDataset, range: std::ops::Range<usize>, seconds: f64) -> anyhow::Result<usize> {
    let start_ns = dataset.frame(range.start)?.timestamp_ns;
    let mut best = (f64::INFINITY, range.start);
    for index in range {
        let after = (dataset.frame(index)?.timestamp_ns - start_ns) as f64 * 1e-9;
        let distance = (after - seconds).abs();
        if distance < best.0 {
            best = (distance, index);
        }
    }
    Ok(best.1)
}
