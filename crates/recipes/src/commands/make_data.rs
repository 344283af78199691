//! `rigscape make-data`: writes the procedural world in a real dataset's layout.

use std::path::PathBuf;

use clap::{Parser, ValueEnum};
use data::{NuScenesWriterConfig, write_nuscenes};
use geometry::RigPreset;

use super::common::say;
use super::novel_view::parse_rig;

/// Layouts that can be written.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Format {
    /// Tables, pictures, map expansion and lidar key frames as nuScenes has them
    #[value(name = "nuscenes")]
    NuScenes,
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
    /// Annotated frames per scene, 2 per second
    #[arg(long, value_name = "N", default_value_t = 40)]
    pub key_frames: usize,
    /// Also write the pictures between key frames, 12 per second in all
    #[arg(long)]
    pub sweeps: bool,
    /// Seed of everything
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Cameras: nuscenes, argoverse2, waymo, ... (pinhole rigs only)
    #[arg(long, value_name = "RIG", value_parser = parse_rig, default_value = "nuscenes")]
    pub rig: RigPreset,
    /// Picture size, for example 800x450 [default: each camera's own]
    #[arg(long, value_name = "WxH", value_parser = parse_size)]
    pub size: Option<(u32, u32)>,
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

/// Runs the command.
///
/// # Errors
/// Settings that cannot be met, an output that exists, a file that cannot be written.
pub fn make_data(args: &MakeDataArgs) -> anyhow::Result<()> {
    let Format::NuScenes = args.format;
    let config = NuScenesWriterConfig {
        force: args.force,
        scenes: args.scenes,
        seed: args.seed,
        key_frames_per_scene: args.key_frames,
        sweeps: args.sweeps,
        image_size: args.size,
        jpeg_quality: args.quality,
        ..NuScenesWriterConfig::new(args.out.clone(), args.rig.rig())
    };
    let mut last_percent = 0;
    let manifest = write_nuscenes(&config, &mut |done, total| {
        let percent = done * 100 / total.max(1);
        if percent >= last_percent + 10 {
            last_percent = percent;
            tracing::info!("{percent} % of {total} files");
        }
    })?;
    let names: Vec<&str> = manifest.scenes.iter().map(|scene| scene.name.as_str()).collect();
    say(format_args!("{} written to {} (pictures: {})", names.join(", "), args.out.display(), manifest.pictures))
}
