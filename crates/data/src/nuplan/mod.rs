//! nuPlan v1.1: reader of the native SQLite logs and their pictures.
//!
//! A log is a scene. Cameras are ordered clockwise from the front by their calibration, every picture has the car's pose interpolated to its
//! own stamp, and the reference instant of a frame is the lidar turn closest to its pictures, so that boxes need no interpolation. Most logs of
//! the release have no pictures; they give no frames and [`check`] names them. Format: <https://www.nuscenes.org/nuplan>, as checked on databases
//! with the shipped layout. The vector maps (GeoPackage) are flat: they lie on the plane of the car's own axes.

mod boxes;
mod cameras;
mod check;
mod config;
mod database;
mod logs;
mod maps;
mod pairing;
mod sets;
mod token;
mod utm;
pub mod wkb;

use std::collections::HashMap;
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

pub use check::{NuPlanCheck, check};
pub use config::NuPlanConfig;

pub(crate) use config::{default_box_window_ms, default_pairing_window_ms};
pub(crate) use database::sqlite;
pub(crate) use logs::usual_name;
pub(crate) use pairing::{Paired, assign_lidar, pair};
pub(crate) use token::Token;

use database::Database;
use logs::Log;
use maps::CityMap;
use sets::{PictureSet, SetView};

use crate::procedural_cache::SceneCache;
use crate::store::Store;
use crate::{Capabilities, DataError, FrameId, ImageSource, LocalMap, ObjectBox, SceneDataset, SceneFrame, View};

/// Databases kept open. One costs a few dozen kilobytes on a disk and its own size in an archive.
const OPEN_DATABASES: usize = 8;

/// An opened nuPlan-layout dataset. Stamps and poses of the pictures are in memory; boxes and pictures are read on demand.
#[derive(Debug)]
pub struct NuPlan {
    config: NuPlanConfig,
    store: Store,
    logs: Vec<Log>,
    ranges: Vec<Range<usize>>,
    logs_without_pictures: Vec<String>,
    databases: SceneCache<Mutex<Option<Database>>>,
    /// Cities that were asked for.
    maps: Mutex<HashMap<String, Arc<CityMap>>>,
}

/// A log of an opened dataset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogInfo {
    /// Name, as in the split lists.
    pub name: String,
    /// City; `None` where the database does not say.
    pub location: Option<String>,
    /// Its frames.
    pub frames: Range<usize>,
    /// Rows of its cameras whose picture is not there.
    pub absent_pictures: usize,
}

impl NuPlan {
    /// Lists the pictures and reads the databases of the logs that have some. No picture is opened.
    ///
    /// # Errors
    /// Every broken database, with its file and the row: see [`DataError`]. [`DataError::Empty`] for a split without a log that has pictures.
    pub fn open(config: &NuPlanConfig) -> Result<Self, DataError> {
        config.checked()?;
        let store = Store::open_all(&config.root)?;
        let files = logs::find_logs(config, &store)?;
        let read: Vec<Option<Log>> =
            files.par_iter().map(|file| logs::read_log(config, &store, file)).collect::<Result<_, _>>()?;
        let silent = files.iter().zip(&read).filter(|(_, log)| log.is_none());
        let logs_without_pictures: Vec<String> = silent.map(|(file, _)| file.name.clone()).collect();
        let logs: Vec<Log> = read.into_iter().flatten().collect();
        if logs.is_empty() {
            let what = format!("split {}, {} logs of which none has pictures,", config.split, files.len());
            return Err(DataError::Empty { what, path: store.path(&config.databases) });
        }
        let mut start = 0;
        let range = |log: &Log| {
            let first = start;
            start += log.sets.len();
            first..start
        };
        let ranges = logs.iter().map(range).collect();
        let databases = SceneCache::new(OPEN_DATABASES);
        let maps = Mutex::default();
        Ok(Self { config: config.clone(), store, logs, ranges, logs_without_pictures, databases, maps })
    }

    /// The logs in frame order.
    pub fn logs(&self) -> Vec<LogInfo> {
        let info = |(log, frames): (&Log, &Range<usize>)| LogInfo {
            name: log.name.clone(),
            location: log.location.clone(),
            frames: frames.clone(),
            absent_pictures: log.absent_pictures,
        };
        self.logs.iter().zip(&self.ranges).map(info).collect()
    }

    /// Logs of the split that give no frames because not one of their pictures is there.
    pub fn logs_without_pictures(&self) -> &[String] {
        &self.logs_without_pictures
    }

    fn find(&self, index: usize) -> Result<(usize, &Log, &PictureSet), DataError> {
        let at = self.ranges.partition_point(|range| range.end <= index);
        let found = self.ranges.get(at).zip(self.logs.get(at));
        let found = found.and_then(|(range, log)| Some((at, log, log.sets.get(index.checked_sub(range.start)?)?)));
        found.ok_or_else(|| {
            DataError::Config(format!("frame {index} of {} does not exist, there are {}", self.config.name, self.len()))
        })
    }

    fn boxes(&self, at: usize, log: &Log, set: &PictureSet) -> Result<Option<Vec<ObjectBox>>, DataError> {
        let (Some(classes), Some(lidar)) = (&log.classes, set.lidar) else { return Ok(None) };
        let database: Arc<Mutex<Option<Database>>> = self.databases.get_or_make(at, || Mutex::new(None));
        // Whatever panicked elsewhere while it held the lock only read.
        let mut database = database.lock().unwrap_or_else(PoisonError::into_inner);
        if database.is_none() {
            *database = Some(Database::open(&log.file)?);
        }
        let Some(database) = database.as_ref() else { return Ok(None) };
        boxes::read_boxes(database, lidar, &set.world_from_ego.inverse(), classes).map(Some)
    }

    /// The map of a log's city. Threads that ask at the same time wait for the one that reads.
    fn city_map(&self, log: &Log) -> Result<Arc<CityMap>, DataError> {
        let file = match &log.map {
            Some(file) => file,
            None if self.logs.iter().any(|log| log.map.is_some()) => {
                let what = format!("map of {}", log.map_names.join(" or "));
                return Err(DataError::Missing { what, path: self.store.path(&self.config.maps) });
            }
            None => return Err(self.unsupported("map")),
        };
        let key = file.path().to_string_lossy().into_owned();
        // A panic elsewhere leaves the list whole: maps are inserted when they are complete.
        let mut maps = self.maps.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(map) = maps.get(&key) {
            return Ok(map.clone());
        }
        let map = Arc::new(CityMap::read(file)?);
        maps.insert(key, map.clone());
        Ok(map)
    }

    fn view(&self, log: &Log, camera: &geometry::RigCamera, view: &SetView) -> View {
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let image = view.picture.as_ref().map(|picture| {
            let usual = || usual_name(&log.name, &camera.channel, picture.token);
            let name = picture.name.as_ref().map_or_else(usual, ToString::to_string);
            let name = format!("{}/{name}", self.config.sensor_blobs);
            ImageSource::File { file: self.store.expected(&name), size }
        });
        View {
            channel: camera.channel.clone(),
            timestamp_ns: view.time_ns,
            image,
            mask: None,
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            ego_from_cam: camera.ego_from_cam,
            world_from_ego: view.world_from_ego,
        }
    }
}

impl SceneDataset for NuPlan {
    fn len(&self) -> usize {
        self.ranges.last().map_or(0, |range| range.end)
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let (at, log, set) = self.find(index)?;
        Ok(SceneFrame {
            id: FrameId {
                dataset: self.config.name.clone(),
                scene: log.name.clone(),
                frame: set.lidar.map_or_else(|| set.time_ns.to_string(), |lidar| lidar.to_string()),
            },
            timestamp_ns: set.time_ns,
            world_from_ego: set.world_from_ego,
            views: log.cameras.iter().zip(&set.views).map(|(camera, view)| self.view(log, camera, view)).collect(),
            boxes: self.boxes(at, log, set)?,
            scene_text: set.text.as_ref().map(ToString::to_string),
        })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.ranges.clone()
    }

    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        let (_, log, set) = self.find(index)?;
        self.city_map(log)?.around(&set.world_from_ego, half_m)
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    fn notes(&self) -> Vec<String> {
        let silent = &self.logs_without_pictures;
        let absent: usize = self.logs.iter().map(|log| log.absent_pictures).sum();
        let logs = silent.len() + self.logs.len();
        let mut notes = Vec::new();
        if absent > 0 {
            notes.push(format!("{absent} rows of pictures that are not there, in logs that have some"));
        }
        if !silent.is_empty() {
            notes.push(format!("{} of {logs} logs without pictures: {}", silent.len(), silent.join(", ")));
        }
        notes
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities {
            boxes: self.logs.iter().any(|log| log.classes.is_some()),
            map: self.logs.iter().any(|log| log.map.is_some()),
            text: self.logs.iter().any(|log| log.has_tags),
            ..Capabilities::default()
        }
    }

    fn max_views(&self) -> usize {
        self.logs.iter().map(|log| log.cameras.len()).max().unwrap_or(0)
    }
}
