//! What to read: folders, split, cameras, windows.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::store::Roots;
use crate::taxonomy::ClassRule;

/// Settings of the nuPlan reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NuPlanConfig {
    /// Folder or archive that holds the databases and the pictures; or a list of both: the release comes in pieces.
    pub root: Roots,
    /// Folder of the databases below `root`; they lie in it or in its direct subfolders (`mini`, `trainval`, `test`).
    #[serde(default = "default_databases")]
    pub databases: String,
    /// Folder of the pictures below `root`.
    #[serde(default = "default_sensor_blobs")]
    pub sensor_blobs: String,
    /// Folder of the city maps below `root`; without it the dataset has no maps.
    #[serde(default = "default_maps")]
    pub maps: String,
    /// An official list of logs (`train`, `val`, `test`), `mini` for the logs of the subfolder of that name, or `all`.
    #[serde(default = "default_split")]
    pub split: String,
    /// Only these logs of the split, in this order; empty for all of them.
    #[serde(default)]
    pub logs: Vec<String>,
    /// Only these camera channels; empty for all cameras of the databases.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// Leave frames out in which a camera has no picture.
    #[serde(default)]
    pub require_all_views: bool,
    /// Pictures belong to one set when their stamps, freed of their camera's offset, lie this close to the set's middle, ms.
    #[serde(default = "default_pairing_window_ms")]
    pub pairing_window_ms: f64,
    /// Farthest lidar turn whose boxes a picture set takes, ms.
    #[serde(default = "default_box_window_ms")]
    pub box_window_ms: f64,
    /// Longest interval between pose rows that may be interpolated, ms.
    #[serde(default = "default_max_pose_gap_ms")]
    pub max_pose_gap_ms: f64,
    /// Added to every picture's stamp, ms. The shutter rolls; one third-party reader adds 1/60 s for its middle.
    #[serde(default)]
    pub shutter_shift_ms: f64,
    /// Overrides of the class table by native category name.
    #[serde(default)]
    pub classes: BTreeMap<String, ClassRule>,
    /// Frames that are known to be corrupt, by lidar token (or time stamp in ns for frames without a lidar turn).
    #[serde(default)]
    pub exclude: Vec<String>,
    /// Name the frames carry.
    #[serde(default = "default_name")]
    pub name: String,
}

impl NuPlanConfig {
    /// The defaults for a dataset folder: every log with pictures, every camera.
    pub fn new(root: impl Into<Roots>) -> Self {
        Self {
            root: root.into(),
            databases: default_databases(),
            sensor_blobs: default_sensor_blobs(),
            maps: default_maps(),
            split: default_split(),
            logs: Vec::new(),
            cameras: Vec::new(),
            require_all_views: false,
            pairing_window_ms: default_pairing_window_ms(),
            box_window_ms: default_box_window_ms(),
            max_pose_gap_ms: default_max_pose_gap_ms(),
            shutter_shift_ms: 0.0,
            classes: BTreeMap::new(),
            exclude: Vec::new(),
            name: default_name(),
        }
    }

    /// # Errors
    /// [`DataError::Config`] for times that are negative or no numbers.
    pub(super) fn checked(&self) -> Result<(), DataError> {
        for (name, value, least) in [
            ("pairing_window_ms", self.pairing_window_ms, 0.0),
            ("box_window_ms", self.box_window_ms, 0.0),
            ("max_pose_gap_ms", self.max_pose_gap_ms, 0.0),
            ("shutter_shift_ms", self.shutter_shift_ms, -1000.0),
        ] {
            if !value.is_finite() || value < least {
                return Err(DataError::Config(format!("{name} must be at least {least}, but is {value}")));
            }
        }
        Ok(())
    }
}

/// Milliseconds of the config as nanoseconds.
pub(super) fn ns(milliseconds: f64) -> i64 {
    (milliseconds * 1e6).round() as i64
}

fn default_databases() -> String {
    "nuplan-v1.1/splits".to_owned()
}

fn default_sensor_blobs() -> String {
    "nuplan-v1.1/sensor_blobs".to_owned()
}

fn default_maps() -> String {
    "maps".to_owned()
}

fn default_split() -> String {
    "all".to_owned()
}

fn default_name() -> String {
    "nuplan".to_owned()
}

/// A quarter of the cameras' period.
pub(crate) const fn default_pairing_window_ms() -> f64 {
    25.0
}

/// Half of the cameras' period.
pub(crate) const fn default_box_window_ms() -> f64 {
    50.0
}

const fn default_max_pose_gap_ms() -> f64 {
    100.0
}

/// Log names of an official split in its own order; `None` for a name that is no split.
pub(super) fn split_logs(split: &str) -> Option<Vec<String>> {
    let mut names = Vec::new();
    for line in include_str!("splits.txt").lines() {
        let mut words = line.split_whitespace();
        if words.next() != Some(split) {
            continue;
        }
        let drive = words.next()?;
        for word in words {
            let (first, last) = word.split_once('-')?;
            let (first, last) = (first.parse::<u32>().ok()?, last.parse::<u32>().ok()?);
            names.push(format!("{drive}_{first:05}_{last:05}"));
        }
    }
    (!names.is_empty()).then_some(names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ObjectClass;

    #[test]
    fn splits_have_their_official_sizes_and_do_not_overlap() {
        let all = ["train", "val", "test"].map(|split| split_logs(split).unwrap());
        assert_eq!(all.each_ref().map(Vec::len), [13_180, 1_381, 1_349]);
        assert_eq!(all[0][0], "2021.05.12.19.36.12_veh-35_00005_00204");
        let mut names = all.concat();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), 13_180 + 1_381 + 1_349);
        for none in ["trian", "mini", "#", "all", ""] {
            assert!(split_logs(none).is_none(), "{none}");
        }
    }

    #[test]
    fn configs_are_strict_and_default_to_every_log() {
        let parse = |text: &str| serde_json::from_str::<NuPlanConfig>(text);
        assert_eq!(parse(r#"{"root": "d"}"#).unwrap(), NuPlanConfig::new("d"));
        let config = parse(r#"{"root": "d", "classes": {"vehicle": "truck", "barrier": "drop"}}"#).unwrap();
        assert_eq!(config.classes["vehicle"], ClassRule::As(ObjectClass::Truck));
        assert_eq!(config.classes["barrier"], ClassRule::Drop);
        assert!(parse(r#"{"root": "d", "splitt": "val"}"#).is_err());
        assert!(parse(r#"{"root": "d", "classes": {"vehicle": "hovercraft"}}"#).is_err());
        assert!(parse(r#"{"split": "val"}"#).is_err());
        for text in [r#""box_window_ms": -1.0"#, r#""pairing_window_ms": -0.1"#, r#""max_pose_gap_ms": -5.0"#] {
            let error = parse(&format!(r#"{{"root": "d", {text}}}"#)).unwrap().checked().unwrap_err().to_string();
            assert!(error.contains(text.split('"').nth(1).unwrap()), "{error}");
        }
        assert_eq!(ns(12.3456789), 12_345_679);
    }
}
