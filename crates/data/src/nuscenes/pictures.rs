//! The pictures that are wanted and the car's pose at each of them: the two largest tables, reduced while they stream by.

use std::path::{Component, Path};

use geometry::glam::{DQuat, DVec3};
use geometry::{GeometryError, Rigid};

use super::config::{FrameChoice, NuScenesConfig, PictureTime};
use super::json::read_table;
use super::rows::{EgoPoseTable, SampleDataRow, SampleDataTable};
use super::tables::{Base, Sensor};
use super::token::{Index, Key, Names, odd_text};
use crate::DataError;

/// One wanted picture.
#[derive(Debug, Clone, Copy)]
pub(super) struct Picture {
    pub time_ns: i64,
    /// Row in [`Pictures::poses`].
    pub pose: u32,
    /// Row of the calibration table.
    pub sensor: u32,
    /// The sample it belongs to; a sweep belongs to the sample that follows it.
    pub sample: u32,
    pub size: (u32, u32),
    pub is_key: bool,
    /// Where its file name stands; `None` when the name follows the release's pattern.
    name: Option<u32>,
}

/// The lidar key row of a sample. Its points are never read.
#[derive(Debug)]
pub(super) struct LidarRow {
    pub token: Box<str>,
    /// As written, not checked.
    pub file_name: Box<str>,
    /// Row in [`Pictures::poses`].
    pub pose: u32,
    /// Row of the calibration table.
    pub sensor: u32,
}

/// One pose row of the car.
#[derive(Debug, Clone, Copy)]
pub(super) struct Pose {
    pub time_ns: i64,
    pub world_from_ego: Rigid,
}

/// The pictures of the selected scenes and cameras.
#[derive(Debug)]
pub(super) struct Pictures {
    /// Ordered by scene, channel, time.
    pub rows: Vec<Picture>,
    pub poses: Vec<Pose>,
    /// For each sample, its lidar key row.
    pub lidar: Vec<Option<LidarRow>>,
    /// File names that cannot be rebuilt.
    names: Vec<Box<str>>,
}

impl Pictures {
    /// Path inside the dataset's folder.
    pub fn file_name(&self, picture: &Picture, base: &Base) -> String {
        match picture.name {
            Some(row) => self.names[row as usize].to_string(),
            None => usual_name(base, picture),
        }
    }
}

/// A row of `sample_data` that is wanted: a picture, or a lidar key row for its pose.
struct Kept {
    key: Key,
    odd: Option<Box<str>>,
    pose: Key,
    name: Option<Box<str>>,
    picture: Picture,
    is_lidar: bool,
}

/// Reads `sample_data`, then the pose rows it needs.
pub(super) fn read_pictures(config: &NuScenesConfig, base: &Base) -> Result<Pictures, DataError> {
    let file = base.file("sample_data");
    let path = file.path().to_owned();
    let mut kept: Vec<Kept> = Vec::new();
    read_table::<SampleDataTable, _, _, _>(
        &file,
        |row| keep_row(&row, config, base, &path),
        |part| {
            kept.extend(part);
            Ok(())
        },
    )?;
    let mut names = Names::default();
    kept.iter_mut().for_each(|row| names.insert(row.key, row.odd.take()));
    Index::new(kept.iter().map(|row| row.key)).map_err(|row| DataError::DuplicateToken {
        table: "sample_data",
        token: names.text(kept[row].key),
        path: path.clone(),
    })?;
    let mut wanted: Vec<Key> = kept.iter().map(|row| row.pose).collect();
    wanted.sort_unstable();
    wanted.dedup();
    let poses = read_poses(base, &wanted)?;
    let mut found = Pictures {
        rows: Vec::new(),
        poses: poses.iter().map(|pose| pose.unwrap_or(NO_POSE)).collect(),
        lidar: (0..base.samples.len()).map(|_| None).collect(),
        names: Vec::new(),
    };
    for row in kept {
        let pose = wanted.binary_search(&row.pose).ok().filter(|at| poses[*at].is_some()).ok_or_else(|| {
            DataError::Dangling {
                table: "sample_data",
                token: names.text(row.key),
                field: "ego_pose_token",
                path: path.clone(),
            }
        })?;
        let token = names.text(row.key);
        found.add(row, token, pose, base, config.timestamps);
    }
    found.rows.sort_by_key(|row| (base.samples[row.sample as usize].scene, channel(base, row), row.time_ns));
    Ok(found)
}

/// Stands where a pose row was asked for and not found; no picture ever refers to it.
const NO_POSE: Pose = Pose { time_ns: 0, world_from_ego: Rigid { rotation: DQuat::IDENTITY, translation: DVec3::NAN } };

impl Pictures {
    fn add(&mut self, row: Kept, token: String, pose: usize, base: &Base, time: PictureTime) {
        let mut picture = row.picture;
        if row.is_lidar {
            let file_name = row.name.unwrap_or_default();
            let row = LidarRow { token: token.into(), file_name, pose: pose as u32, sensor: picture.sensor };
            self.lidar[picture.sample as usize] = Some(row);
            return;
        }
        picture.pose = pose as u32;
        let mut name = row.name;
        let exposure_ns = self.poses[pose].time_ns;
        if time == PictureTime::RealTime && exposure_ns != picture.time_ns {
            // The pattern holds the written stamp, which is forgotten here.
            name = name.or_else(|| Some(usual_name(base, &picture).into()));
            picture.time_ns = exposure_ns;
        }
        picture.name = name.map(|name| {
            self.names.push(name);
            self.names.len() as u32 - 1
        });
        self.rows.push(picture);
    }
}

/// Channel index of a picture.
pub(super) fn channel(base: &Base, picture: &Picture) -> u32 {
    match base.sensors[picture.sensor as usize] {
        Sensor::Camera { channel, .. } => channel,
        Sensor::Lidar { .. } | Sensor::Unwanted => u32::MAX,
    }
}

/// The release's naming pattern.
fn usual_name(base: &Base, picture: &Picture) -> String {
    let channel = base.channels.get(channel(base, picture) as usize).map_or("", |name| name);
    let log = &base.scenes[base.samples[picture.sample as usize].scene as usize].logfile;
    let folder = if picture.is_key { "samples" } else { "sweeps" };
    format!("{folder}/{channel}/{log}__{channel}__{}.jpg", picture.time_ns / 1000)
}

/// Decides about one row; everything that is not needed is gone after this call.
fn keep_row(
    row: &SampleDataRow<'_>,
    config: &NuScenesConfig,
    base: &Base,
    path: &Path,
) -> Result<Option<Kept>, DataError> {
    let token = row.token.as_str();
    let dangling =
        |field| DataError::Dangling { table: "sample_data", token: token.to_owned(), field, path: path.to_owned() };
    let sensor = base.sensor_index.get(Key::of(row.calibrated_sensor_token.as_str()));
    let sensor = sensor.ok_or_else(|| dangling("calibrated_sensor_token"))?;
    let kind = base.sensors[sensor as usize];
    let is_camera = matches!(kind, Sensor::Camera { .. });
    let all_pictures = matches!(config.frames, FrameChoice::AllPictures { .. });
    if kind == Sensor::Unwanted || !(row.is_key_frame || is_camera && all_pictures) {
        return Ok(None);
    }
    let sample = base.sample(row.sample_token.as_str()).map_err(|()| dangling("sample_token"))?;
    let Some(sample) = sample else { return Ok(None) };
    let picture = Picture {
        time_ns: row.timestamp.0,
        pose: 0,
        sensor,
        sample,
        size: (row.width.unwrap_or(0), row.height.unwrap_or(0)),
        is_key: row.is_key_frame,
        name: None,
    };
    let mut name = Some(row.filename.as_str().into());
    if is_camera {
        check_relative(row.filename.as_str(), path)?;
        check_size(&picture, token, path)?;
        let usual = row.timestamp.0 % 1000 == 0 && usual_name(base, &picture) == row.filename.as_str();
        name = (!usual).then(|| row.filename.as_str().into());
    }
    Ok(Some(Kept {
        key: Key::of(token),
        odd: odd_text(token),
        pose: Key::of(row.ego_pose_token.as_str()),
        name,
        picture,
        is_lidar: !is_camera,
    }))
}

fn check_size(picture: &Picture, token: &str, path: &Path) -> Result<(), DataError> {
    for (what, value) in [("picture width", picture.size.0), ("picture height", picture.size.1)] {
        if value == 0 {
            let source = GeometryError::NotPositive { what, value: 0.0 };
            return Err(DataError::Calibration { row: token.to_owned(), source, path: path.to_owned() });
        }
    }
    Ok(())
}

/// Names inside the tables are not trusted: they must stay below the dataset's folder on every operating system.
pub(super) fn check_relative(name: &str, table: &Path) -> Result<(), DataError> {
    let plain = Path::new(name).components().all(|part| matches!(part, Component::Normal(_)));
    let drive = name.as_bytes().get(1) == Some(&b':');
    if name.is_empty() || !plain || drive || name.contains(['\\', '\0']) {
        return Err(DataError::UnsafePath { text: name.to_owned(), path: table.to_owned() });
    }
    Ok(())
}

/// The wanted pose rows, in the order of `wanted` (ascending keys).
fn read_poses(base: &Base, wanted: &[Key]) -> Result<Vec<Option<Pose>>, DataError> {
    let file = base.file("ego_pose");
    let path = file.path().to_owned();
    let mut poses: Vec<Option<Pose>> = vec![None; wanted.len()];
    read_table::<EgoPoseTable, _, _, _>(
        &file,
        |row| {
            let token = row.token.as_str();
            let Ok(at) = wanted.binary_search(&Key::of(token)) else { return Ok(None) };
            let world_from_ego = Rigid::from_wxyz(row.rotation, row.translation)
                .map_err(|source| DataError::Calibration { row: token.to_owned(), source, path: path.clone() })?;
            Ok(Some((at, odd_text(token), Pose { time_ns: row.timestamp.0, world_from_ego })))
        },
        |part| {
            for (at, odd, pose) in part {
                if poses[at].replace(pose).is_some() {
                    let mut names = Names::default();
                    names.insert(wanted[at], odd);
                    let token = names.text(wanted[at]);
                    return Err(DataError::DuplicateToken { table: "ego_pose", token, path: path.clone() });
                }
            }
            Ok(())
        },
    )?;
    Ok(poses)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_plain_relative_names_pass() {
        let table = Path::new("sample_data.json");
        for good in ["samples/CAM/a+b__1.jpg", "a.jpg", "deep/er/..name/x.jpg"] {
            check_relative(good, table).unwrap();
        }
        let bad = ["", "/etc/passwd", "../x", "a/../../x", "C:/x", "c:x", "a\\b", "\\\\host\\x", "a\0b", "a/.."];
        for name in bad {
            let error = check_relative(name, table).unwrap_err();
            assert!(matches!(&error, DataError::UnsafePath { text, .. } if text == name), "{name:?} gave {error:?}");
        }
    }
}
