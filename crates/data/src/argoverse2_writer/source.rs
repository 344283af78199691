//! What becomes a log.

use crate::argoverse2::{Argoverse2, Argoverse2Map, GroundHeight, Split};
use crate::procedural::Procedural;
use crate::{DataError, SceneDataset, SceneFrame};

/// Frames of one scene and what lies around them.
#[derive(Debug, Clone)]
pub struct Argoverse2Log {
    /// The split to write it into; not `All`.
    pub split: Split,
    /// Frames of one scene with one rig of pinhole cameras, in time order. A frame without boxes (`None`) and an annotated one with no box
    /// look alike in the table, unless no frame of the log is annotated: then there is no table.
    pub frames: Vec<SceneFrame>,
    /// Short name of the city, such as `PIT`.
    pub city: String,
    /// Vector map in the frames' world.
    pub map: Option<Argoverse2Map>,
    /// Height of the ground in the frames' world.
    pub ground: Option<GroundHeight>,
}

impl Argoverse2Log {
    /// Frames of a scene of any dataset, without map and ground.
    ///
    /// # Errors
    /// Whatever is wrong with a frame; [`DataError::Config`] for a scene that does not exist.
    pub fn of_scene(dataset: &dyn SceneDataset, scene: usize, split: Split) -> Result<Self, DataError> {
        let range = dataset.scene_ranges().get(scene).cloned();
        let range = range.ok_or_else(|| DataError::Config(format!("{} has no scene {scene}", dataset.name())))?;
        let frames = range.map(|index| dataset.frame(index)).collect::<Result<_, _>>()?;
        Ok(Self { split, frames, city: "XXX".to_owned(), map: None, ground: None })
    }

    /// A log of the same layout, with its map and ground where it has them.
    ///
    /// # Errors
    /// As [`Argoverse2Log::of_scene`]; broken map files.
    pub fn of_argoverse2(dataset: &Argoverse2, log: usize, split: Split) -> Result<Self, DataError> {
        let mut found = Self::of_scene(dataset, log, split)?;
        let Some(info) = dataset.logs().into_iter().nth(log).filter(|info| !info.frames.is_empty()) else {
            return Ok(found);
        };
        found.map = present(dataset.city_map(info.frames.start))?;
        found.ground = present(dataset.ground_height(info.frames.start))?;
        found.city = info.city.unwrap_or(found.city);
        Ok(found)
    }

    /// A scene of the procedural world with its map; the ground there is level.
    ///
    /// # Errors
    /// As [`Argoverse2Log::of_scene`].
    pub fn of_procedural(dataset: &Procedural, scene: usize, split: Split) -> Result<Self, DataError> {
        let mut found = Self::of_scene(dataset, scene, split)?;
        let world = dataset.world(scene);
        let (low, high) = world.map().bounds();
        found.map = Some(Argoverse2Map::from_world(world.map()));
        found.ground = Some(GroundHeight::level(0.0, low, high));
        Ok(found)
    }
}

/// `None` for a part that the log lacks.
fn present<T>(part: Result<T, DataError>) -> Result<Option<T>, DataError> {
    match part {
        Ok(part) => Ok(Some(part)),
        Err(DataError::Missing { .. }) => Ok(None),
        Err(error) => Err(error),
    }
}
