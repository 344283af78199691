//! The rows of a segment, component by component.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use geometry::{RigCamera, Rigid};

use super::{CAMERA, CONTEXT, INTRINSIC, OBJECT, STAMP, Segment, column};
use crate::parquet_file::{Columns, ParquetFile};
use crate::store::StoredFile;
use crate::waymo::cameras::{self, StoredCamera};
use crate::waymo::config::WaymoConfig;
use crate::waymo::raw::{RawBox, RawPicture, checked_micros, joined_text, picture_ns};
use crate::{DataError, EmbeddedPicture};

impl Segment {
    /// Fails for a stamp that no pose row has; excluded frames have rows that are not wanted.
    fn known(&self, config: &WaymoConfig, table: &'static str, micros: i64, path: &Path) -> Result<bool, DataError> {
        if config.excludes(micros) {
            return Ok(false);
        }
        match self.frames.binary_search_by_key(&micros, |frame| frame.0) {
            Ok(_) => Ok(true),
            Err(_) => {
                let token = micros.to_string();
                Err(DataError::Dangling { table, token, field: STAMP, path: path.to_owned() })
            }
        }
    }

    pub(super) fn read_pictures(&self, config: &WaymoConfig) -> Result<BTreeMap<i64, Vec<RawPicture>>, DataError> {
        let table = ParquetFile::open(self.images.clone())?;
        let field = |name: &str| column("CameraImage", name);
        let (image, pose, time) = (field("image"), field("pose.transform"), field("pose_timestamp"));
        if !table.has(&image) {
            let path = table.path().to_owned();
            return Err(DataError::Column { column: image, why: "there is none".to_owned(), path });
        }
        let image: Arc<str> = image.into();
        let columns = read(&table, &self.name, &[STAMP, CAMERA, &pose, &time])?;
        let times = columns.filled(&time, columns.floats(&time)?)?;
        let poses = columns.filled(&pose, columns.lists(&pose)?)?;
        let keys = stamps(&columns)?.into_iter().zip(camera_numbers(&columns)?);
        let mut pictures: BTreeMap<i64, Vec<RawPicture>> = BTreeMap::new();
        for (row, ((micros, camera), (secs, pose))) in keys.zip(times.into_iter().zip(poses)).enumerate() {
            let path = columns.path();
            if !self.known(config, "camera_image", micros, path)? {
                continue;
            }
            if !self.calibrated.contains(&camera) {
                let token = format!("{micros} camera {camera}");
                return Err(DataError::Dangling { table: "camera_image", token, field: CAMERA, path: path.to_owned() });
            }
            pictures.entry(micros).or_default().push(RawPicture {
                camera,
                timestamp_ns: picture_ns(secs, path)?,
                world_from_ego: pose_of("picture pose", &pose, &format!("{micros} camera {camera}"), path)?,
                picture: EmbeddedPicture::in_table(table.clone(), image.clone(), row),
            });
        }
        Ok(pictures)
    }

    pub(super) fn read_boxes(
        &self,
        config: &WaymoConfig,
        file: StoredFile,
    ) -> Result<BTreeMap<i64, Vec<RawBox>>, DataError> {
        let field = |name: &str| column("LiDARBox", name);
        let sides = ["center.x", "center.y", "center.z", "size.x", "size.y", "size.z", "heading"];
        let numbers = sides.map(|side| field(&format!("box.{side}")));
        let speeds = ["x", "y", "z"].map(|axis| field(&format!("speed.{axis}")));
        let (kind, points) = (field("type"), field("num_lidar_points_in_box"));
        let table = ParquetFile::open(file)?;
        let optional = speeds.iter().chain([&points]).filter(|name| table.has(name));
        let names: Vec<&str> = numbers.iter().chain([&kind]).chain(optional).map(String::as_str).collect();
        let columns = read(&table, &self.name, &[&[STAMP, OBJECT], &names[..]].concat())?;
        let floats = |name: &String| columns.filled(name, columns.floats(name)?);
        let [x, y, z, length, width, height, heading] = try_map(&numbers, floats)?;
        let optional = |name: &String| if table.has(name) { columns.floats(name) } else { Ok(vec![None; x.len()]) };
        let [vx, vy, vz] = try_map(&speeds, optional)?;
        let kinds = columns.filled(&kind, columns.integers(&kind)?)?;
        let points = if table.has(&points) { columns.integers(&points)? } else { vec![None; x.len()] };
        let ids = columns.filled(OBJECT, columns.texts(OBJECT)?)?;
        let mut boxes: BTreeMap<i64, Vec<RawBox>> = BTreeMap::new();
        for (row, (micros, id)) in stamps(&columns)?.into_iter().zip(ids).enumerate() {
            if !self.known(config, "lidar_box", micros, columns.path())? {
                continue;
            }
            let of_row = |columns: [&Vec<f64>; 3]| columns.map(|values| values.get(row).copied().unwrap_or(f64::NAN));
            let speed = |values: &Vec<Option<f64>>| values.get(row).copied().flatten();
            boxes.entry(micros).or_default().push(RawBox {
                center: of_row([&x, &y, &z]),
                size: of_row([&length, &width, &height]),
                heading: heading.get(row).copied().unwrap_or(f64::NAN),
                kind: kinds.get(row).copied().unwrap_or(-1),
                id,
                points: points.get(row).copied().flatten(),
                world_velocity: speed(&vx).zip(speed(&vy)).map(|(x, y)| [x, y, speed(&vz).unwrap_or(0.0)]),
            });
        }
        Ok(boxes)
    }

    pub(super) fn read_texts(&self, file: StoredFile) -> Result<BTreeMap<i64, Option<String>>, DataError> {
        let names = ["time_of_day", "location", "weather"].map(|name| column("Stats", name));
        let table = ParquetFile::open(file)?;
        let [day, place, weather] = &names;
        let columns = read(&table, &self.name, &[STAMP, day, place, weather])?;
        let [day, place, weather] = try_map(&names, |name| columns.texts(name))?;
        let words = day.iter().zip(&place).zip(&weather);
        let text = |((day, place), weather): ((&Option<String>, &Option<String>), &Option<String>)| {
            joined_text([day.as_deref(), place.as_deref(), weather.as_deref()])
        };
        Ok(stamps(&columns)?.into_iter().zip(words.map(text)).collect())
    }
}

/// All frames of a segment in order of time.
pub(super) fn read_poses(segment: &str, file: StoredFile) -> Result<Vec<(i64, Rigid)>, DataError> {
    let transform = column("VehiclePose", "world_from_vehicle.transform");
    let columns = read(&ParquetFile::open(file)?, segment, &[STAMP, &transform])?;
    let poses = columns.filled(&transform, columns.lists(&transform)?)?;
    let mut frames = Vec::with_capacity(poses.len());
    for (micros, pose) in stamps(&columns)?.into_iter().zip(poses) {
        frames.push((micros, pose_of("vehicle pose", &pose, &micros.to_string(), columns.path())?));
    }
    frames.sort_by_key(|frame| frame.0);
    if let Some(twice) = frames.windows(2).find(|pair| pair[0].0 == pair[1].0) {
        let token = twice[0].0.to_string();
        return Err(DataError::DuplicateToken { table: "vehicle_pose", token, path: columns.path().to_owned() });
    }
    Ok(frames)
}

pub(super) fn read_calibration(segment: &str, file: StoredFile) -> Result<Vec<RigCamera>, DataError> {
    let field = |name: &str| column("CameraCalibration", name);
    let names = INTRINSIC.map(|name| field(&format!("intrinsic.{name}")));
    let (pose, width, height) = (field("extrinsic.transform"), field("width"), field("height"));
    let mut wanted = vec![CAMERA, &pose, &width, &height];
    wanted.extend(names.iter().map(String::as_str));
    let columns = read(&ParquetFile::open(file)?, segment, &wanted)?;
    let intrinsics = try_map(&names, |name| columns.filled(name, columns.floats(name)?))?;
    let poses = columns.filled(&pose, columns.lists(&pose)?)?;
    let side = |name: &str| columns.filled(name, columns.integers(name)?);
    let sizes = side(&width)?.into_iter().zip(side(&height)?);
    let mut rig: Vec<RigCamera> = Vec::new();
    for (row, ((number, pose), size)) in camera_numbers(&columns)?.into_iter().zip(poses).zip(sizes).enumerate() {
        let intrinsic: Vec<f64> = intrinsics.iter().filter_map(|values| values.get(row).copied()).collect();
        let stored = StoredCamera { number, intrinsic: &intrinsic, vehicle_from_camera: &pose, size };
        rig.push(stored.rig_camera(columns.path())?);
    }
    Ok(rig)
}

/// Columns of a component, whose rows must all belong to the segment that names the file.
fn read(table: &ParquetFile, segment: &str, names: &[&str]) -> Result<Columns, DataError> {
    let columns = table.columns(&[&[CONTEXT], names].concat())?;
    match columns.texts(CONTEXT)?.into_iter().find(|context| context.as_deref() != Some(segment)) {
        None => Ok(columns),
        Some(other) => Err(columns.bad(CONTEXT, &format!("{:?} in the file of {segment}", other.unwrap_or_default()))),
    }
}

fn stamps(columns: &Columns) -> Result<Vec<i64>, DataError> {
    let stamps = columns.filled(STAMP, columns.integers(STAMP)?)?;
    stamps.into_iter().map(|micros| checked_micros(micros, columns.path())).collect()
}

/// Camera numbers from a column of numbers or of names: both occur.
fn camera_numbers(columns: &Columns) -> Result<Vec<i64>, DataError> {
    let checked =
        |name: String, number: Option<i64>| number.ok_or_else(|| cameras::unknown_camera(&name, columns.path()));
    if let Ok(names) = columns.texts(CAMERA) {
        let names = columns.filled(CAMERA, names)?.into_iter();
        return names.map(|name| checked(name.clone(), cameras::number(&name))).collect();
    }
    let numbers = columns.filled(CAMERA, columns.integers(CAMERA)?)?.into_iter();
    numbers.map(|number| checked(number.to_string(), cameras::channel(number).map(|_| number))).collect()
}

fn pose_of(what: &'static str, numbers: &[f64], row: &str, path: &Path) -> Result<Rigid, DataError> {
    cameras::pose(what, numbers).map_err(|source| DataError::Calibration {
        row: row.to_owned(),
        source,
        path: path.to_owned(),
    })
}

/// The results for each item, or the first error.
fn try_map<T, U, const N: usize>(
    items: &[T; N],
    map: impl Fn(&T) -> Result<Vec<U>, DataError>,
) -> Result<[Vec<U>; N], DataError> {
    let mut error = None;
    let results = std::array::from_fn(|index| match map(&items[index]) {
        Ok(values) => values,
        Err(found) => {
            error.get_or_insert(found);
            Vec::new()
        }
    });
    error.map_or(Ok(results), Err)
}
