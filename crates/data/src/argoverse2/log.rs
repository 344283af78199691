//! One log: where its files are, which frames it gives, and its tables.

use std::collections::HashSet;

use geometry::RigCamera;

use super::annotations::Annotations;
use super::config::{Argoverse2Config, Split};
use super::poses::{Poses, read_rig};
use super::sets::{self, PictureSet, Stamps};
use crate::DataError;
use crate::store::Store;

/// Where a log lies.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct LogPlace {
    pub name: String,
    /// Folder inside the dataset.
    pub folder: String,
    pub split: Option<&'static str>,
}

/// A camera of a log's rig.
#[derive(Debug)]
pub(super) struct Slot {
    pub camera: RigCamera,
    /// Typical picture stamp minus reference instant.
    pub offset_ns: i64,
}

/// What stays in memory of a log.
#[derive(Debug)]
pub(super) struct Log {
    pub place: LogPlace,
    pub slots: Vec<Slot>,
    pub sets: Vec<PictureSet>,
    /// Reference instants that were left out because no camera has a picture there.
    pub bare_instants: usize,
    pub is_annotated: bool,
    /// Name of the map archive inside the dataset.
    pub map: Option<String>,
}

/// The tables a frame is made from.
#[derive(Debug)]
pub(super) struct LogTables {
    pub poses: Poses,
    /// `None` without an annotation file.
    pub annotations: Option<Annotations>,
}

/// The logs that the config wants.
///
/// # Errors
/// [`DataError::Missing`] for a named log that is not there, [`DataError::Empty`] when there is none at all.
pub(super) fn find(store: &Store, config: &Argoverse2Config) -> Result<Vec<LogPlace>, DataError> {
    let has_splits = |folder: &str| -> Result<bool, DataError> {
        let names = store.list(folder)?;
        Ok(names.iter().any(|name| name.is_folder && Split::All.folders().contains(&name.name.as_str())))
    };
    let base = if has_splits("sensor")? { "sensor/" } else { "" };
    let mut places = Vec::new();
    let mut add = |folder: &str, split: Option<&'static str>| -> Result<(), DataError> {
        let names = store.list(folder)?.into_iter().filter(|name| name.is_folder && !name.name.starts_with('.'));
        places.extend(names.map(|name| LogPlace {
            folder: if folder.is_empty() { name.name.clone() } else { format!("{folder}/{}", name.name) },
            name: name.name,
            split,
        }));
        Ok(())
    };
    if !base.is_empty() || has_splits("")? {
        for split in config.split.folders() {
            add(&format!("{base}{split}"), Some(split))?;
        }
    } else if config.split == Split::All {
        add("", None)?;
    }
    if !config.logs.is_empty() {
        let named = |log: &String| {
            let place = places.iter().find(|place| place.name == *log).cloned();
            place.ok_or_else(|| DataError::Missing { what: "log".to_owned(), path: store.path(log) })
        };
        return config.logs.iter().map(named).collect();
    }
    if places.is_empty() {
        let what = format!("split {}", config.split.folders().join(", "));
        return Err(DataError::Empty { what, path: store.path(base.trim_end_matches('/')) });
    }
    Ok(places)
}

impl LogTables {
    pub fn read(store: &Store, folder: &str, config: &Argoverse2Config) -> Result<Self, DataError> {
        let poses = Poses::read(store, folder, config.gap_ns())?;
        let annotations = match store.find(&format!("{folder}/annotations.feather")) {
            Some(file) => Some(Annotations::read(&file, &poses, config, store)?),
            None => None,
        };
        Ok(Self { poses, annotations })
    }
}

impl Log {
    /// Reads and checks all tables of a log and lists its pictures.
    pub fn open(store: &Store, place: LogPlace, config: &Argoverse2Config) -> Result<Self, DataError> {
        let tables = LogTables::read(store, &place.folder, config)?;
        let rig = read_rig(store, &place.folder, &config.wanted_cameras())?;
        let excluded: HashSet<&str> = config.exclude.iter().map(String::as_str).collect();
        let mut pictures = Vec::new();
        for camera in &rig {
            let folder = format!("{}/sensors/cameras/{}", place.folder, camera.channel);
            let mut stamps = stamps_in(store, &folder, ".jpg")?;
            let prefix = format!("{}/{}", place.name, camera.channel);
            stamps.retain(|stamp| !excluded.contains(format!("{prefix}/{stamp}").as_str()));
            for stamp in &stamps {
                tables.poses.of(&format!("{folder}/{stamp}.jpg"), *stamp, store)?;
            }
            pictures.push(stamps);
        }
        let annotated: Vec<i64> = tables.annotations.iter().flat_map(Annotations::stamps).collect();
        let mut lidar = stamps_in(store, &format!("{}/sensors/lidar", place.folder), ".feather")?;
        lidar.extend(&annotated);
        lidar.sort_unstable();
        lidar.dedup();
        let stamps = Stamps { pictures: &pictures, annotated: &annotated, lidar: &lidar };
        let grouped = sets::group(&stamps, config.frames, config.window_ns());
        let (mut sets, found) = (grouped.sets, &tables.poses);
        let all = sets.len();
        sets.retain(|set| set.pictures.iter().any(Option::is_some));
        let bare_instants = all - sets.len();
        if config.require_all_views {
            sets.retain(|set| set.pictures.iter().all(Option::is_some));
        }
        sets.retain(|set| !excluded.contains(format!("{}/{}", place.name, set.time_ns).as_str()));
        for set in &mut sets {
            settle(set, found, &place, store, &lidar)?;
        }
        let slots = rig.into_iter().zip(grouped.offsets_ns).map(|(camera, offset_ns)| Slot { camera, offset_ns });
        Ok(Self {
            slots: slots.collect(),
            sets,
            bare_instants,
            is_annotated: tables.annotations.is_some(),
            map: super::map::find_archive(store, &place.folder)?,
            place,
        })
    }

    /// The map archive's city, as its file name says.
    pub fn city(&self) -> Option<&str> {
        let (_, rest) = self.map.as_deref()?.rsplit_once("____")?;
        rest.split_once("_city_").map(|(city, _)| city)
    }
}

/// A set between two lidar stamps is timed by its pictures; at the ends of a log no pose may cover that time, so the first picture's
/// own stamp serves. A lidar stamp must have its pose.
fn settle(
    set: &mut PictureSet,
    poses: &Poses,
    place: &LogPlace,
    store: &Store,
    lidar: &[i64],
) -> Result<(), DataError> {
    if poses.at(set.time_ns).is_ok() {
        return Ok(());
    }
    if lidar.binary_search(&set.time_ns).is_err()
        && let Some(stamp) = set.pictures.iter().flatten().next()
    {
        set.time_ns = *stamp;
    }
    poses.of(&format!("lidar stamp {} of {}", set.time_ns, place.name), set.time_ns, store).map(drop)
}

/// The stamps that are the names of a folder's files, ascending; files of other kinds are not the dataset's.
fn stamps_in(store: &Store, folder: &str, ending: &str) -> Result<Vec<i64>, DataError> {
    let mut stamps = Vec::new();
    for name in store.list(folder)?.iter().filter(|name| !name.is_folder && !name.name.starts_with('.')) {
        let Some(stem) = name.name.strip_suffix(ending) else { continue };
        let stamp = stem.parse::<i64>().ok().filter(|stamp| stamp.to_string() == stem);
        stamps.push(stamp.ok_or_else(|| DataError::Format {
            format: "Argoverse 2 sensor",
            why: "its name is no time stamp in nanoseconds".to_owned(),
            path: store.path(&format!("{folder}/{}", name.name)),
        })?);
    }
    stamps.sort_unstable();
    Ok(stamps)
}
