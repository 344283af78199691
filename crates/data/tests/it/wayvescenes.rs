//! The WayveScenes101 reader and writer: fixtures against their truth, broken scenes, and the way there and back.

mod broken;
mod golden;
mod made;
mod reading;
mod written;

use std::path::{Path, PathBuf};

use data::wayvescenes::{SceneInfo, WayveScenes, WayveScenesConfig};
use data::{SceneDataset, SceneFrame, View};
use geometry::Rigid;

/// Clockwise from the front, the order of the specification.
const CHANNELS: [&str; 5] = ["front-forward", "right-forward", "right-backward", "left-backward", "left-forward"];

fn data_folder(inside: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: RIGSCAPE_DATA is not set");
        return None;
    };
    let path = Path::new(&root).join(inside);
    assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
    Some(path)
}

fn fixture(change: impl FnOnce(&mut WayveScenesConfig)) -> Option<WayveScenesConfig> {
    let root = data_folder("wayve101")?;
    let mut config = WayveScenesConfig { metadata: Some(root.join("repo_data")), ..WayveScenesConfig::new(root) };
    change(&mut config);
    Some(config)
}

fn open(config: &WayveScenesConfig) -> WayveScenes {
    WayveScenes::open(config).unwrap_or_else(|error| panic!("{error}"))
}

fn frames(dataset: &WayveScenes) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

fn frames_of(dataset: &WayveScenes, info: &SceneInfo) -> Vec<SceneFrame> {
    info.frames.clone().map(|index| dataset.frame(index).unwrap()).collect()
}

fn world_from_cam(view: &View) -> Rigid {
    view.world_from_ego * view.ego_from_cam
}
