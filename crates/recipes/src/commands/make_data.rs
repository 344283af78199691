//! `rigscape make-data`: writes the procedural world in a real dataset's layout.

use std::path::PathBuf;

use anyhow::bail;
use clap::{Parser, ValueEnum};
use data::{
    Argoverse2Log, Argoverse2WriterConfig, NuPlanWriterConfig, NuScenesWriterConfig, Procedural, ProceduralConfig,
    RigSource, SceneDataset, SceneFrame, WaymoWriterConfig, WayveScenesWriterConfig, write_argoverse2, write_nuplan,
    write_nuscenes, write_waymo, write_wayvescenes,
};
use geometry::{CameraRig, ImageEdit, RigPreset};

use super::common::say;
use crate::rigs::{RIG_HELP, RigChoice};

/// Frames of the layouts without key frames follow each other in this time.
const STEP_SECS: f64 = 0.1;

/// Layouts that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Tables, pictures, map expansion and lidar key frames as nuScenes has them
    #[value(name = "nuscenes")]
    NuScenes,
    /// Logs of the Argoverse 2 sensor dataset with boxes, map, ground height and a coarse lidar
    #[value(name = "argoverse2")]
    Argoverse2,
    /// nuPlan databases with pictures and boxes
    #[value(name = "nuplan")]
    NuPlan,
    /// COLMAP models and fisheye pictures as WayveScenes101 has them
    #[value(name = "wayve_scenes101")]
    WayveScenes101,
    /// Parquet tables of Waymo's second release
    #[value(name = "waymo")]
    Waymo,
}

impl Format {
    fn rig(self) -> RigPreset {
        match self {
            Self::NuScenes => RigPreset::NuScenes,
            Self::Argoverse2 => RigPreset::Argoverse2,
            Self::NuPlan => RigPreset::NuPlan,
            Self::WayveScenes101 => RigPreset::WayveScenes101,
            Self::Waymo => RigPreset::Waymo,
        }
    }
}

/// Write scenes of the procedural world as a dataset that the official tools load
#[derive(Debug, Parser)]
pub struct MakeDataArgs {
    /// Layout
    #[arg(long, value_enum)]
    pub format: Format,
    /// Folder to make
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Scenes, each a world of its own
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub scenes: usize,
    /// Annotated frames per scene, 2 per second for nuscenes, 10 for the others
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub key_frames: usize,
    /// Also write the pictures between key frames, 12 per second in all (nuscenes)
    #[arg(long)]
    pub sweeps: bool,
    /// Seed of everything
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Other cameras; the help text names the choices.
    #[arg(long, value_name = "RIG", help = format!("{RIG_HELP}; pinhole rigs only, --format nuscenes only [default: the layout's own]"))]
    pub rig: Option<RigChoice>,
    /// Size of all pictures, for example 800x450 (nuscenes) [default: each camera's own]
    #[arg(long, value_name = "WxH", value_parser = parse_size, conflicts_with = "scale")]
    pub size: Option<(u32, u32)>,
    /// Picture size as a share of each camera's own, above 0 to 1
    #[arg(long, value_name = "SHARE", value_parser = parse_scale)]
    pub scale: Option<f64>,
    /// JPEG quality, 1 to 100
    #[arg(long, value_name = "N", default_value_t = 95, value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: u8,
    /// Replace the folder if this tool made it
    #[arg(long)]
    pub force: bool,
}

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    parsed.filter(|(w, h)| *w > 0 && *h > 0).ok_or_else(|| "write width x height, for example 800x450".to_owned())
}

fn parse_scale(text: &str) -> Result<f64, String> {
    let parsed = text.parse().ok().filter(|scale| *scale > 0.0 && *scale <= 1.0);
    parsed.ok_or_else(|| "write a number above 0 and up to 1, for example 0.25".to_owned())
}

/// Runs the command.
///
/// # Errors
/// Settings that cannot be met, an output that exists, a file that cannot be written.
pub fn make_data(args: &MakeDataArgs) -> anyhow::Result<()> {
    let mut last_percent = 0;
    let mut progress = |done: usize, total: usize| {
        let percent = done * 100 / total.max(1);
        if percent >= last_percent + 10 {
            last_percent = percent;
            tracing::info!("{percent} % of {total} files");
        }
    };
    if args.format == Format::NuScenes {
        return make_nuscenes(args, &mut progress);
    }
    for (option, given) in [("--rig", args.rig.is_some()), ("--size", args.size.is_some()), ("--sweeps", args.sweeps)] {
        if given {
            bail!("{option} goes with --format nuscenes only; other layouts have their own cameras, see --scale");
        }
    }
    let dataset = world_of(args)?;
    let frames = || (0..dataset.len()).map(|index| dataset.frame(index)).collect::<Result<Vec<SceneFrame>, _>>();
    let (out, force, jpeg_quality) = (args.out.clone(), args.force, args.quality);
    match args.format {
        Format::NuScenes => {}
        Format::Argoverse2 => {
            let split = data::argoverse2::Split::Train;
            let logs = (0..args.scenes).map(|scene| Argoverse2Log::of_procedural(&dataset, scene, split));
            let logs = logs.collect::<Result<Vec<_>, _>>()?;
            let source = format!("procedural world, seed {}", args.seed);
            let config = Argoverse2WriterConfig { force, jpeg_quality, ..Argoverse2WriterConfig::new(out, source) };
            write_argoverse2(&Argoverse2WriterConfig { lidar_columns: 360, ..config }, &logs, &mut progress)?;
        }
        Format::NuPlan => {
            let config = NuPlanWriterConfig { force, jpeg_quality, seed: args.seed, ..NuPlanWriterConfig::new(out) };
            write_nuplan(&frames()?, &config, &mut progress)?;
        }
        Format::WayveScenes101 => {
            let config = WayveScenesWriterConfig { force, jpeg_quality, ..WayveScenesWriterConfig::new(out) };
            write_wayvescenes(&config, &frames()?, &mut progress)?;
        }
        Format::Waymo => {
            let seed = Some(args.seed);
            let config = WaymoWriterConfig { force, jpeg_quality, seed, ..WaymoWriterConfig::new(out) };
            write_waymo(&config, &frames()?, &mut progress)?;
        }
    }
    say(format_args!("{} scenes of {} frames written to {}", args.scenes, args.key_frames, args.out.display()))
}

fn make_nuscenes(args: &MakeDataArgs, progress: &mut dyn FnMut(usize, usize)) -> anyhow::Result<()> {
    let config = NuScenesWriterConfig {
        force: args.force,
        scenes: args.scenes,
        seed: args.seed,
        key_frames_per_scene: args.key_frames,
        sweeps: args.sweeps,
        image_size: args.size,
        jpeg_quality: args.quality,
        ..NuScenesWriterConfig::new(args.out.clone(), rig(args)?)
    };
    let manifest = write_nuscenes(&config, progress)?;
    let names: Vec<&str> = manifest.scenes.iter().map(|scene| scene.name.as_str()).collect();
    say(format_args!("{} written to {} (pictures: {})", names.join(", "), args.out.display(), manifest.pictures))
}

fn rig(args: &MakeDataArgs) -> anyhow::Result<CameraRig> {
    let choice = args.rig.clone().unwrap_or(RigChoice::BuiltIn(args.format.rig()));
    let mut rig = choice.open()?;
    if let Some(scale) = args.scale {
        for camera in &mut rig.cameras {
            let raw = camera.intrinsics;
            let side = |pixels: u32| ((f64::from(pixels) * scale).round() as u32).max(1);
            let edit = ImageEdit::identity(raw.width, raw.height).resize(side(raw.width), side(raw.height));
            camera.intrinsics = edit.intrinsics(&raw);
        }
    }
    Ok(rig)
}

fn world_of(args: &MakeDataArgs) -> anyhow::Result<Procedural> {
    let mut config = ProceduralConfig {
        seed: args.seed,
        scenes: args.scenes,
        frames_per_scene: args.key_frames,
        rig: RigSource::Cameras(rig(args)?),
        ..ProceduralConfig::default()
    };
    config.world.duration_secs = STEP_SECS * args.key_frames as f64;
    Ok(Procedural::open(&config)?)
}
