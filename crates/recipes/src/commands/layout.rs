//! `rigscape layout`: layouts of boxes from frames and files: taken, edited, mixed, drawn and written.

use std::path::PathBuf;

use clap::{Args, Parser, ValueEnum};
use data::layout::{Layout, LayoutClasses, LayoutEdit, LayoutFile, LayoutSource};
use data::{FrameId, LocalMap, SceneFrame, View};
use geometry::{CameraRig, Rigid};

use super::common::{UsageError, say};
use super::frame_choice::FrameArgs;
use crate::rigs::{RIG_HELP, RigChoice};
use crate::sheet::save_picture;
use crate::show::{Layer, PageContent, PageOptions, draw_page};

/// Tables of classes by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ClassTable {
    /// The ten detection classes
    #[value(name = "nuscenes")]
    NuScenes,
    /// The thirty categories
    #[value(name = "argoverse2")]
    Argoverse2,
    /// What all datasets share, thirteen
    Shared,
}

impl ClassTable {
    /// The table.
    pub fn classes(self) -> LayoutClasses {
        match self {
            Self::NuScenes => LayoutClasses::nuscenes(),
            Self::Argoverse2 => LayoutClasses::argoverse2(),
            Self::Shared => LayoutClasses::shared(),
        }
    }
}

/// A layout: of a file or of a dataset's frame, with changes.
#[derive(Debug, Clone, Args)]
pub struct LayoutArgs {
    /// Layout file (JSON); without it, the boxes of a dataset's frame
    #[arg(long, value_name = "FILE", conflicts_with_all = ["index", "scene", "time", "config", "kind", "data", "nuscenes"])]
    pub layout: Option<PathBuf>,
    /// Frame whose boxes are meant
    #[command(flatten)]
    pub frame: FrameArgs,
    /// Change the layout; may be repeated: remove:car-3, move:car-3:dx=2,dy=-1,dyaw=15deg, rotate:car-3:yaw=0, resize:car-3:scale=1.2,
    /// add:car:x=15,y=-3, reclass:car-3:truck; car-* means every box whose id begins so
    #[arg(long = "edit", value_name = "EDIT")]
    pub edits: Vec<LayoutEdit>,
    /// Go towards another layout file, see --amount; after --edit
    #[arg(long, value_name = "FILE")]
    pub towards: Option<PathBuf>,
    /// How far to go, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, requires = "towards")]
    pub amount: f64,
}

/// A layout and what it was taken from.
#[derive(Debug)]
pub struct ChosenLayout {
    /// Before the changes of the command line.
    pub original: Layout,
    /// With all changes.
    pub layout: Layout,
    /// The frame behind it, where one was named, with its map.
    pub page: Option<PageContent>,
    /// Its name, for the file.
    pub source: Option<LayoutSource>,
}

impl LayoutArgs {
    /// Reads the layout and makes the changes.
    ///
    /// # Errors
    /// [`UsageError`] for options that name nothing and edits that cannot be made; unreadable files, naming them.
    pub fn open(&self, classes: &LayoutClasses, options: &PageOptions) -> anyhow::Result<ChosenLayout> {
        let mut chosen = match &self.layout {
            Some(path) => {
                let file = LayoutFile::read(path)?;
                let source = file.source.clone();
                let layout = file.layout(classes);
                let layout = layout.map_err(|why| data::DataError::Layout { why, path: path.clone() })?;
                ChosenLayout { original: layout.clone(), layout, page: None, source }
            }
            None => {
                let (dataset, index) = self.frame.open()?;
                let page = PageContent::read(&*dataset, index, options)?;
                let layout = Layout::of_frame(&page.frame, classes);
                let source = Some(LayoutSource::from(&page.frame.id));
                ChosenLayout { original: layout.clone(), layout, page: Some(page), source }
            }
        };
        let usage = |error: data::layout::LayoutError| UsageError::of(error.to_string());
        chosen.layout = chosen.layout.edited(&self.edits, classes).map_err(usage)?;
        if let Some(path) = &self.towards {
            let other = Layout::read(path, classes)?;
            chosen.layout = chosen.layout.interpolate(&other, self.amount).map_err(usage)?;
        }
        Ok(chosen)
    }
}

/// Take the boxes of a frame or a file, change them, write them as a layout file and draw them
#[derive(Debug, Parser)]
pub struct LayoutCommandArgs {
    /// Layout to begin with
    #[command(flatten)]
    pub layout: LayoutArgs,
    /// Classes that boxes may have; boxes of a frame without one are left out
    #[arg(long, value_enum, default_value = "nuscenes")]
    pub classes: ClassTable,
    /// Layout file to write (JSON), without edits: they are made
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Picture to write, .png or .jpg: the boxes over the frame's pictures and from above, with their ids
    #[arg(long, value_name = "FILE")]
    pub picture: Option<PathBuf>,
    /// Cameras of the picture of a layout file, which has none
    #[arg(long, value_name = "RIG", long_help = RIG_HELP, default_value = "nuscenes")]
    pub rig: RigChoice,
    /// How far the view from above reaches, metres
    #[arg(long, value_name = "M", default_value_t = 50.0)]
    pub range: f64,
    /// Width of the picture, px
    #[arg(long, value_name = "PX", default_value_t = 2400, value_parser = clap::value_parser!(u32).range(320..=20_000))]
    pub width: u32,
}

/// Runs the command.
///
/// # Errors
/// Unreadable data and layouts, naming the file; edits that cannot be made; unwritable output.
pub fn layout(args: &LayoutCommandArgs) -> anyhow::Result<()> {
    if !(args.range.is_finite() && args.range > 0.0) {
        return Err(UsageError::of(format!("--range {} is no distance", args.range)));
    }
    let layers = vec![Layer::Boxes, Layer::Map, Layer::Masks, Layer::Names];
    let options = PageOptions { width: args.width, range_m: args.range, layers };
    let chosen = args.layout.open(&args.classes.classes(), &options)?;
    if let Some(path) = &args.out {
        LayoutFile::of(&chosen.layout, chosen.source).write(path)?;
        say(format_args!("{} boxes written to {}", chosen.layout.boxes.len(), path.display()))?;
    }
    if let Some(path) = &args.picture {
        let rig = args.rig.open()?;
        let page = chosen.page.unwrap_or_else(|| blank_page(&rig));
        save_picture(&draw_page(with_layout(page, &chosen.layout), &options)?, path)?;
        say(format_args!("drawn in {}", path.display()))?;
    }
    if args.out.is_none() && args.picture.is_none() {
        for found in &chosen.layout.boxes {
            let [x, y, z] = found.shape.center.to_array();
            let [l, w, h] = found.shape.size.to_array();
            let yaw = found.shape.upright().yaw.to_degrees();
            let id = &found.id;
            say(format_args!(
                "{id:24} {:20} x {x:7.2}  y {y:7.2}  z {z:6.2}  {l:5.2} x {w:4.2} x {h:4.2} m  {yaw:7.1} deg",
                found.class
            ))?;
        }
    }
    Ok(())
}

/// The page with the layout's boxes, called by their ids, in place of the frame's.
pub(super) fn with_layout(mut page: PageContent, layout: &Layout) -> PageContent {
    let mut boxes = layout.annotations();
    for (drawn, found) in boxes.iter_mut().zip(&layout.boxes) {
        drawn.track.clone_from(&found.id);
    }
    page.frame.boxes = Some(boxes);
    page
}

/// A frame without pictures.
pub(super) fn blank_page(rig: &CameraRig) -> PageContent {
    let view = |camera| View::of_camera(camera, Rigid::IDENTITY);
    let frame = SceneFrame {
        id: FrameId { dataset: "layout".to_owned(), scene: "file".to_owned(), frame: "0".to_owned() },
        timestamp_ns: 0,
        world_from_ego: Rigid::IDENTITY,
        views: rig.cameras.iter().map(view).collect(),
        boxes: None,
        scene_text: None,
    };
    PageContent { frame, map: LocalMap::default(), occupancy: None, lacking: Vec::new() }
}
