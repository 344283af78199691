//! Writes procedural scenes in the Argoverse 2 layout, for a look with the official package (see `tests/peers/README.md`).
//!
//!     cargo run --release -p data --example write_argoverse2 -- DIR [SCENES] [FRAMES] [IMAGE_SCALE]

use std::error::Error;
use std::path::PathBuf;

use data::argoverse2::Split;
use data::{Argoverse2Log, Argoverse2WriterConfig, Procedural, ProceduralConfig, RigSource, write_argoverse2};
use geometry::RigPreset;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = PathBuf::from(arguments.next().ok_or("name the folder to make")?);
    let mut number = |default: f64| arguments.next().map_or(Ok(default), |text| text.parse::<f64>());
    let (scenes, frames, image_scale) = (number(2.0)? as usize, number(8.0)? as usize, number(0.25)?);
    let mut config = ProceduralConfig {
        scenes,
        frames_per_scene: frames,
        rig: RigSource::Preset(RigPreset::Argoverse2),
        ..ProceduralConfig::default()
    };
    // 10 Hz, as the lidar of the release.
    config.world.duration_secs = 0.1 * frames as f64;
    let dataset = Procedural::open(&config)?;
    let split = |scene: usize| if scene + 1 < scenes || scenes == 1 { Split::Train } else { Split::Val };
    let logs = (0..scenes).map(|scene| Argoverse2Log::of_procedural(&dataset, scene, split(scene)));
    let logs: Vec<Argoverse2Log> = logs.collect::<Result<_, _>>()?;
    let writer = Argoverse2WriterConfig {
        image_scale,
        lidar_columns: 360,
        ..Argoverse2WriterConfig::new(out, format!("procedural world, seed {}", config.seed))
    };
    write_argoverse2(&writer, &logs, &mut |_, _| {})?;
    Ok(())
}
