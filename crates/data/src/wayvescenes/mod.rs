//! WayveScenes101: reader of scenes that are COLMAP models with pictures and masks.
//!
//! The lens stays a fisheye, the scale is recovered from the published distances between the cameras, and the car's frame is defined
//! here because the dataset has none: x along the forward camera, level; z up; the origin on the ground below that camera. The world
//! of a scene is COLMAP's, turned upright and scaled to metres. There are no boxes and no map.
//! Format: <https://github.com/wayveai/wayve_scenes>; the layout and the defaults follow the project's specification of datasets.

mod config;
mod ground;
mod metadata;
mod rig;
mod scale;
mod scene;
mod sets;

use std::ops::Range;

use rayon::prelude::*;

pub use config::{Scale, TimeUnit, ViewSplit, WayveScenesConfig};
pub(crate) use metadata::{SCENE_COLUMN, TAG_COLUMNS, cells_of_text, line};
pub(crate) use scale::{Baselines, choose, median};
pub(crate) use scene::MODEL_FOLDER;

use crate::store::{Store, checked_name};
use crate::{Capabilities, DataError, SceneDataset, SceneFrame};
use metadata::Metadata;
use scene::Scene;

/// The camera that defines scale and car frame, and that the official protocol holds out.
pub(crate) const REFERENCE_CHANNEL: &str = "front-forward";
/// File of the published distances between the cameras.
pub(crate) const BASELINES_FILE: &str = "baselines.json";
/// File of the scenes' tags.
pub(crate) const METADATA_FILE: &str = "scene_metadata.csv";

/// An opened dataset. Poses are in memory, pictures and masks are opened on demand.
#[derive(Debug)]
pub struct WayveScenes {
    config: WayveScenesConfig,
    store: Store,
    metadata: Metadata,
    scenes: Vec<Scene>,
    ranges: Vec<Range<usize>>,
}

/// A scene of an opened dataset, and how it was brought to metres.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneInfo {
    /// Name of its folder.
    pub name: String,
    /// Its frames.
    pub frames: Range<usize>,
    /// The region whose baselines fit; `None` where the scale was given.
    pub region: Option<String>,
    /// Metres per unit of its COLMAP model.
    pub metres_per_unit: f64,
    /// Height of the forward camera above the ground, metres.
    pub camera_height_m: f64,
    /// Sparse points that carry the ground; `None` where the height was assumed.
    pub ground_points: Option<usize>,
    /// Columns and cells of its row in the metadata; empty where it has none.
    pub tags: Vec<(String, String)>,
}

impl WayveScenes {
    /// Reads the COLMAP models of the chosen scenes. No picture is opened.
    ///
    /// # Errors
    /// Whatever [`crate::colmap::Model::read`] refuses; [`DataError::Format`] for picture names, stamps or a scale that cannot be
    /// understood; [`DataError::Empty`] for a split or choice of cameras that leaves nothing; [`DataError::Missing`] for a scene
    /// asked for by name.
    pub fn open(config: &WayveScenesConfig) -> Result<Self, DataError> {
        config.checked()?;
        let store = Store::open_all(&config.root)?;
        let names = scene_names(config, &store)?;
        let (baselines, metadata) = read_metadata(config, &store)?;
        let read = |name: &String| Scene::read(&store, name, config, &baselines, &metadata);
        let scenes: Vec<Scene> = names.par_iter().map(read).collect::<Result<_, DataError>>()?;
        let mut end = 0;
        let next = |scene: &Scene| {
            let start = end;
            end += scene.len();
            start..end
        };
        let ranges: Vec<Range<usize>> = scenes.iter().map(next).collect();
        if end == 0 && !names.is_empty() {
            let what = format!("the choice of cameras and frames in {} scenes", names.len());
            return Err(DataError::Empty { what, path: store.path("") });
        }
        Ok(Self { config: config.clone(), store, metadata, scenes, ranges })
    }

    /// The scenes in frame order.
    pub fn scenes(&self) -> Vec<SceneInfo> {
        let info = |(scene, frames): (&Scene, &Range<usize>)| SceneInfo {
            name: scene.name.clone(),
            frames: frames.clone(),
            region: scene.measured.region.clone(),
            metres_per_unit: scene.measured.metres_per_unit,
            camera_height_m: scene.measured.camera_height_m,
            ground_points: scene.measured.ground_points,
            tags: self.metadata.tags(&scene.name).map(<[_]>::to_vec).unwrap_or_default(),
        };
        self.scenes.iter().zip(&self.ranges).map(info).collect()
    }
}

/// The chosen scenes that are in the root.
fn scene_names(config: &WayveScenesConfig, store: &Store) -> Result<Vec<String>, DataError> {
    let has_model = |name: &String| store.find(&format!("{name}/{}/images.bin", scene::MODEL_FOLDER)).is_some();
    let folders = store.list("")?.into_iter().filter(|entry| entry.is_folder).map(|entry| entry.name);
    let all: Vec<String> = folders.filter(|name| store_has_scene(store, name)).collect();
    let split = config::split_scenes(&config.split);
    let mut names: Vec<String> = match &split {
        Some(split) => split.iter().filter(|name| all.contains(name)).cloned().collect(),
        None => all,
    };
    if !config.scenes.is_empty() {
        let outside = |name: &&String| split.as_ref().is_some_and(|split| !split.contains(name));
        if let Some(name) = config.scenes.iter().find(outside) {
            return Err(DataError::Config(format!("{name} does not belong to split {}", config.split)));
        }
        names.clone_from(&config.scenes);
        for name in &names {
            checked_name(name, &store.path(""))?;
            if !has_model(name) {
                let path = store.path(&format!("{name}/{}/images.bin", scene::MODEL_FOLDER));
                return Err(DataError::Missing { what: format!("COLMAP model of {name}"), path });
            }
        }
    }
    if names.is_empty() && config.split != "all" {
        return Err(DataError::Empty { what: format!("split {}", config.split), path: store.path("") });
    }
    Ok(names)
}

/// Whether a folder of the root is a scene, complete or not: one with a broken model must not vanish.
fn store_has_scene(store: &Store, name: &str) -> bool {
    store.list(&format!("{name}/colmap_sparse")).is_ok_and(|inside| !inside.is_empty())
}

fn read_metadata(config: &WayveScenesConfig, root: &Store) -> Result<(Baselines, Metadata), DataError> {
    let store = match &config.metadata {
        Some(folder) => Store::open(folder)?,
        None => root.clone(),
    };
    let (baselines, metadata) = (store.find(BASELINES_FILE), store.find(METADATA_FILE));
    if let (Some(folder), None, None) = (&config.metadata, &baselines, &metadata) {
        return Err(DataError::Missing { what: format!("{BASELINES_FILE} or {METADATA_FILE}"), path: folder.clone() });
    }
    let baselines = baselines.map_or_else(|| Ok(Baselines::published()), |file| Baselines::read(&file))?;
    let metadata = metadata.map_or_else(|| Ok(Metadata::default()), |file| Metadata::read(&file))?;
    Ok((baselines, metadata))
}

impl SceneDataset for WayveScenes {
    fn len(&self) -> usize {
        self.ranges.last().map_or(0, |range| range.end)
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let at = self.ranges.partition_point(|range| range.end <= index);
        let found = self.scenes.get(at).zip(self.ranges.get(at));
        let frame = found.and_then(|(scene, range)| scene.frame(&self.store, &self.config.name, index - range.start));
        frame.ok_or_else(|| {
            let (name, len) = (&self.config.name, self.len());
            DataError::Config(format!("frame {index} of {name} does not exist, there are {len}"))
        })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.ranges.clone()
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    fn capabilities(&self) -> Capabilities {
        let text = self.scenes.iter().any(|scene| self.metadata.text(&scene.name).is_some());
        Capabilities { masks: self.scenes.iter().any(Scene::has_masks), text, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        self.scenes.iter().map(Scene::views).max().unwrap_or(0)
    }
}
