//! `rigscape synthesize`: pictures of any rig from a layout of boxes; of a whole dataset with `--export`.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::{Parser, ValueEnum};
use geometry::{CameraRig, RigPreset};
use train::DeviceConfig;

use data::export::Shard;

use super::common::{UsageError, say};
use super::layout::{ChosenLayout, LayoutArgs, blank_page, with_layout};
use super::synthesize_dataset;
use crate::evaluate::write_file;
use crate::rigs::{RIG_HELP, RigChoice};
use crate::sheet::{Sheet, save_picture};
use crate::show::{Layer, PageContent, PageOptions, draw_page};
use crate::synthesis::{SamplingArgs, Synthesiser, cameras_of};
use data::layout::{Layout, LayoutFile};

use crate::dit::NoiseKey;

/// Layouts that an export can have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ExportName {
    /// Tables of nuScenes; those of the source itself where it is one and keeps its cameras and boxes
    #[value(name = "nuscenes")]
    NuScenes,
    /// Logs of the Argoverse 2 sensor dataset
    #[value(name = "argoverse2")]
    Argoverse2,
}

/// Paint the pictures of a rig from a layout of 3D boxes, or with --export those of every frame of a dataset from its own boxes
#[derive(Debug, Parser)]
pub struct SynthesizeArgs {
    /// Run folder of train-dit (its newest checkpoint) or checkpoint folder
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Run folder or checkpoint of the autoencoder [default: where it was during training]
    #[arg(long, value_name = "DIR")]
    pub autoencoder: Option<PathBuf>,
    /// Layout to paint; the dataset of these options is the one that --export paints
    #[command(flatten)]
    pub layout: LayoutArgs,
    /// Paint the way from one layout file to another with equal noise, in --stops pictures
    #[arg(long, num_args = 2, value_names = ["A", "B"], conflicts_with_all = ["layout", "edits", "towards", "export"])]
    pub interpolate: Vec<PathBuf>,
    /// Layouts on the way of --interpolate, both ends included
    #[arg(long, value_name = "N", default_value_t = 5, value_parser = clap::value_parser!(u16).range(2..=1000), requires = "interpolate")]
    pub stops: u16,
    /// Folder to make
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Cameras; may be repeated [default: the frame's own, else nuscenes]
    #[arg(long, value_name = "RIG", long_help = RIG_HELP)]
    pub rig: Vec<RigChoice>,
    /// Seed of the noise; equal seeds give equal noise whatever the layout and the cameras
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Samples of the layout, each with its own noise
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=1000))]
    pub count: u16,
    /// How samples are made
    #[command(flatten)]
    pub sampling: SamplingArgs,
    /// Write every frame of the dataset in this layout instead, with cameras, the boxes as annotations and a manifest; goes on where an
    /// interrupted run stood
    #[arg(long, value_enum, conflicts_with_all = ["layout", "index", "scene", "time", "count", "towards"])]
    pub export: Option<ExportName>,
    /// Part of the frames that this run paints, for example 1/4; the run that finishes the last part makes the folder
    #[arg(long, value_name = "I/N", requires = "export", default_value = "1/1")]
    pub shard: Shard,
    /// JPEG quality of an export, 1 to 100
    #[arg(long, value_name = "N", default_value_t = 95, requires = "export", value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: u8,
    /// Replace the folder if this tool made it
    #[arg(long)]
    pub force: bool,
    /// Where to compute [default: as the run was trained]
    #[arg(long, value_name = "NAME")]
    pub device: Option<DeviceConfig>,
}

/// Runs the command.
///
/// # Errors
/// Names the option, file or box that is at fault.
pub fn synthesize(args: &SynthesizeArgs) -> anyhow::Result<()> {
    if args.export.is_none() {
        check_folder(&args.out, args.force)?;
    }
    let synthesiser = Synthesiser::open(&args.checkpoint, args.autoencoder.as_deref(), &args.sampling, args.device)?;
    match args.export {
        Some(name) => synthesize_dataset::export_dataset(args, name, &synthesiser),
        None => paint_layouts(args, &synthesiser),
    }
}

/// Present in every folder that this command made.
const MANIFEST: &str = "synthesis.json";

fn check_folder(out: &Path, force: bool) -> anyhow::Result<()> {
    let is_empty = std::fs::read_dir(out).map_or(true, |mut entries| entries.next().is_none());
    if (out.is_dir() && is_empty) || !out.exists() {
        return Ok(());
    }
    let shown = out.display();
    if !out.join(MANIFEST).is_file() {
        return Err(UsageError::of(format!(
            "--out holds something that this command did not make; choose another folder: {shown}"
        )));
    }
    if !force {
        return Err(UsageError::of(format!("--out exists already; choose another folder or add --force: {shown}")));
    }
    Ok(())
}

/// A layout to paint under a name.
struct Named {
    name: String,
    layout: Layout,
}

fn paint_layouts(args: &SynthesizeArgs, synthesiser: &Synthesiser) -> anyhow::Result<()> {
    let grid = &synthesiser.dit.conditioner.grid;
    let range_m = grid.x_range.iter().chain(&grid.y_range).fold(0f64, |most, end| most.max(end.abs()));
    let layers = vec![Layer::Boxes, Layer::Map, Layer::Names];
    let options = PageOptions { width: 2000, range_m, layers };
    let (named, page, token) = layouts(args, synthesiser, &options)?;
    if args.force && args.out.exists() {
        std::fs::remove_dir_all(&args.out).with_context(|| format!("cannot replace {}", args.out.display()))?;
    }
    // First, so that a run that was interrupted can be replaced.
    let words: Vec<String> = args.layout.edits.iter().map(ToString::to_string).collect();
    let manifest = synthesiser.generator(args.seed, token.clone(), words)?;
    write_file(&args.out.join(MANIFEST), &serde_json::to_vec_pretty(&manifest)?)?;
    for named in &named {
        LayoutFile::of(&named.layout, None).write(&args.out.join(format!("{}.json", named.name)))?;
    }
    for (rig_name, rig) in rigs(args, page.as_ref(), synthesiser)? {
        let size = synthesiser.vae.image_size();
        let mut sheet = Sheet::new(size.height as usize, size.width as usize);
        for draw in 0..args.count {
            let key = NoiseKey { seed: args.seed, token: token.clone(), draw: u64::from(draw) };
            for Named { name, layout } in &named {
                let pictures = synthesiser.pictures(synthesiser.latent(layout, &key)?, &rig)?;
                let folder = args.out.join(&rig_name).join(format!("{name}-{draw:03}"));
                for (camera, picture) in rig.cameras.iter().zip(&pictures) {
                    save_picture(picture, &folder.join(format!("{}.png", camera.channel)))?;
                }
                sheet.row_of(pictures.clone());
                let page = painted_page(page.as_ref(), &rig, pictures);
                let drawn = draw_page(with_layout(page, layout), &options)?;
                save_picture(&drawn, &folder.with_extension("png"))?;
                tracing::info!(rig = rig_name, layout = name, sample = draw, "painted");
            }
            sheet.space();
        }
        sheet.save(&args.out.join(format!("{rig_name}.png")))?;
    }
    say(format_args!(
        "{} layouts, {} samples each, guidance {}: {}",
        named.len(),
        args.count,
        synthesiser.guidance.scale(),
        args.out.display()
    ))
}

/// The layouts by name, the frame behind them, and the name that the noise follows from.
fn layouts(
    args: &SynthesizeArgs,
    synthesiser: &Synthesiser,
    options: &PageOptions,
) -> anyhow::Result<(Vec<Named>, Option<PageContent>, String)> {
    let classes = &synthesiser.dit.conditioner.classes;
    if let [a, b] = args.interpolate.as_slice() {
        let (a, b) = (Layout::read(a, classes)?, Layout::read(b, classes)?);
        let last = args.stops.saturating_sub(1).max(1);
        let at = |stop: u16| {
            let layout = a.interpolate(&b, f64::from(stop) / f64::from(last))?;
            Ok(Named { name: format!("stop-{stop:03}"), layout })
        };
        return Ok(((0..args.stops).map(at).collect::<anyhow::Result<_>>()?, None, "interpolation".to_owned()));
    }
    let ChosenLayout { original, layout, page, source } = args.layout.open(classes, options)?;
    let token = source.map_or_else(|| "layout".to_owned(), |id| format!("{}/{}/{}", id.dataset, id.scene, id.frame));
    let changed = layout != original;
    let mut named = vec![Named { name: if changed { "before" } else { "layout" }.to_owned(), layout: original }];
    if changed {
        named.push(Named { name: "after".to_owned(), layout });
    }
    Ok((named, page, token))
}

fn rigs(
    args: &SynthesizeArgs,
    page: Option<&PageContent>,
    synthesiser: &Synthesiser,
) -> anyhow::Result<Vec<(String, CameraRig)>> {
    if !args.rig.is_empty() {
        return args.rig.iter().map(|choice| Ok((choice.name(), choice.open()?))).collect();
    }
    match page {
        Some(page) => Ok(vec![("frame".to_owned(), cameras_of(&page.frame, synthesiser.pose_mode()))]),
        None => Ok(vec![(RigPreset::NuScenes.name().to_owned(), RigPreset::NuScenes.rig())]),
    }
}

/// The page of a frame, or of none, with painted pictures of a rig.
fn painted_page(page: Option<&PageContent>, rig: &CameraRig, pictures: Vec<image::RgbImage>) -> PageContent {
    let mut painted = blank_page(rig);
    if let Some(page) = page {
        painted.map.clone_from(&page.map);
        painted.frame.id.clone_from(&page.frame.id);
    }
    for (view, picture) in painted.frame.views.iter_mut().zip(pictures) {
        *view = view.with_picture(picture);
    }
    painted
}
