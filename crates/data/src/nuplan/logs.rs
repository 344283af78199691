//! Which logs there are, and what is kept of one: cameras, picture sets, tags.

use std::collections::{BTreeMap, HashMap, HashSet};
use std::sync::Arc;

use geometry::RigCamera;

use super::boxes::{self, Classes};
use super::cameras::read_cameras;
use super::config::{NuPlanConfig, ns, split_logs};
use super::database::Database;
use super::maps;
use super::sets::{ImageRow, PictureSet, SetMaker};
use super::token::Token;
use crate::DataError;
use crate::store::{Store, StoredFile, checked_name};

/// A database that belongs to the chosen split.
#[derive(Debug, Clone)]
pub(super) struct LogFile {
    pub name: String,
    pub file: StoredFile,
}

/// The databases of the split in its order, or by name.
pub(super) fn find_logs(config: &NuPlanConfig, store: &Store) -> Result<Vec<LogFile>, DataError> {
    let top = config.databases.as_str();
    let subfolders = store.list(top)?.into_iter().filter(|child| child.is_folder).map(|child| join(top, &child.name));
    let mut folders: Vec<String> = subfolders.collect();
    match config.split.as_str() {
        "mini" => folders.retain(|folder| folder.ends_with("mini")),
        _ => folders.insert(0, top.to_owned()),
    }
    // The same log may lie in two folders; the first wins.
    let mut found: BTreeMap<String, StoredFile> = BTreeMap::new();
    for folder in folders {
        for child in store.list(&folder)?.into_iter().filter(|child| !child.is_folder) {
            let Some(name) = child.name.strip_suffix(".db") else { continue };
            if let Some(file) = store.find(&join(&folder, &child.name)) {
                found.entry(name.to_owned()).or_insert(file);
            }
        }
    }
    let names = match config.split.as_str() {
        "all" | "mini" => found.keys().cloned().collect(),
        split => split_logs(split).ok_or_else(|| {
            DataError::Config(format!("{split:?} is no split; there are train, val, test, mini, all"))
        })?,
    };
    let wanted = choose(config, names)?;
    let take = |name: String| found.remove(&name).map(|file| LogFile { name, file });
    Ok(wanted.into_iter().filter_map(take).collect())
}

fn choose(config: &NuPlanConfig, names: Vec<String>) -> Result<Vec<String>, DataError> {
    if config.logs.is_empty() {
        return Ok(names);
    }
    let known: HashSet<&String> = names.iter().collect();
    match config.logs.iter().find(|log| !known.contains(log)) {
        Some(unknown) => Err(DataError::Config(format!("no log {unknown:?} in split {:?}", config.split))),
        None => Ok(config.logs.clone()),
    }
}

fn join(folder: &str, name: &str) -> String {
    if folder.is_empty() { name.to_owned() } else { format!("{folder}/{name}") }
}

/// A log with pictures.
#[derive(Debug)]
pub(super) struct Log {
    pub name: String,
    pub file: StoredFile,
    pub location: Option<String>,
    /// Names under which its city's map may lie.
    pub map_names: Vec<String>,
    /// The map, where it is there.
    pub map: Option<StoredFile>,
    /// Wanted cameras, clockwise from the front.
    pub cameras: Vec<RigCamera>,
    /// `None`: not annotated.
    pub classes: Option<Classes>,
    pub has_tags: bool,
    pub sets: Vec<PictureSet>,
    /// Rows of wanted cameras whose picture is not there.
    pub absent_pictures: usize,
}

/// Reads one log; `None` where not one of its pictures is there. Without a folder of pictures the database is not opened.
pub(super) fn read_log(config: &NuPlanConfig, store: &Store, log: &LogFile) -> Result<Option<Log>, DataError> {
    if store.list(&join(&config.sensor_blobs, &log.name))?.is_empty() {
        return Ok(None);
    }
    let database = Database::open(&log.file)?;
    let all = read_cameras(&database)?;
    if let Some(unknown) = config.cameras.iter().find(|name| all.iter().all(|camera| camera.1.channel != **name)) {
        return Err(DataError::Config(format!("no camera {unknown:?} in {}", log.file)));
    }
    let wanted = |camera: &RigCamera| config.cameras.is_empty() || config.cameras.contains(&camera.channel);
    let cameras: Vec<RigCamera> = all.iter().map(|camera| camera.1.clone()).filter(wanted).collect();
    let images = read_images(config, store, log, &database, &all, &cameras)?;
    if !images.iter().any(|image| image.exists) {
        return Ok(None);
    }
    let classes = boxes::read_classes(&database, config)?;
    if classes.is_some() {
        boxes::check_boxes(&database)?;
    }
    let tags = read_tags(&database)?;
    let (location, map_names) = read_location(&database)?;
    let mut read = Log {
        name: log.name.clone(),
        file: log.file.clone(),
        location,
        map: maps::find(store, &config.maps, &map_names)?,
        map_names,
        cameras,
        classes,
        has_tags: !tags.is_empty(),
        sets: Vec::new(),
        absent_pictures: images.iter().filter(|image| !image.exists).count(),
    };
    read.sets = SetMaker { config, database: &database, images: &images, tags: &tags }.sets(read.cameras.len())?;
    Ok(Some(read))
}

/// The file name that the release gives a picture.
pub(crate) fn usual_name(log: &str, channel: &str, token: Token) -> String {
    format!("{log}/{channel}/{token}.jpg")
}

/// All rows of the wanted cameras, also those without a file: they tell when a camera exposes.
fn read_images(
    config: &NuPlanConfig,
    store: &Store,
    log: &LogFile,
    database: &Database,
    all: &[(Token, RigCamera)],
    wanted: &[RigCamera],
) -> Result<Vec<ImageRow>, DataError> {
    let slots: HashMap<Token, Option<usize>> = all
        .iter()
        .map(|(token, camera)| (*token, wanted.iter().position(|other| other.channel == camera.channel)))
        .collect();
    let mut folders: HashMap<String, HashSet<String>> = HashMap::new();
    let shift_ns = ns(config.shutter_shift_ms);
    let rows = database.read("image", &["token", "camera_token", "filename_jpg", "timestamp"], |row| {
        let token = row.token(0)?;
        let slot = slots.get(&row.token(1)?).ok_or_else(|| DataError::Dangling {
            table: "image",
            token: token.to_string(),
            field: "camera_token",
            path: database.path().to_owned(),
        })?;
        let name = checked_name(row.text(2)?, database.path())?;
        let Some(camera) = *slot else { return Ok(None) };
        let (folder, file) = name.rsplit_once('/').unwrap_or(("", name));
        if !folders.contains_key(folder) {
            let listed = store.list(&join(&config.sensor_blobs, folder))?;
            folders.insert(folder.to_owned(), listed.into_iter().map(|child| child.name).collect());
        }
        let exists = folders.get(folder).is_some_and(|names| names.contains(file));
        let usual = wanted.get(camera).is_some_and(|camera| usual_name(&log.name, &camera.channel, token) == name);
        let name = (!usual).then(|| name.into());
        Ok(Some(ImageRow { token, camera, time_ns: row.time_ns(3)?.saturating_add(shift_ns), name, exists }))
    })?;
    let mut rows: Vec<ImageRow> = rows.into_iter().flatten().collect();
    rows.sort_by_key(|row| (row.time_ns, row.camera, row.token));
    Ok(rows)
}

/// The city, and the names of its map: releases have put it into either column.
fn read_location(database: &Database) -> Result<(Option<String>, Vec<String>), DataError> {
    if !database.has_table("log")? {
        return Ok((None, Vec::new()));
    }
    let rows = database.read("log", &["token", "location"], |row| Ok(row.text(1)?.to_owned()))?;
    let location = rows.into_iter().next();
    let mut names = Vec::new();
    if database.has_column("log", "map_version")? {
        names = database.read("log", &["token", "map_version"], |row| Ok(row.maybe_text(1)?.map(str::to_owned)))?;
    }
    let mut names: Vec<String> = names.into_iter().take(1).flatten().chain(location.clone()).collect();
    names.dedup();
    Ok((location, names))
}

/// Scenario tags of each lidar turn, sorted and joined.
fn read_tags(database: &Database) -> Result<HashMap<Token, Arc<str>>, DataError> {
    if !database.has_table("scenario_tag")? {
        return Ok(HashMap::new());
    }
    let columns = ["token", "lidar_pc_token", "type"];
    let mut rows = database.read("scenario_tag", &columns, |row| Ok((row.token(1)?, row.text(2)?.to_owned())))?;
    rows.sort();
    rows.dedup();
    let mut interned: HashSet<Arc<str>> = HashSet::new();
    let mut tags = HashMap::new();
    for of_turn in rows.chunk_by(|a, b| a.0 == b.0) {
        let joined = of_turn.iter().map(|row| row.1.as_str()).collect::<Vec<_>>().join(", ");
        let text = interned.get(joined.as_str()).cloned().unwrap_or_else(|| joined.into());
        interned.insert(text.clone());
        tags.extend(of_turn.first().map(|row| (row.0, text)));
    }
    Ok(tags)
}
