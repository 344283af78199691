//! Small datasets in the layout, written from the procedural world.

use std::path::Path;

use data::{
    Procedural, ProceduralConfig, RigSource, SceneDataset, SceneFrame, WayveScenesManifest, WayveScenesWriterConfig,
    write_wayvescenes,
};
use geometry::RigPreset;

pub const TEXT: &str = "Rainy, Night, Same direction Vehicle Traffic, Urban, Pedestrian on sidewalk";
pub const SCENES: usize = 2;
pub const FRAMES: usize = 4;
const STEP_NS: i64 = 100_000_000;

/// The first frames of each scene of the procedural world at 10 Hz, pictures shrunk.
pub fn frames(rig: RigPreset) -> Vec<SceneFrame> {
    let per_scene = 160;
    let config = ProceduralConfig {
        seed: 5,
        scenes: SCENES,
        frames_per_scene: per_scene,
        rig: RigSource::Preset(rig),
        world: world::WorldConfig { duration_secs: 16.0, ..world::WorldConfig::default() },
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config).unwrap();
    let indices = (0..SCENES).flat_map(|scene| (0..FRAMES).map(move |i| scene * per_scene + i));
    let frames: Vec<SceneFrame> = indices.map(|index| small(dataset.frame(index).unwrap())).collect();
    assert!(frames[..FRAMES].windows(2).all(|pair| pair[1].timestamp_ns - pair[0].timestamp_ns == STEP_NS));
    frames
}

/// The same frame with pictures of a fifteenth of the size.
fn small(mut frame: SceneFrame) -> SceneFrame {
    for view in &mut frame.views {
        let raw = view.intrinsics;
        let edit = geometry::ImageEdit::identity(raw.width, raw.height).resize(raw.width / 15, raw.height / 15);
        view.intrinsics = edit.intrinsics(&raw);
        let small = view.camera().unwrap();
        if let Some(data::ImageSource::Rendered { camera, .. }) = &mut view.image {
            *camera = small;
        }
    }
    frame.scene_text = Some(TEXT.to_owned());
    frame
}

pub fn write(
    out: &Path,
    frames: &[SceneFrame],
    change: impl FnOnce(&mut WayveScenesWriterConfig),
) -> WayveScenesManifest {
    let mut config = WayveScenesWriterConfig::new(out);
    change(&mut config);
    write_wayvescenes(&config, frames, &mut |_, _| {}).unwrap_or_else(|error| panic!("{error}"))
}
