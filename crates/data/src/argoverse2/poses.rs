//! Where the car and its cameras are.

use geometry::{GeometryError, Intrinsics, Lens, PoseTrack, RigCamera, Rigid};

use super::feather::Table;
use crate::DataError;
use crate::store::Store;

/// The car's poses in the city, one row per picture and lidar stamp.
#[derive(Debug)]
pub(super) struct Poses {
    track: PoseTrack,
    /// Name of the table inside the dataset.
    table: String,
}

impl Poses {
    pub fn read(store: &Store, log: &str, max_gap_ns: i64) -> Result<Self, DataError> {
        let table = format!("{log}/city_SE3_egovehicle.feather");
        let columns = [&["timestamp_ns"], &POSE[..]].concat();
        let rows = Table::read(&store.file(&table, "poses of the car")?, &columns)?;
        let stamps = rows.integers("timestamp_ns")?;
        let mut poses: Vec<(i64, Rigid)> = stamps.into_iter().zip(pose_columns(&rows)?).collect();
        poses.sort_by_key(|row| row.0);
        poses.dedup();
        if let Some(twice) = poses.windows(2).find_map(|pair| match pair {
            [a, b] if a.0 == b.0 => Some(a.0),
            _ => None,
        }) {
            let token = twice.to_string();
            return Err(DataError::DuplicateToken { table: "city_SE3_egovehicle", token, path: store.path(&table) });
        }
        Ok(Self { track: PoseTrack::new(poses, max_gap_ns), table })
    }

    /// The exact row of a stamp, else between the rows around it.
    pub fn at(&self, timestamp_ns: i64) -> Result<Rigid, GeometryError> {
        self.track.at(timestamp_ns)
    }

    /// As [`Poses::at`], for something that the error names.
    pub fn of(&self, what: &str, timestamp_ns: i64, store: &Store) -> Result<Rigid, DataError> {
        self.at(timestamp_ns).map_err(|source| DataError::Calibration {
            row: format!("of {what}"),
            source,
            path: store.path(&self.table),
        })
    }
}

/// The cameras of a log that have both intrinsics and a mounting pose, in the wanted order.
///
/// The numbers k1 to k3 of the table describe the lens before the pictures were rectified, so they play no part.
pub(super) fn read_rig(store: &Store, log: &str, wanted: &[&str]) -> Result<Vec<RigCamera>, DataError> {
    let file = |name: &str| store.file(&format!("{log}/calibration/{name}.feather"), "calibration");
    let mounts = Table::read(&file("egovehicle_SE3_sensor")?, &[&["sensor_name"], &POSE[..]].concat())?;
    let names = mounts.texts("sensor_name")?;
    let poses = pose_columns(&mounts)?;
    let lenses = Table::read(&file("intrinsics")?, &INTRINSICS)?;
    let lens_names = lenses.texts("sensor_name")?;
    let intrinsics = intrinsic_rows(&lenses)?;
    let mut cameras = Vec::new();
    for channel in wanted {
        let row = |names: &super::feather::Texts| (0..names.rows.len()).find(|row| names.get(*row) == *channel);
        let mount = row(&names).and_then(|row| poses.get(row));
        let lens = row(&lens_names).and_then(|row| intrinsics.get(row));
        let (Some(ego_from_cam), Some(intrinsics)) = (mount, lens) else { continue };
        cameras.push(RigCamera {
            channel: (*channel).to_owned(),
            intrinsics: *intrinsics,
            lens: Lens::Pinhole,
            ego_from_cam: *ego_from_cam,
        });
    }
    Ok(cameras)
}

const POSE: [&str; 7] = ["qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m"];
const INTRINSICS: [&str; 7] = ["sensor_name", "fx_px", "fy_px", "cx_px", "cy_px", "height_px", "width_px"];

/// The rigid transforms of a table's rows.
pub(super) fn pose_columns(table: &Table) -> Result<Vec<Rigid>, DataError> {
    let [qw, qx, qy, qz, tx, ty, tz] = POSE.map(|name| table.floats(name));
    let rotations = qw?.into_iter().zip(qx?).zip(qy?).zip(qz?).map(|(((w, x), y), z)| [w, x, y, z]);
    let translations = tx?.into_iter().zip(ty?).zip(tz?).map(|((x, y), z)| [x, y, z]);
    let rows = rotations.zip(translations).enumerate();
    rows.map(|(row, (rotation, translation))| {
        Rigid::from_wxyz(rotation, translation).map_err(|source| bad_row(table, row, source))
    })
    .collect()
}

fn intrinsic_rows(table: &Table) -> Result<Vec<Intrinsics>, DataError> {
    let [fx, fy, cx, cy] = ["fx_px", "fy_px", "cx_px", "cy_px"].map(|name| table.floats(name));
    let [width, height] = ["width_px", "height_px"].map(|name| table.integers(name));
    let numbers = fx?.into_iter().zip(fy?).zip(cx?.into_iter().zip(cy?)).zip(width?.into_iter().zip(height?));
    let rows = numbers.enumerate().map(|(row, (((fx, fy), (cx, cy)), (width, height)))| {
        // A size that no picture has becomes 0 and is refused as such.
        let size = |value: i64| u32::try_from(value).unwrap_or(0);
        // Files follow OpenCV: integer coordinates are pixel centres.
        let intrinsics = Intrinsics { fx, fy, cx: cx + 0.5, cy: cy + 0.5, width: size(width), height: size(height) };
        intrinsics.checked().map_err(|source| bad_row(table, row, source))
    });
    rows.collect()
}

fn bad_row(table: &Table, row: usize, source: GeometryError) -> DataError {
    DataError::Calibration { row: row.to_string(), source, path: table.path().to_owned() }
}
