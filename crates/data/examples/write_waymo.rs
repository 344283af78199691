//! Writes two scenes of the procedural world, seen by Waymo's cameras at a quarter of their size, in the layout of Waymo's second
//! release. `tests/peers/waymo_writer.py` checks the result with a library that is not ours.
//!
//! ```sh
//! cargo run --release -p data --example write_waymo -- /path/to/set
//! ```

use std::error::Error;
use std::path::PathBuf;

use data::{Procedural, ProceduralConfig, RigSource, SceneDataset, WaymoWriterConfig, write_waymo};
use geometry::{ImageEdit, RigPreset};

fn main() -> Result<(), Box<dyn Error>> {
    let out = PathBuf::from(std::env::args_os().nth(1).ok_or("give the folder to make")?);
    let mut rig = RigPreset::Waymo.rig();
    for camera in &mut rig.cameras {
        let raw = camera.intrinsics;
        let edit = ImageEdit::identity(raw.width, raw.height).resize(raw.width / 4, raw.height / 4);
        camera.intrinsics = edit.intrinsics(&raw);
    }
    let rig_file = tempfile::NamedTempFile::new()?;
    serde_json::to_writer(&rig_file, &rig)?;
    // Frames 100 ms apart, as the release has them.
    let world = world::WorldConfig { duration_secs: 2.0, ..world::WorldConfig::default() };
    let config = ProceduralConfig {
        seed: 1,
        scenes: 2,
        frames_per_scene: 20,
        rig: RigSource::File(rig_file.path().to_owned()),
        world,
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config)?;
    let frames = (0..dataset.len()).map(|index| dataset.frame(index)).collect::<Result<Vec<_>, _>>()?;
    let settings = WaymoWriterConfig { seed: Some(config.seed), ..WaymoWriterConfig::new(out) };
    write_waymo(&settings, &frames, &mut |_, _| {})?;
    Ok(())
}
