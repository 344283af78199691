//! What to read: folder, split, cameras, frames.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::occupancy::OccupancyConfig;
use crate::store::Roots;
use crate::taxonomy::ClassRule;

/// Settings of the nuScenes reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NuScenesConfig {
    /// Folder that holds the table folder, `samples` and `sweeps`; or an archive, or a list of both.
    pub root: Roots,
    /// Name of the table folder.
    #[serde(default = "default_version")]
    pub version: String,
    /// Name of an official split (`train`, `val`, `test`, `mini_train`, `mini_val`, ...) or `all` for every scene of the tables.
    #[serde(default = "default_split")]
    pub split: String,
    /// Only these scenes of the split, in this order; empty for all of them.
    #[serde(default)]
    pub scenes: Vec<String>,
    /// Only these camera channels; empty for all cameras of the tables.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// Which instants become frames.
    #[serde(default)]
    pub frames: FrameChoice,
    /// Leave frames out in which a camera of the scene's rig has no picture.
    #[serde(default)]
    pub require_all_views: bool,
    /// Which table states when a picture was taken.
    #[serde(default)]
    pub timestamps: PictureTime,
    /// Longest interval between pose rows that may be interpolated, ms.
    #[serde(default = "default_max_pose_gap_ms")]
    pub max_pose_gap_ms: f64,
    /// Overrides of the class table by native category name.
    #[serde(default)]
    pub classes: BTreeMap<String, ClassRule>,
    /// Frames that are known to be corrupt, by sample token (or time stamp in ns for frames between key frames).
    #[serde(default)]
    pub exclude: Vec<String>,
    /// Occupancy labels that belong to the samples.
    #[serde(default)]
    pub occupancy: Option<OccupancyConfig>,
    /// Name the frames carry.
    #[serde(default = "default_name")]
    pub name: String,
}

impl NuScenesConfig {
    /// The defaults for a dataset folder and table folder: every scene, every camera, key frames.
    pub fn new(root: impl Into<Roots>, version: impl Into<String>) -> Self {
        Self {
            root: root.into(),
            version: version.into(),
            split: default_split(),
            scenes: Vec::new(),
            cameras: Vec::new(),
            frames: FrameChoice::default(),
            require_all_views: false,
            timestamps: PictureTime::default(),
            max_pose_gap_ms: default_max_pose_gap_ms(),
            classes: BTreeMap::new(),
            exclude: Vec::new(),
            occupancy: None,
            name: default_name(),
        }
    }

    /// # Errors
    /// [`DataError::Config`] for times that are negative or no numbers.
    pub(super) fn checked(&self) -> Result<(), DataError> {
        let window = match self.frames {
            FrameChoice::KeyFrames => 0.0,
            FrameChoice::AllPictures { pairing_window_ms, .. } => pairing_window_ms,
        };
        for (name, value) in [("max_pose_gap_ms", self.max_pose_gap_ms), ("pairing_window_ms", window)] {
            if !value.is_finite() || value < 0.0 {
                return Err(DataError::Config(format!("{name} must not be negative, but is {value}")));
            }
        }
        Ok(())
    }
}

/// Which instants become frames.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum FrameChoice {
    /// The annotated samples, 2 Hz.
    #[default]
    KeyFrames,
    /// Every set of pictures of one lidar turn, about 12 Hz.
    AllPictures {
        /// Pictures belong to one set when their stamps, freed of their camera's offset, lie this close to the set's, ms.
        /// Half a lidar turn by default.
        #[serde(default = "default_pairing_window_ms")]
        pairing_window_ms: f64,
        /// How boxes are found between annotated samples.
        #[serde(default)]
        boxes: BoxMode,
    },
}

impl FrameChoice {
    /// Every set of pictures, with the default window and boxes.
    pub fn all_pictures() -> Self {
        Self::AllPictures { pairing_window_ms: default_pairing_window_ms(), boxes: BoxMode::default() }
    }
}

/// Boxes between two annotated samples a (before) and b (after).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BoxMode {
    /// Interpolated boxes of the objects annotated in both a and b; nothing is known before the first sample.
    #[default]
    Both,
    /// The rule of the official devkit: also the unmoved boxes of objects that are annotated in b only, and the unmoved boxes of
    /// the first sample before it.
    Devkit,
}

/// Which table states when a picture was taken. They differ only in tables that were interpolated to 12 Hz.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PictureTime {
    /// The stamp of the picture's ego pose: the exposure.
    #[default]
    RealTime,
    /// The stamp of its `sample_data` row.
    AsWritten,
}

fn default_version() -> String {
    "v1.0-trainval".to_owned()
}

fn default_split() -> String {
    "all".to_owned()
}

fn default_name() -> String {
    "nuscenes".to_owned()
}

const fn default_max_pose_gap_ms() -> f64 {
    100.0
}

const fn default_pairing_window_ms() -> f64 {
    25.0
}

/// Scene names of an official split in its own order; `None` for a name that is no split.
pub(super) fn split_scenes(split: &str) -> Option<Vec<String>> {
    let lines = include_str!("splits.txt").lines().filter(|line| !line.starts_with('#'));
    let mut words =
        lines.map(str::split_whitespace).find_map(|mut words| (words.next() == Some(split)).then_some(words))?;
    let mut names = Vec::new();
    words.try_for_each(|word| {
        let (first, last) = word.split_once('-').unwrap_or((word, word));
        let range = first.parse::<u32>().ok()?..=last.parse::<u32>().ok()?;
        names.extend(range.map(|number| format!("scene-{number:04}")));
        Some(())
    })?;
    Some(names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ObjectClass;
    use crate::occupancy::{BetweenKeyFrames, OccupancyKind};

    #[test]
    fn splits_have_their_official_sizes_and_do_not_overlap() {
        let count = |split| split_scenes(split).unwrap().len();
        assert_eq!(["train", "val", "test", "mini_train", "mini_val"].map(count), [700, 150, 150, 8, 2]);
        let mut all: Vec<String> = ["train", "val", "test"].iter().flat_map(|s| split_scenes(s).unwrap()).collect();
        all.sort();
        all.dedup();
        assert_eq!(all.len(), 1000);
        assert_eq!(split_scenes("mini_val").unwrap(), ["scene-0103", "scene-0916"]);
        let halves = [split_scenes("train_detect").unwrap(), split_scenes("train_track").unwrap()].concat();
        assert_eq!(halves.len(), 700);
        assert!(split_scenes("trian").is_none());
    }

    #[test]
    fn configs_are_strict_and_default_to_key_frames() {
        let parse = |text: &str| serde_json::from_str::<NuScenesConfig>(text);
        let config = parse(r#"{"root": "d", "version": "v1.0-mini"}"#).unwrap();
        assert_eq!(config, NuScenesConfig::new("d", "v1.0-mini"));
        let config = parse(r#"{"root": "d", "frames": {"all_pictures": {}}, "classes": {"a": "drop", "b": "car"}}"#);
        let config = config.unwrap();
        assert_eq!(config.frames, FrameChoice::all_pictures());
        assert_eq!(config.classes["a"], ClassRule::Drop);
        assert_eq!(config.classes["b"], ClassRule::As(ObjectClass::Car));
        let config = parse(r#"{"root": "d", "occupancy": {"kind": "occ3d", "root": "o"}}"#).unwrap();
        assert_eq!(config.occupancy, Some(OccupancyConfig::new(OccupancyKind::Occ3d, "o")));
        let text = r#"{"root": "d", "occupancy": {"kind": "surround_occ", "root": "o", "between": "moved"}}"#;
        assert_eq!(parse(text).unwrap().occupancy.unwrap().between, BetweenKeyFrames::Moved);
        assert!(parse(r#"{"root": "d", "occupancy": {"kind": "occ4d", "root": "o"}}"#).is_err());
        assert!(parse(r#"{"root": "d", "occupancy": {"kind": "occ3d", "root": "o", "mask": true}}"#).is_err());
        assert!(parse(r#"{"root": "d", "splitt": "val"}"#).is_err());
        assert!(parse(r#"{"root": "d", "frames": {"all_pictures": {"window": 3}}}"#).is_err());
        assert!(parse(r#"{"root": "d", "classes": {"b": "vehicle"}}"#).is_err());
    }
}
