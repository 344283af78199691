//! Writes a dataset in the WayveScenes101 layout: `write_wayvescenes OUT [SOURCE]`.
//!
//! With a source, a dataset in the same layout is read and written again; without one, two scenes of the procedural world are rendered
//! for the rig of WayveScenes101.

use std::path::{Path, PathBuf};

use data::wayvescenes::{WayveScenes, WayveScenesConfig};
use data::{
    DataError, Procedural, ProceduralConfig, RigSource, SceneDataset, SceneFrame, WayveScenesWriterConfig,
    write_wayvescenes,
};
use geometry::RigPreset;

const SCENES: usize = 2;
/// A second at the layout's 10 Hz.
const FRAMES: usize = 10;
const SCENE_SECS: usize = 20;

fn main() -> Result<(), DataError> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let usage = || DataError::Config("usage: write_wayvescenes OUT [SOURCE]".to_owned());
    let out = arguments.next().ok_or_else(usage)?;
    let frames = match arguments.next() {
        Some(source) => read(&source)?,
        None => made()?,
    };
    write_wayvescenes(&WayveScenesWriterConfig::new(out), &frames, &mut |_, _| {})?;
    Ok(())
}

fn read(source: &Path) -> Result<Vec<SceneFrame>, DataError> {
    let dataset = WayveScenes::open(&WayveScenesConfig::new(source))?;
    (0..dataset.len()).map(|index| dataset.frame(index)).collect()
}

fn made() -> Result<Vec<SceneFrame>, DataError> {
    let config = ProceduralConfig {
        scenes: SCENES,
        frames_per_scene: 10 * SCENE_SECS,
        rig: RigSource::Preset(RigPreset::WayveScenes101),
        world: world::WorldConfig { duration_secs: SCENE_SECS as f64, ..world::WorldConfig::default() },
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config)?;
    let starts = dataset.scene_ranges().into_iter().map(|range| range.start);
    starts.flat_map(|start| start..start + FRAMES).map(|index| dataset.frame(index)).collect()
}
