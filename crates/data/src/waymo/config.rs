//! What to read: folder, release, split, cameras.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::cameras;
use crate::DataError;
use crate::occupancy::WaymoVoxels;
use crate::store::Roots;
use crate::taxonomy::ClassRule;

/// Settings of the Waymo reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WaymoConfig {
    /// Folder or archive that holds the splits; or a list of both.
    pub root: Roots,
    /// How the files are stored.
    pub release: WaymoRelease,
    /// Folder of the split below `root`: `training`, `validation`, `testing`, ...; `"."` where `root` is the split itself.
    #[serde(default = "default_split")]
    pub split: String,
    /// Only these segments of the split, in this order, by context name (the file's name without `segment-` and
    /// `_with_camera_labels`); empty for all of them by name.
    #[serde(default)]
    pub scenes: Vec<String>,
    /// Only these cameras; empty for all of them.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// Overrides of the class table by native name: `VEHICLE`, `PEDESTRIAN`, `SIGN`, `CYCLIST`, `UNKNOWN`.
    #[serde(default)]
    pub classes: BTreeMap<String, ClassRule>,
    /// Frames that are known to be corrupt, by native time stamp in microseconds.
    #[serde(default)]
    pub exclude: Vec<String>,
    /// Occupancy labels of Occ3D-Waymo.
    #[serde(default)]
    pub occupancy: Option<WaymoOccupancy>,
    /// Name the frames carry.
    #[serde(default = "default_name")]
    pub name: String,
}

/// Labels of Occ3D-Waymo for a split. They are numbered: segments in the order of their names in the whole split, frames in time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WaymoOccupancy {
    /// Folder or archive that holds the numbered folders of the split, or a list of both.
    pub root: Roots,
    /// Which of the two grids.
    #[serde(default)]
    pub voxels: WaymoVoxels,
    /// Numbers of segments by context name, for a copy that lacks a part of the split's segments.
    #[serde(default)]
    pub scenes: BTreeMap<String, usize>,
}

/// The two forms in which the perception set is published.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WaymoRelease {
    /// One TFRecord file per segment; from 1.4.2 on with maps.
    V1,
    /// One Parquet file per component and segment; no maps.
    V2,
}

impl WaymoConfig {
    /// The defaults for a folder and release: every segment of the training split, every camera.
    pub fn new(root: impl Into<Roots>, release: WaymoRelease) -> Self {
        Self {
            root: root.into(),
            release,
            split: default_split(),
            scenes: Vec::new(),
            cameras: Vec::new(),
            classes: BTreeMap::new(),
            exclude: Vec::new(),
            occupancy: None,
            name: default_name(),
        }
    }

    /// # Errors
    /// [`DataError::Config`] for a camera that no Waymo car has.
    pub(super) fn checked(&self) -> Result<(), DataError> {
        match self.cameras.iter().find(|channel| cameras::number(channel).is_none()) {
            None => Ok(()),
            Some(unknown) => {
                Err(DataError::Config(format!("camera {unknown:?} is none of {}", cameras::CHANNELS.join(", "))))
            }
        }
    }

    /// A name below the split's folder, as seen from `root`.
    pub(super) fn inside(&self, name: &str) -> String {
        match self.split.as_str() {
            "." => name.to_owned(),
            split if name.is_empty() => split.to_owned(),
            split => format!("{split}/{name}"),
        }
    }

    pub(super) fn wants(&self, channel: &str) -> bool {
        self.cameras.is_empty() || self.cameras.iter().any(|wanted| wanted == channel)
    }

    pub(super) fn excludes(&self, micros: i64) -> bool {
        // Most configs exclude nothing, and segments have hundreds of frames.
        !self.exclude.is_empty() && self.exclude.contains(&micros.to_string())
    }
}

fn default_split() -> String {
    "training".to_owned()
}

fn default_name() -> String {
    "waymo".to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ObjectClass;

    #[test]
    fn configs_are_strict_and_default_to_the_training_split() {
        let parse = |text: &str| serde_json::from_str::<WaymoConfig>(text);
        let config = parse(r#"{"root": "d", "release": "v1"}"#).unwrap();
        assert_eq!(config, WaymoConfig::new("d", WaymoRelease::V1));
        assert_eq!((config.split.as_str(), config.name.as_str()), ("training", "waymo"));
        let config = parse(r#"{"root": "d", "release": "v2", "classes": {"SIGN": "drop", "CYCLIST": "motorcycle"}}"#);
        let classes = config.unwrap().classes;
        assert_eq!(classes["SIGN"], ClassRule::Drop);
        assert_eq!(classes["CYCLIST"], ClassRule::As(ObjectClass::Motorcycle));
        assert!(parse(r#"{"root": "d"}"#).is_err(), "the release has no default");
        assert!(parse(r#"{"root": "d", "release": "v3"}"#).is_err());
        assert!(parse(r#"{"root": "d", "release": "v1", "scene": []}"#).is_err());
    }

    #[test]
    fn unknown_cameras_are_refused_before_anything_is_opened() {
        let cameras = vec!["FRONT".to_owned(), "TOP".to_owned()];
        let config = WaymoConfig { cameras, ..WaymoConfig::new("d", WaymoRelease::V2) };
        assert!(config.checked().unwrap_err().to_string().contains("TOP"));
    }
}
