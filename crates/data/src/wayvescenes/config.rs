//! What to read: folder, scenes, cameras.

use std::ops::RangeInclusive;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use super::REFERENCE_CHANNEL;
use crate::DataError;
use crate::store::Roots;

/// Settings of the WayveScenes101 reader.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayveScenesConfig {
    /// Folder or archive that holds one folder per scene; or a list of both, each with some of the scenes.
    pub root: Roots,
    /// `train` or `val`, the 84 and 17 scenes of BEV-VAE, or `all` for every scene in the root.
    #[serde(default = "default_split")]
    pub split: String,
    /// Only these scenes of the split, in this order; empty for all of them.
    #[serde(default)]
    pub scenes: Vec<String>,
    /// Which cameras become views.
    #[serde(default)]
    pub views: ViewSplit,
    /// Folder with `scene_metadata.csv` and `baselines.json`, which the release keeps beside the scenes. Without it both are looked
    /// for in the root and may be absent: scenes then have no text, and the published baselines serve.
    #[serde(default)]
    pub metadata: Option<PathBuf>,
    /// Where the metric scale comes from.
    #[serde(default)]
    pub scale: Scale,
    /// What the picture names count.
    #[serde(default)]
    pub time_unit: TimeUnit,
    /// Pictures form one set when their stamps lie this close to the set's first, ms.
    #[serde(default = "default_pairing_window_ms")]
    pub pairing_window_ms: f64,
    /// Give every view the mask of blurred faces, plates and the own car, where the scene has them.
    #[serde(default = "default_masks")]
    pub masks: bool,
    /// Leave frames out in which a chosen camera of the scene has no picture.
    #[serde(default)]
    pub require_all_views: bool,
    /// Frames that are known to be corrupt, as `scene_001/1690000000000000`.
    #[serde(default)]
    pub exclude: Vec<String>,
    /// Name the frames carry.
    #[serde(default = "default_name")]
    pub name: String,
}

impl WayveScenesConfig {
    /// The defaults for a dataset folder: every scene, every camera, masks on.
    pub fn new(root: impl Into<Roots>) -> Self {
        Self {
            root: root.into(),
            split: default_split(),
            scenes: Vec::new(),
            views: ViewSplit::default(),
            metadata: None,
            scale: Scale::default(),
            time_unit: TimeUnit::default(),
            pairing_window_ms: default_pairing_window_ms(),
            masks: default_masks(),
            require_all_views: false,
            exclude: Vec::new(),
            name: default_name(),
        }
    }

    /// # Errors
    /// [`DataError::Config`] for an unknown split and numbers without a meaning.
    pub(super) fn checked(&self) -> Result<(), DataError> {
        let window = self.pairing_window_ms;
        if !(window.is_finite() && window >= 0.0) {
            return Err(DataError::Config(format!("pairing_window_ms must not be negative, but is {window}")));
        }
        if let Scale::MetresPerUnit(scale) = self.scale
            && !(scale.is_finite() && scale > 0.0)
        {
            return Err(DataError::Config(format!("scale.metres_per_unit must be positive, but is {scale}")));
        }
        if self.split != "all" && split_numbers(&self.split).is_none() {
            let split = &self.split;
            return Err(DataError::Config(format!("WayveScenes101 has no split {split:?}, only all, train and val")));
        }
        Ok(())
    }
}

/// Which cameras become views. The calibration always comes from all of them.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ViewSplit {
    /// Every camera.
    #[default]
    All,
    /// The official novel-view protocol: all but the forward camera, which is held out.
    NovelViewTrain,
    /// The official novel-view protocol: the forward camera.
    NovelViewTest,
    /// These channels.
    Cameras(Vec<String>),
}

impl ViewSplit {
    pub(super) fn holds(&self, channel: &str) -> bool {
        match self {
            Self::All => true,
            Self::NovelViewTrain => channel != REFERENCE_CHANNEL,
            Self::NovelViewTest => channel == REFERENCE_CHANNEL,
            Self::Cameras(channels) => channels.iter().any(|chosen| chosen == channel),
        }
    }
}

/// Where the metric scale comes from.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// The distances between the cameras of the region whose ratios fit.
    #[default]
    Baselines,
    /// Metres per unit of the COLMAP models, for scenes from elsewhere.
    MetresPerUnit(f64),
}

/// What the integers in picture names count.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimeUnit {
    /// Whatever makes the cameras run at 10 Hz; an error where nothing does.
    #[default]
    Infer,
    /// 1e-3 s.
    Milliseconds,
    /// 1e-6 s.
    Microseconds,
    /// 1e-9 s.
    Nanoseconds,
}

impl TimeUnit {
    /// Nanoseconds of one count; `None` where it is yet to be inferred.
    pub fn nanoseconds(self) -> Option<i64> {
        match self {
            Self::Infer => None,
            Self::Milliseconds => Some(1_000_000),
            Self::Microseconds => Some(1_000),
            Self::Nanoseconds => Some(1),
        }
    }
}

/// Scene numbers of the BEV-VAE splits; `None` for a name that is no split.
pub(super) fn split_numbers(split: &str) -> Option<RangeInclusive<u32>> {
    match split {
        "train" => Some(1..=84),
        "val" => Some(85..=101),
        _ => None,
    }
}

/// Scene names of a split in order; `None` for `all` and for names that are no split.
pub(super) fn split_scenes(split: &str) -> Option<Vec<String>> {
    Some(split_numbers(split)?.map(|number| format!("scene_{number:03}")).collect())
}

fn default_split() -> String {
    "all".to_owned()
}

fn default_name() -> String {
    "wayve_scenes101".to_owned()
}

/// A fifth of the time between sets.
const fn default_pairing_window_ms() -> f64 {
    20.0
}

const fn default_masks() -> bool {
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn configs_are_strict_and_default_to_everything() {
        let parse = |text: &str| serde_json::from_str::<WayveScenesConfig>(text);
        assert_eq!(parse(r#"{"root": "d"}"#).unwrap(), WayveScenesConfig::new("d"));
        let config = parse(
            r#"{"root": "d", "views": "novel_view_train", "scale": {"metres_per_unit": 2.5},
                "time_unit": "microseconds", "masks": false}"#,
        );
        let config = config.unwrap();
        assert_eq!((config.views, config.scale), (ViewSplit::NovelViewTrain, Scale::MetresPerUnit(2.5)));
        assert_eq!(
            parse(r#"{"root": "d", "views": {"cameras": ["a"]}}"#).unwrap().views,
            ViewSplit::Cameras(vec!["a".into()])
        );
        assert!(parse(r#"{"root": "d", "time_unit": "hours"}"#).is_err());
        assert!(parse(r#"{"root": "d", "mask": false}"#).is_err());
        assert!(parse("{}").is_err());
        for bad in [
            WayveScenesConfig { split: "trian".into(), ..WayveScenesConfig::new("d") },
            WayveScenesConfig { pairing_window_ms: f64::NAN, ..WayveScenesConfig::new("d") },
            WayveScenesConfig { scale: Scale::MetresPerUnit(0.0), ..WayveScenesConfig::new("d") },
        ] {
            assert!(matches!(bad.checked(), Err(DataError::Config(_))), "{bad:?}");
        }
    }

    #[test]
    fn the_splits_of_bev_vae_cover_the_dataset() {
        let scenes = [split_scenes("train").unwrap(), split_scenes("val").unwrap()].concat();
        assert_eq!(scenes.len(), 101);
        assert_eq!((scenes[0].as_str(), scenes[83].as_str()), ("scene_001", "scene_084"));
        assert_eq!((scenes[84].as_str(), scenes[100].as_str()), ("scene_085", "scene_101"));
        assert!(split_scenes("all").is_none());
    }

    #[test]
    fn novel_views_hold_the_forward_camera_out() {
        assert!(ViewSplit::NovelViewTest.holds("front-forward") && !ViewSplit::NovelViewTest.holds("left-forward"));
        assert!(!ViewSplit::NovelViewTrain.holds("front-forward") && ViewSplit::NovelViewTrain.holds("left-forward"));
    }
}
