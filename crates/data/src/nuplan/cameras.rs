//! The cameras of a log: pickled calibration in the `camera` table.

use geometry::{Camera, CameraRig, Intrinsics, Lens, RigCamera, Rigid};

use super::database::{Database, Row};
use super::token::Token;
use crate::DataError;
use pickle::{Rules, Value, decode};

/// The classes that calibration is pickled with; all are lists.
const LIST_CLASSES: [(&str, &str); 4] = [
    ("nuplan.database.common.data_types", "Translation"),
    ("nuplan.database.common.data_types", "Rotation"),
    ("nuplan.database.common.data_types", "CameraIntrinsic"),
    ("builtins", "list"),
];

const COLUMNS: [&str; 8] =
    ["token", "channel", "translation", "rotation", "intrinsic", "distortion", "width", "height"];

/// Tokens and cameras, clockwise from the front.
pub(super) fn read_cameras(database: &Database) -> Result<Vec<(Token, RigCamera)>, DataError> {
    let cameras = database.read("camera", &COLUMNS, |row| Ok((row.token(0)?, read_camera(row)?)))?;
    let mut channels: Vec<&str> = cameras.iter().map(|camera| camera.1.channel.as_str()).collect();
    channels.sort_unstable();
    if let Some(twice) = channels.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(database.bad(format!("camera {} occurs twice", twice[0])));
    }
    let rig = CameraRig { cameras: cameras.iter().map(|camera| camera.1.clone()).collect() };
    Ok(rig.clockwise_order().into_iter().filter_map(|at| cameras.get(at).cloned()).collect())
}

fn read_camera(row: &Row<'_>) -> Result<RigCamera, DataError> {
    let channel = row.text(1)?.to_owned();
    let calibration = |source| DataError::Calibration { row: channel.clone(), source, path: row.path().to_owned() };
    let translation: [f64; 3] = unpickle(row, 2, Value::numbers, "3 numbers")?;
    let rotation: [f64; 4] = unpickle(row, 3, Value::numbers, "4 numbers")?;
    let ego_from_cam = Rigid::from_wxyz(rotation, translation).map_err(calibration)?;
    let k: [[f64; 3]; 3] = unpickle(row, 4, Value::rows, "3 rows of 3 numbers")?;
    if [k[0][1], k[1][0], k[2][0], k[2][1]] != [0.0; 4] || k[2][2] != 1.0 {
        return Err(row.wrong(4, "is no camera matrix without skew"));
    }
    // The file follows OpenCV: integer coordinates are pixel centres.
    let (cx, cy) = (k[0][2] + 0.5, k[1][2] + 0.5);
    let intrinsics = Intrinsics { fx: k[0][0], fy: k[1][1], cx, cy, width: row.side(6)?, height: row.side(7)? };
    let lens = match unpickle(row, 5, Value::numbers, "5 numbers")? {
        [0.0, 0.0, 0.0, 0.0, 0.0] => Lens::Pinhole,
        [k1, k2, p1, p2, k3] => Lens::BrownConrady { k: [k1, k2, k3], p: [p1, p2] },
    };
    Camera::new(intrinsics, lens).map_err(calibration)?;
    Ok(RigCamera { channel, intrinsics, lens, ego_from_cam })
}

/// One pickled column.
fn unpickle<T>(row: &Row<'_>, at: usize, take: impl Fn(&Value) -> Option<T>, want: &str) -> Result<T, DataError> {
    let column = COLUMNS[at];
    let value = decode(row.blob(at)?, &Rules::new(&LIST_CLASSES)).map_err(|error| DataError::Format {
        format: "pickle",
        why: format!("camera.{column}: {error}"),
        path: row.path().to_owned(),
    })?;
    take(&value).ok_or_else(|| DataError::Array {
        name: format!("camera.{column}"),
        got: value.describe(),
        want: want.to_owned(),
        path: row.path().to_owned(),
    })
}
