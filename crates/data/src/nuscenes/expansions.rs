//! What stands beside the tables: maps and the CAN bus.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use super::can_bus::{CanBus, CanState};
use super::map::{CityMap, MapPrior};
use super::tables::Scene;
use super::{NuScenes, SceneDataset};
use crate::store::{Store, checked_name};
use crate::{DataError, LocalMap};

const MAP_FOLDER: &str = "maps/expansion";
const CAN_FOLDER: &str = "can_bus";

/// The expansions of an opened dataset. Maps stay in memory once they were asked for.
#[derive(Debug)]
pub(super) struct Expansions {
    store: Store,
    pub has_maps: bool,
    pub has_can_bus: bool,
    maps: Mutex<HashMap<Box<str>, Arc<CityMap>>>,
}

impl Expansions {
    pub(super) fn find(store: &Store) -> Result<Self, DataError> {
        let has_json = |folder| Ok::<_, DataError>(store.list(folder)?.iter().any(|file| file.name.ends_with(".json")));
        let (has_maps, has_can_bus) = (has_json(MAP_FOLDER)?, has_json(CAN_FOLDER)?);
        Ok(Self { store: store.clone(), has_maps, has_can_bus, maps: Mutex::default() })
    }

    /// Threads that ask at the same time wait for the one that reads.
    fn map(&self, location: &str, tables: &std::path::Path) -> Result<Arc<CityMap>, DataError> {
        // A panic elsewhere leaves the list whole: maps are inserted when they are complete.
        let mut maps = self.maps.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(map) = maps.get(location) {
            return Ok(map.clone());
        }
        let name = format!("{MAP_FOLDER}/{location}.json");
        let file = self.store.file(checked_name(&name, tables)?, "map expansion")?;
        let map = Arc::new(CityMap::read(&file)?);
        maps.insert(location.into(), map.clone());
        Ok(map)
    }
}

impl NuScenes {
    fn scene_of(&self, index: usize) -> Result<&Scene, DataError> {
        Ok(&self.base.scenes[self.set(index)?.scene as usize])
    }

    /// The vector map of a frame's city district, in the frame of its poses.
    ///
    /// # Errors
    /// [`DataError::Unsupported`] without map expansion, [`DataError::Missing`] where this district's map is not there, whatever is
    /// wrong in it.
    pub fn city_map(&self, index: usize) -> Result<Arc<CityMap>, DataError> {
        let location = &self.scene_of(index)?.location;
        if !self.expansions.has_maps {
            return Err(self.unsupported("map"));
        }
        self.expansions.map(location, &self.base.path("log"))
    }

    pub(super) fn map_around(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        let map = self.city_map(index)?;
        let (_, world_from_ego) = self.reference(self.set(index)?)?;
        map.around(&world_from_ego, half_m)
    }

    /// The picture of road and sidewalk of a frame's city district. It is decoded anew by every call.
    ///
    /// # Errors
    /// [`DataError::Missing`] where no row of the map table names the scene's log or its file is not there, [`DataError::Image`] for a file
    /// that cannot be read.
    pub fn map_prior(&self, index: usize) -> Result<MapPrior, DataError> {
        let scene = self.scene_of(index)?;
        let table = self.base.path("map");
        let row = self.base.priors.iter().find(|row| row.log_tokens.contains(&scene.log_token));
        let row = row.ok_or_else(|| DataError::Missing {
            what: format!("map of log {}", scene.log_token),
            path: table.clone(),
        })?;
        let name = checked_name(&row.file_name, &table)?;
        MapPrior::read(&self.expansions.store.file(name, "map prior")?)
    }

    /// The CAN bus messages of a frame's scene.
    ///
    /// # Errors
    /// [`DataError::Unsupported`] without CAN bus expansion and for the scenes that are known to lack it.
    pub fn can_bus(&self, index: usize) -> Result<CanBus, DataError> {
        let scene = self.scene_of(index)?;
        let found =
            if self.expansions.has_can_bus { CanBus::of_scene(&self.expansions.store, &scene.name)? } else { None };
        found.ok_or_else(|| self.unsupported("CAN bus"))
    }

    /// What the vehicle measured at a frame's reference instant.
    ///
    /// # Errors
    /// As [`NuScenes::can_bus`]; whatever is wrong with the messages.
    pub fn can_state(&self, index: usize) -> Result<CanState, DataError> {
        let (timestamp_ns, _) = self.reference(self.set(index)?)?;
        self.can_bus(index)?.state(timestamp_ns)
    }
}
