//! What to read: folder, split, logs, cameras, frames, boxes.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::store::{Roots, checked_name};
use crate::taxonomy::ClassRule;

/// The ring, clockwise from the front; the rig of a log unless `cameras` says otherwise.
pub(crate) const RING: [&str; 7] = [
    "ring_front_center",
    "ring_front_right",
    "ring_side_right",
    "ring_rear_right",
    "ring_rear_left",
    "ring_side_left",
    "ring_front_left",
];
/// The forward pair beside the ring.
pub(crate) const STEREO: [&str; 2] = ["stereo_front_left", "stereo_front_right"];

/// Settings of the Argoverse 2 sensor reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Argoverse2Config {
    /// Folder or archive that holds `train`, `val` and `test`, perhaps below `sensor`; or a folder of logs without splits; or a list of
    /// these.
    pub root: Roots,
    /// Which split's folder.
    #[serde(default)]
    pub split: Split,
    /// Only these logs of the split, in this order; empty for all of them in the order of their names.
    #[serde(default)]
    pub logs: Vec<String>,
    /// Cameras in this order; empty for the seven ring cameras clockwise from the front. Stereo cameras are used when they are named.
    #[serde(default)]
    pub cameras: Vec<String>,
    /// Which instants become frames.
    #[serde(default)]
    pub frames: FrameChoice,
    /// A picture belongs to a reference instant when it was taken this close to it, ms. Half a camera period by default.
    #[serde(default = "default_pairing_window_ms")]
    pub pairing_window_ms: f64,
    /// Leave frames out in which a camera of the log's rig has no picture.
    #[serde(default)]
    pub require_all_views: bool,
    /// Longest interval between pose rows that may be interpolated where a stamp has no row of its own, ms.
    #[serde(default = "default_max_pose_gap_ms")]
    pub max_pose_gap_ms: f64,
    /// Leave out riders whose box overlaps a two-wheeler's: other datasets give both one box.
    #[serde(default)]
    pub merge_riders: bool,
    /// Leave out boxes whose centre is further away in the plane, metres.
    #[serde(default)]
    pub max_range_m: Option<f64>,
    /// Leave out boxes with fewer lidar points inside.
    #[serde(default)]
    pub min_points: u32,
    /// Overrides of the class table by native category name.
    #[serde(default)]
    pub classes: BTreeMap<String, ClassRule>,
    /// What is known to be corrupt: `log`, `log/reference stamp` for a frame, or `log/camera/stamp` for a picture.
    #[serde(default)]
    pub exclude: Vec<String>,
    /// Logs whose tables stay in memory, about 2 MB each with their maps. A shuffled set of more logs reads tables anew for most frames,
    /// which costs less than decoding one picture.
    #[serde(default = "default_cached_logs")]
    pub cached_logs: usize,
    /// Name the frames carry.
    #[serde(default = "default_name")]
    pub name: String,
}

impl Argoverse2Config {
    /// The defaults for a dataset folder: every log, the ring cameras, annotated frames.
    pub fn new(root: impl Into<Roots>) -> Self {
        Self {
            root: root.into(),
            split: Split::default(),
            logs: Vec::new(),
            cameras: Vec::new(),
            frames: FrameChoice::default(),
            pairing_window_ms: default_pairing_window_ms(),
            require_all_views: false,
            max_pose_gap_ms: default_max_pose_gap_ms(),
            merge_riders: false,
            max_range_m: None,
            min_points: 0,
            classes: BTreeMap::new(),
            exclude: Vec::new(),
            cached_logs: default_cached_logs(),
            name: default_name(),
        }
    }

    /// # Errors
    /// [`DataError::Config`] for numbers without a meaning and names that occur twice; [`DataError::UnsafePath`] for names that are no
    /// plain names.
    pub(super) fn checked(&self) -> Result<(), DataError> {
        let refuse = |why: String| Err(DataError::Config(format!("dataset {}: {why}", self.name)));
        let range = self.max_range_m.unwrap_or_default();
        let numbers = [
            ("pairing_window_ms", self.pairing_window_ms),
            ("max_pose_gap_ms", self.max_pose_gap_ms),
            ("max_range_m", range),
        ];
        for (name, value) in numbers {
            if !value.is_finite() || value < 0.0 {
                return refuse(format!("{name} must not be negative, but is {value}"));
            }
        }
        if self.cached_logs == 0 {
            return refuse("cached_logs must be at least 1".to_owned());
        }
        for (what, names) in [("log", &self.logs), ("camera", &self.cameras)] {
            for (at, name) in names.iter().enumerate() {
                checked_name(name, Path::new(what))?;
                if names.iter().take(at).any(|other| other == name) {
                    return refuse(format!("{what} {name} is listed twice"));
                }
            }
        }
        let known = |name: &String| RING.iter().chain(&STEREO).any(|camera| camera == name);
        match self.cameras.iter().find(|name| !known(name)) {
            Some(name) => {
                refuse(format!("{name:?} is no camera of this dataset: {}, {}", RING.join(", "), STEREO.join(", ")))
            }
            None => Ok(()),
        }
    }

    /// The wanted cameras in rig order.
    pub(super) fn wanted_cameras(&self) -> Vec<&str> {
        if self.cameras.is_empty() { RING.to_vec() } else { self.cameras.iter().map(String::as_str).collect() }
    }

    pub(super) fn window_ns(&self) -> i64 {
        (self.pairing_window_ms * 1e6) as i64
    }

    pub(super) fn gap_ns(&self) -> i64 {
        (self.max_pose_gap_ms * 1e6) as i64
    }
}

/// Which part of the dataset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Split {
    /// Every log that is there.
    #[default]
    All,
    /// The folder `train`.
    Train,
    /// The folder `val`.
    Val,
    /// The folder `test`, which has no annotations.
    Test,
}

impl Split {
    /// Folders to look into.
    pub(crate) fn folders(self) -> &'static [&'static str] {
        match self {
            Self::All => &["train", "val", "test"],
            Self::Train => &["train"],
            Self::Val => &["val"],
            Self::Test => &["test"],
        }
    }
}

/// Which instants become frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FrameChoice {
    /// The lidar stamps with annotations, 10 Hz. A log without any annotation gives its lidar stamps, and without these all its sets of
    /// pictures.
    #[default]
    Annotated,
    /// Every set of pictures, 20 Hz; sets between two lidar stamps have no boxes.
    AllPictures,
}

fn default_name() -> String {
    "argoverse2".to_owned()
}

const fn default_max_pose_gap_ms() -> f64 {
    100.0
}

const fn default_pairing_window_ms() -> f64 {
    25.0
}

const fn default_cached_logs() -> usize {
    32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ObjectClass;

    #[test]
    fn configs_are_strict_and_default_to_annotated_ring_frames() {
        let parse = |text: &str| serde_json::from_str::<Argoverse2Config>(text);
        let config = parse(r#"{"root": "d"}"#).unwrap();
        assert_eq!(config, Argoverse2Config::new("d"));
        assert_eq!(config.wanted_cameras(), RING);
        let config = parse(
            r#"{"root": "d", "split": "val", "frames": "all_pictures", "classes": {"DOG": "drop", "SIGN": "other"}}"#,
        );
        let config = config.unwrap();
        assert_eq!((config.split, config.frames), (Split::Val, FrameChoice::AllPictures));
        assert_eq!(config.classes["DOG"], ClassRule::Drop);
        assert_eq!(config.classes["SIGN"], ClassRule::As(ObjectClass::Other));
        assert!(parse(r#"{"root": "d", "splitt": "val"}"#).is_err());
        assert!(parse(r#"{"root": "d", "split": "mini"}"#).is_err());
    }

    #[test]
    fn settings_without_a_meaning_are_refused() {
        let refused = |change: fn(&mut Argoverse2Config)| {
            let mut config = Argoverse2Config::new("d");
            change(&mut config);
            config.checked().unwrap_err().to_string()
        };
        assert!(refused(|c| c.pairing_window_ms = f64::NAN).contains("pairing_window_ms"));
        assert!(refused(|c| c.max_range_m = Some(-1.0)).contains("max_range_m"));
        assert!(refused(|c| c.cached_logs = 0).contains("cached_logs"));
        assert!(refused(|c| c.cameras = vec!["CAM_FRONT".into()]).contains("ring_front_center"));
        assert!(refused(|c| c.logs = vec!["a".into(), "a".into()]).contains("twice"));
        assert!(refused(|c| c.logs = vec!["../a".into()]).contains("not a plain relative path"));
    }
}
