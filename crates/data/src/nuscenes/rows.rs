//! The rows of the tables as they stand in the files. Unknown fields are ignored, because third parties add their own.

use std::borrow::Cow;
use std::fmt;

use serde::de::{Error, Visitor};
use serde::{Deserialize, Deserializer};

use super::json::TableRow;

/// Text that borrows from the file's bytes where it holds no escapes.
#[derive(Deserialize)]
#[serde(transparent)]
pub(super) struct Text<'a>(#[serde(borrow)] Cow<'a, str>);

impl Text<'_> {
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

/// Only the token, to name a row whose other fields cannot be read.
#[derive(Deserialize)]
pub(super) struct Token<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
}

/// Microseconds in the file, integer or (in interpolated tables) float; nanoseconds here.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stamp(pub i64);

impl<'de> Deserialize<'de> for Stamp {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Microseconds;

        impl Visitor<'_> for Microseconds {
            type Value = Stamp;

            fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
                formatter.write_str("a time stamp in microseconds")
            }

            fn visit_i64<E: Error>(self, value: i64) -> Result<Stamp, E> {
                value
                    .checked_mul(1000)
                    .map(Stamp)
                    .ok_or_else(|| E::custom(format!("time stamp {value} is out of range")))
            }

            fn visit_u64<E: Error>(self, value: u64) -> Result<Stamp, E> {
                self.visit_i64(i64::try_from(value).map_err(E::custom)?)
            }

            fn visit_f64<E: Error>(self, value: f64) -> Result<Stamp, E> {
                // 9.2e15 us is the largest i64 in ns; below it whole microseconds are exact in f64.
                if !value.is_finite() || value.abs() >= 9.2e15 {
                    return Err(E::custom(format!("time stamp {value} is out of range")));
                }
                let whole = value.floor();
                Ok(Stamp(whole as i64 * 1000 + ((value - whole) * 1000.0).round() as i64))
            }
        }

        deserializer.deserialize_any(Microseconds)
    }
}

#[derive(Deserialize)]
pub(super) struct SensorRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub channel: Text<'a>,
    #[serde(borrow)]
    pub modality: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct CalibratedSensorRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub sensor_token: Text<'a>,
    pub translation: [f64; 3],
    pub rotation: [f64; 4],
    pub camera_intrinsic: Vec<[f64; 3]>,
}

#[derive(Deserialize)]
pub(super) struct LogRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub logfile: Text<'a>,
    #[serde(borrow)]
    pub location: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct SceneRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub name: Text<'a>,
    #[serde(borrow)]
    pub description: Text<'a>,
    #[serde(borrow)]
    pub log_token: Text<'a>,
    #[serde(borrow)]
    pub first_sample_token: Text<'a>,
    #[serde(borrow)]
    pub last_sample_token: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct SampleRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub scene_token: Text<'a>,
    pub timestamp: Stamp,
}

/// Chains (`prev`, `next`) are not read: order comes from the stamps.
#[derive(Deserialize)]
pub(super) struct SampleDataRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub sample_token: Text<'a>,
    #[serde(borrow)]
    pub ego_pose_token: Text<'a>,
    #[serde(borrow)]
    pub calibrated_sensor_token: Text<'a>,
    #[serde(borrow)]
    pub filename: Text<'a>,
    pub timestamp: Stamp,
    pub is_key_frame: bool,
    pub height: Option<u32>,
    pub width: Option<u32>,
}

#[derive(Deserialize)]
pub(super) struct EgoPoseRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    pub timestamp: Stamp,
    pub rotation: [f64; 4],
    pub translation: [f64; 3],
}

#[derive(Deserialize)]
pub(super) struct CategoryRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub name: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct AttributeRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub name: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct VisibilityRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
}

#[derive(Deserialize)]
pub(super) struct InstanceRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub category_token: Text<'a>,
}

/// Chains (`prev`, `next`) are not read: order comes from the samples.
#[derive(Deserialize)]
pub(super) struct AnnotationRow<'a> {
    #[serde(borrow)]
    pub token: Text<'a>,
    #[serde(borrow)]
    pub sample_token: Text<'a>,
    #[serde(borrow)]
    pub instance_token: Text<'a>,
    #[serde(borrow)]
    pub visibility_token: Text<'a>,
    #[serde(borrow)]
    pub attribute_tokens: Vec<Text<'a>>,
    pub translation: [f64; 3],
    pub size: [f64; 3],
    pub rotation: [f64; 4],
    pub num_lidar_pts: i64,
    pub num_radar_pts: i64,
}

/// The picture of a map and the logs that were recorded on it. Third-party tables without maps leave both out.
#[derive(Deserialize)]
pub(super) struct MapRow<'a> {
    #[serde(borrow, default)]
    pub filename: Option<Text<'a>>,
    #[serde(borrow, default)]
    pub log_tokens: Vec<Text<'a>>,
}

macro_rules! tables {
    ($($table:ident => $row:ident,)*) => {$(
        pub(super) struct $table;

        impl TableRow for $table {
            type Row<'a> = $row<'a>;
        }
    )*};
}

tables! {
    SensorTable => SensorRow,
    CalibratedSensorTable => CalibratedSensorRow,
    LogTable => LogRow,
    SceneTable => SceneRow,
    SampleTable => SampleRow,
    SampleDataTable => SampleDataRow,
    EgoPoseTable => EgoPoseRow,
    CategoryTable => CategoryRow,
    AttributeTable => AttributeRow,
    VisibilityTable => VisibilityRow,
    InstanceTable => InstanceRow,
    AnnotationTable => AnnotationRow,
    MapTable => MapRow,
}
