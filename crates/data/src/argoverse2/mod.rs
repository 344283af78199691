//! Argoverse 2 sensor dataset: reader of the native logs.
//!
//! Every picture keeps its own stamp and the car's pose at it; boxes lie in the ego frame of their lidar stamp, which is the frame's
//! reference instant. The ego frame is the dataset's: rear axle, 0.32 m above the ground. Camera names stay inside this folder. Format:
//! <https://argoverse.github.io/user-guide/datasets/sensor.html>, as checked on real files.

mod annotations;
mod config;
mod feather;
mod ground;
mod ipc;
mod lines;
mod log;
mod map;
mod outline;
mod poses;
mod sets;

use std::ops::Range;
use std::sync::Arc;

use geometry::Rigid;
use rayon::prelude::*;

pub use config::{Argoverse2Config, FrameChoice, Split};
pub(crate) use config::{RING, STEREO};
pub use ground::{GroundHeight, Sim2};
pub use map::{Argoverse2Map, DrivableArea, LaneSegment, MapPoint, PedestrianCrossing};

use lines::CityMap;
use log::{Log, LogTables, Slot};
use sets::PictureSet;

use crate::procedural_cache::SceneCache;
use crate::store::Store;
use crate::{Capabilities, DataError, FrameId, ImageSource, LocalMap, SceneDataset, SceneFrame, View};

/// An opened Argoverse 2 sensor dataset. Frames and rigs are in memory, tables and maps of a few logs too, pictures are opened on demand.
#[derive(Debug)]
pub struct Argoverse2 {
    config: Argoverse2Config,
    store: Store,
    logs: Vec<Log>,
    ranges: Vec<Range<usize>>,
    tables: SceneCache<Option<Arc<LogTables>>>,
    maps: SceneCache<Option<Arc<CityMap>>>,
}

/// A log of an opened dataset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogInfo {
    /// Its folder's name.
    pub name: String,
    /// The split it lies in; `None` for a folder of logs without splits.
    pub split: Option<&'static str>,
    /// The city's short name, where the log has a map.
    pub city: Option<String>,
    /// Its frames.
    pub frames: Range<usize>,
    /// Reference instants that give no frame because no wanted camera has a picture there.
    pub bare_instants: usize,
}

impl Argoverse2 {
    /// Reads and checks the tables of the chosen logs and lists their pictures. No picture and no map is opened.
    ///
    /// # Errors
    /// Every broken table, with the file and the row: see [`DataError`]. A picture or a reference instant without a pose is
    /// [`DataError::Calibration`], a split without a log [`DataError::Empty`].
    pub fn open(config: &Argoverse2Config) -> Result<Self, DataError> {
        config.checked()?;
        let store = Store::open_all(&config.root)?;
        let places = log::find(&store, config)?;
        let logs: Vec<Log> =
            places.into_par_iter().map(|place| Log::open(&store, place, config)).collect::<Result<_, _>>()?;
        let mut ranges: Vec<Range<usize>> = Vec::new();
        for log in &logs {
            let start = ranges.last().map_or(0, |range| range.end);
            ranges.push(start..start + log.sets.len());
            if log.bare_instants > 0 {
                tracing::info!("{}: no picture at {} reference instants", log.place.name, log.bare_instants);
            }
        }
        let (tables, maps) = (SceneCache::new(config.cached_logs), SceneCache::new(config.cached_logs));
        Ok(Self { config: config.clone(), store, logs, ranges, tables, maps })
    }

    /// The logs in frame order.
    pub fn logs(&self) -> Vec<LogInfo> {
        let info = |(log, frames): (&Log, &Range<usize>)| LogInfo {
            name: log.place.name.clone(),
            split: log.place.split,
            city: log.city().map(str::to_owned),
            frames: frames.clone(),
            bare_instants: log.bare_instants,
        };
        self.logs.iter().zip(&self.ranges).map(info).collect()
    }

    /// The whole map of a frame's log, city frame.
    ///
    /// # Errors
    /// [`DataError::Missing`] for a log without a map; [`DataError::Json`] naming the file.
    pub fn city_map(&self, index: usize) -> Result<Argoverse2Map, DataError> {
        let (_, log, _) = self.find(index)?;
        let Some(map) = &log.map else { return Err(self.missing(log, "map archive")) };
        Argoverse2Map::read(&self.store.file(map, "map archive")?)
    }

    /// The ground of a frame's log, city frame. Read anew by every call.
    ///
    /// # Errors
    /// [`DataError::Missing`] for a log without a raster; whatever is wrong with its files.
    pub fn ground_height(&self, index: usize) -> Result<GroundHeight, DataError> {
        let (_, log, _) = self.find(index)?;
        let ground = GroundHeight::read(&self.store, &log.place.folder)?;
        ground.ok_or_else(|| self.missing(log, "ground height raster"))
    }

    fn missing(&self, log: &Log, what: &str) -> DataError {
        DataError::Missing { what: what.to_owned(), path: self.store.path(&format!("{}/map", log.place.folder)) }
    }

    /// Number of the log, the log and the set of a frame.
    fn find(&self, index: usize) -> Result<(usize, &Log, &PictureSet), DataError> {
        let at = self.ranges.partition_point(|range| range.end <= index);
        let found = self.logs.get(at).zip(self.ranges.get(at));
        let found = found.and_then(|(log, range)| Some((at, log, log.sets.get(index.checked_sub(range.start)?)?)));
        found.ok_or_else(|| {
            let (name, len) = (&self.config.name, self.len());
            DataError::Config(format!("frame {index} of {name} does not exist, there are {len}"))
        })
    }

    fn tables(&self, at: usize, log: &Log) -> Result<Arc<LogTables>, DataError> {
        let read = || LogTables::read(&self.store, &log.place.folder, &self.config).map(Arc::new);
        // Errors are not kept: a second reading gives the error itself.
        match &*self.tables.get_or_make(at, || read().ok()) {
            Some(tables) => Ok(tables.clone()),
            None => read(),
        }
    }

    fn view(
        &self,
        log: &Log,
        slot: &Slot,
        stamp: Option<i64>,
        time_ns: i64,
        tables: &LogTables,
        reference: &Rigid,
    ) -> Result<View, DataError> {
        let camera = &slot.camera;
        let size = (camera.intrinsics.width, camera.intrinsics.height);
        let name = |stamp: i64| format!("{}/sensors/cameras/{}/{stamp}.jpg", log.place.folder, camera.channel);
        let (timestamp_ns, world_from_ego) = match stamp {
            Some(stamp) => (stamp, tables.poses.of(&name(stamp), stamp, &self.store)?),
            // When it would have been taken; its pose only places the camera, so the reference pose serves where no row is near.
            None => {
                let expected_ns = time_ns + slot.offset_ns;
                (expected_ns, tables.poses.at(expected_ns).unwrap_or(*reference))
            }
        };
        Ok(View {
            channel: camera.channel.clone(),
            timestamp_ns,
            image: stamp.map(|stamp| ImageSource::File { file: self.store.expected(&name(stamp)), size }),
            mask: None,
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            ego_from_cam: camera.ego_from_cam,
            world_from_ego,
        })
    }
}

impl SceneDataset for Argoverse2 {
    fn len(&self) -> usize {
        self.ranges.last().map_or(0, |range| range.end)
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let (at, log, set) = self.find(index)?;
        let tables = self.tables(at, log)?;
        let world_from_ego = tables.poses.of("the reference instant", set.time_ns, &self.store)?;
        let views = log.slots.iter().zip(&set.pictures);
        let views = views.map(|(slot, stamp)| self.view(log, slot, *stamp, set.time_ns, &tables, &world_from_ego));
        let boxes = tables.annotations.as_ref();
        Ok(SceneFrame {
            id: FrameId {
                dataset: self.config.name.clone(),
                scene: log.place.name.clone(),
                frame: set.time_ns.to_string(),
            },
            timestamp_ns: set.time_ns,
            world_from_ego,
            views: views.collect::<Result<_, _>>()?,
            boxes: boxes.and_then(|boxes| boxes.at(set.time_ns, &world_from_ego, &self.config)),
            scene_text: None,
        })
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.ranges.clone()
    }

    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        if !(half_m.is_finite() && half_m > 0.0) {
            return Err(DataError::Config(format!("a map needs a positive size, not {half_m} m")));
        }
        let (at, log, set) = self.find(index)?;
        let read = || self.city_map(index).map(|map| Arc::new(CityMap::new(&map)));
        let map = match &*self.maps.get_or_make(at, || read().ok()) {
            Some(map) => map.clone(),
            None => read()?,
        };
        let world_from_ego = self.tables(at, log)?.poses.of("the reference instant", set.time_ns, &self.store)?;
        Ok(map.around(&world_from_ego, half_m))
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities {
            boxes: self.logs.iter().any(|log| log.is_annotated),
            map: self.logs.iter().any(|log| log.map.is_some()),
            ..Capabilities::default()
        }
    }

    fn max_views(&self) -> usize {
        self.logs.iter().map(|log| log.slots.len()).max().unwrap_or(0)
    }
}
