//! The small tables: scenes, samples, calibration, categories. They decide which rows of the big ones are wanted.

use std::collections::{HashMap, HashSet};
use std::ops::Range;
use std::path::{Path, PathBuf};

use geometry::{GeometryError, Rigid};

use super::config::{NuScenesConfig, split_scenes};
use super::json::{owned, read_all};
use super::rows::{
    CalibratedSensorRow, CalibratedSensorTable, LogTable, MapTable, SampleTable, SceneTable, SensorTable,
};
use super::token::{Index, Key, index_of};
use crate::DataError;
use crate::store::{Store, StoredFile};

/// Marks a row that exists but is not wanted.
pub(super) const SKIPPED: u32 = u32::MAX;

/// A selected scene.
#[derive(Debug)]
pub(super) struct Scene {
    pub token: Box<str>,
    pub name: Box<str>,
    pub description: Box<str>,
    pub log_token: Box<str>,
    pub logfile: Box<str>,
    pub location: Box<str>,
    /// Its samples in [`Base::samples`], ascending in time.
    pub samples: Range<usize>,
}

/// A sample of a selected scene.
#[derive(Debug)]
pub(super) struct Sample {
    pub token: Box<str>,
    pub time_ns: i64,
    pub scene: u32,
}

/// What a calibrated sensor is to this reader.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Sensor {
    /// A camera that was asked for: its channel's index and its calibration.
    Camera {
        channel: u32,
        ego_from_cam: Rigid,
        /// fx, fy, cx, cy with pixel centres at +0.5.
        focal_center: [f64; 4],
    },
    /// Its key rows give the car's pose at the samples' stamps, its mounting places labels made in its frame.
    Lidar {
        ego_from_lidar: Rigid,
    },
    Unwanted,
}

/// A row of the map table.
#[derive(Debug)]
pub(super) struct Prior {
    /// As written, not checked.
    pub file_name: Box<str>,
    pub log_tokens: Vec<Box<str>>,
}

/// Where the tables and everything they name lie.
#[derive(Debug)]
pub(super) struct Tables {
    pub store: Store,
    version: String,
}

impl Tables {
    /// A table's file; its absence shows when it is read.
    fn file(&self, table: &str) -> StoredFile {
        self.store.expected(&format!("{}/{table}.json", self.version))
    }
}

/// The small tables.
#[derive(Debug)]
pub(super) struct Base {
    pub tables: Tables,
    pub priors: Vec<Prior>,
    pub scenes: Vec<Scene>,
    pub samples: Vec<Sample>,
    /// Sample token to its row in `samples`, or [`SKIPPED`].
    pub sample_rows: Vec<u32>,
    pub sample_index: Index,
    pub sensors: Vec<Sensor>,
    pub sensor_index: Index,
    pub channels: Vec<Box<str>>,
}

impl Base {
    pub fn file(&self, table: &str) -> StoredFile {
        self.tables.file(table)
    }

    /// For messages.
    pub fn path(&self, table: &str) -> PathBuf {
        self.file(table).path().to_owned()
    }

    /// The sample a token names: `None` for one of a scene that is not read.
    ///
    /// # Errors
    /// A token that names no sample.
    pub fn sample(&self, token: &str) -> Result<Option<u32>, ()> {
        let row = self.sample_index.get(Key::of(token)).ok_or(())?;
        let sample = self.sample_rows[row as usize];
        Ok((sample != SKIPPED).then_some(sample))
    }
}

/// Reads and checks them.
pub(super) fn read_base(config: &NuScenesConfig) -> Result<Base, DataError> {
    let store = Store::open_all(&config.root)?;
    if store.list(&config.version)?.is_empty() {
        return Err(DataError::Missing { what: "table folder".to_owned(), path: store.path(&config.version) });
    }
    let tables = Tables { store, version: config.version.clone() };
    let (channels, sensors, sensor_index) = read_sensors(config, &tables)?;
    let priors = read_all::<MapTable, _, _>(&tables.file("map"), |row| {
        let logs = row.log_tokens.iter().map(owned).collect();
        Ok(row.filename.map(|name| Prior { file_name: owned(&name), log_tokens: logs }))
    })?;
    let (mut scenes, scene_rows, scene_index, ends) = read_scenes(config, &tables)?;
    let (samples, sample_rows, sample_index) = read_samples(&tables, &mut scenes, &scene_rows, &scene_index)?;
    let base = Base { tables, scenes, samples, sample_rows, sample_index, sensors, sensor_index, channels, priors };
    check_ends(&base, &ends)?;
    Ok(base)
}

type Sensors = (Vec<Box<str>>, Vec<Sensor>, Index);

fn read_sensors(config: &NuScenesConfig, tables: &Tables) -> Result<Sensors, DataError> {
    let file = tables.file("sensor");
    let path = file.path().to_owned();
    let rows = read_all::<SensorTable, _, _>(&file, |row| {
        Ok(Some((owned(&row.token), owned(&row.channel), owned(&row.modality))))
    })?;
    let index = index_of(rows.iter().map(|row| &*row.0), "sensor", &path)?;
    if let Some(unknown) =
        config.cameras.iter().find(|name| !rows.iter().any(|row| *row.1 == ***name && &*row.2 == "camera"))
    {
        return Err(DataError::Config(format!("no camera {unknown:?} in {}", path.display())));
    }
    let wanted = |channel: &str| config.cameras.is_empty() || config.cameras.iter().any(|name| name == channel);
    let channels: Vec<Box<str>> = rows.iter().map(|row| row.1.clone()).collect();
    let file = tables.file("calibrated_sensor");
    let path = file.path().to_owned();
    let parsed = read_all::<CalibratedSensorTable, _, _>(&file, |row| {
        let Some(at) = index.get(Key::of(row.sensor_token.as_str())) else {
            return Err(DataError::Dangling {
                table: "calibrated_sensor",
                token: row.token.as_str().to_owned(),
                field: "sensor_token",
                path: path.clone(),
            });
        };
        let (_, channel, modality) = &rows[at as usize];
        let sensor = match &**modality {
            "camera" if wanted(channel) => camera(at, &row, &path)?,
            "lidar" => Sensor::Lidar { ego_from_lidar: mounting(&row, &path)? },
            _ => Sensor::Unwanted,
        };
        Ok(Some((owned(&row.token), sensor)))
    })?;
    let index = index_of(parsed.iter().map(|row| &*row.0), "calibrated_sensor", &path)?;
    Ok((channels, parsed.into_iter().map(|row| row.1).collect(), index))
}

/// The tables follow OpenCV (an integer coordinate is a pixel's centre); here centres lie at +0.5.
fn camera(channel: u32, row: &CalibratedSensorRow<'_>, path: &Path) -> Result<Sensor, DataError> {
    let token = || row.token.as_str().to_owned();
    let bad = |source| DataError::Calibration { row: token(), source, path: path.to_owned() };
    let ego_from_cam = mounting(row, path)?;
    let &[[fx, skew, cx], [zero, fy, cy], last] = row.camera_intrinsic.as_slice() else {
        let why = format!("camera_intrinsic of row {} is not a 3x3 matrix", token());
        return Err(DataError::Json { why, path: path.to_owned() });
    };
    for (what, value) in [("focal length fx", fx), ("focal length fy", fy)] {
        if value <= 1e-9 {
            return Err(bad(GeometryError::NotPositive { what, value }));
        }
    }
    if skew != 0.0 || zero != 0.0 || last != [0.0, 0.0, 1.0] {
        let why = format!("camera_intrinsic of row {} is not the matrix of a pinhole without skew", token());
        return Err(DataError::Json { why, path: path.to_owned() });
    }
    Ok(Sensor::Camera { channel, ego_from_cam, focal_center: [fx, fy, cx + 0.5, cy + 0.5] })
}

fn mounting(row: &CalibratedSensorRow<'_>, path: &Path) -> Result<Rigid, DataError> {
    Rigid::from_wxyz(row.rotation, row.translation).map_err(|source| DataError::Calibration {
        row: row.token.as_str().to_owned(),
        source,
        path: path.to_owned(),
    })
}

/// First and last sample token of each selected scene.
type Ends = Vec<[Box<str>; 2]>;
/// The selected scenes, the row of every scene of the table in them, its index, and the selected scenes' ends.
type Scenes = (Vec<Scene>, Vec<u32>, Index, Ends);

fn read_scenes(config: &NuScenesConfig, tables: &Tables) -> Result<Scenes, DataError> {
    let file = tables.file("log");
    let path = file.path().to_owned();
    let logs = read_all::<LogTable, _, _>(&file, |row| {
        Ok(Some((owned(&row.token), owned(&row.logfile), owned(&row.location))))
    })?;
    let log_index = index_of(logs.iter().map(|row| &*row.0), "log", &path)?;
    let file = tables.file("scene");
    let path = file.path().to_owned();
    let rows = read_all::<SceneTable, _, _>(&file, |row| {
        let log = log_index.get(Key::of(row.log_token.as_str())).ok_or_else(|| DataError::Dangling {
            table: "scene",
            token: row.token.as_str().to_owned(),
            field: "log_token",
            path: path.clone(),
        })?;
        let scene = Scene {
            token: owned(&row.token),
            name: owned(&row.name),
            description: owned(&row.description),
            log_token: owned(&row.log_token),
            logfile: logs[log as usize].1.clone(),
            location: logs[log as usize].2.clone(),
            samples: 0..0,
        };
        Ok(Some((owned(&row.token), scene, [owned(&row.first_sample_token), owned(&row.last_sample_token)])))
    })?;
    let index = index_of(rows.iter().map(|row| &*row.0), "scene", &path)?;
    let order = select(config, rows.iter().map(|row| &*row.1.name), &path)?;
    let mut scene_rows = vec![SKIPPED; rows.len()];
    order.iter().zip(0u32..).for_each(|(row, position)| scene_rows[*row] = position);
    let mut rows: Vec<_> = rows.into_iter().map(Some).collect();
    let taken = order.iter().filter_map(|row| rows[*row].take());
    let (scenes, ends) = taken.map(|(_, scene, ends)| (scene, ends)).unzip();
    Ok((scenes, scene_rows, index, ends))
}

/// Rows of the scenes to read, in the order of the split list.
fn select<'a>(
    config: &NuScenesConfig,
    names: impl Iterator<Item = &'a str>,
    path: &Path,
) -> Result<Vec<usize>, DataError> {
    let names: Vec<&str> = names.collect();
    let row_of: HashMap<&str, usize> = names.iter().enumerate().map(|(row, name)| (*name, row)).collect();
    if row_of.len() < names.len() {
        return Err(DataError::Json { why: "two scenes have the same name".to_owned(), path: path.to_owned() });
    }
    let split: Vec<usize> = if config.split == "all" {
        (0..names.len()).collect()
    } else {
        let list = split_scenes(&config.split)
            .ok_or_else(|| DataError::Config(format!("{:?} is no split of this dataset", config.split)))?;
        list.iter().filter_map(|name| row_of.get(name.as_str()).copied()).collect()
    };
    if split.is_empty() && config.split != "all" {
        return Err(DataError::Empty {
            what: format!("split {:?} of {}", config.split, config.version),
            path: path.to_owned(),
        });
    }
    if config.scenes.is_empty() {
        return Ok(split);
    }
    let in_split: HashSet<usize> = split.into_iter().collect();
    let mut chosen = Vec::new();
    for name in &config.scenes {
        match row_of.get(name.as_str()).filter(|row| in_split.contains(row)) {
            Some(row) if chosen.contains(row) => {
                return Err(DataError::Config(format!("scene {name:?} is listed twice")));
            }
            Some(row) => chosen.push(*row),
            None => {
                let what = format!("scene {name:?} in split {:?} of {}", config.split, config.version);
                return Err(DataError::Empty { what, path: path.to_owned() });
            }
        }
    }
    Ok(chosen)
}

type Samples = (Vec<Sample>, Vec<u32>, Index);

/// All samples for the index, those of selected scenes ordered by scene and time.
fn read_samples(
    tables: &Tables,
    scenes: &mut [Scene],
    scene_rows: &[u32],
    scene_index: &Index,
) -> Result<Samples, DataError> {
    let file = tables.file("sample");
    let path = file.path().to_owned();
    let rows = read_all::<SampleTable, _, _>(&file, |row| {
        let scene = scene_index.get(Key::of(row.scene_token.as_str())).ok_or_else(|| DataError::Dangling {
            table: "sample",
            token: row.token.as_str().to_owned(),
            field: "scene_token",
            path: path.clone(),
        })?;
        Ok(Some(Sample { token: owned(&row.token), time_ns: row.timestamp.0, scene: scene_rows[scene as usize] }))
    })?;
    let index = index_of(rows.iter().map(|row| &*row.token), "sample", &path)?;
    let mut order: Vec<usize> = (0..rows.len()).filter(|row| rows[*row].scene != SKIPPED).collect();
    order.sort_by_key(|row| (rows[*row].scene, rows[*row].time_ns));
    let mut sample_rows = vec![SKIPPED; rows.len()];
    order.iter().zip(0u32..).for_each(|(row, position)| sample_rows[*row] = position);
    let mut rows: Vec<_> = rows.into_iter().map(Some).collect();
    let samples: Vec<Sample> = order.iter().filter_map(|row| rows[*row].take()).collect();
    let mut start = 0;
    for (position, scene) in scenes.iter_mut().enumerate() {
        let count = samples[start..].iter().take_while(|sample| sample.scene as usize == position).count();
        scene.samples = start..start + count;
        start += count;
    }
    Ok((samples, sample_rows, index))
}

/// A scene's first and last token must name its earliest and latest sample.
fn check_ends(base: &Base, ends: &[[Box<str>; 2]]) -> Result<(), DataError> {
    let path = base.path("scene");
    for (scene, tokens) in base.scenes.iter().zip(ends) {
        let fields = [
            ("first_sample_token", scene.samples.clone().next()),
            ("last_sample_token", scene.samples.clone().next_back()),
        ];
        for (token, (field, want)) in tokens.iter().zip(fields) {
            let named = base.sample(token).map_err(|()| DataError::Dangling {
                table: "scene",
                token: scene.name.to_string(),
                field,
                path: path.clone(),
            })?;
            if named.map(|row| row as usize) != want {
                let why = format!("{field} of {} is not at that end of its samples in time", scene.name);
                return Err(DataError::Json { why, path: path.clone() });
            }
        }
    }
    Ok(())
}
