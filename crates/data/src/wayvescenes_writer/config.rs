//! What to write, and what was written.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::staging::check_names;
use crate::wayvescenes::TimeUnit;

/// A dataset in the layout of WayveScenes101.
///
/// Start from [`WayveScenesWriterConfig::new`] and change fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayveScenesWriterConfig {
    /// Folder to make. Not part of the manifest, so that the same dataset has the same bytes anywhere.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace `out` if this tool wrote it. A folder without a manifest is never replaced.
    #[serde(skip)]
    pub force: bool,
    /// Names of the cameras in the layout by their names in the frames; a camera that is not listed keeps its name. Every scene needs
    /// a `front-forward`, from which readers take scale and car frame.
    pub channels: BTreeMap<String, String>,
    /// What the picture names count; stamps are cut down to it.
    pub time_unit: TimeUnit,
    /// COLMAP units per metre. The real scenes have an arbitrary scale each; readers recover it from the baselines.
    pub units_per_metre: f64,
    /// How far the ground lies below the frames' ego origin, metres. Sparse points on it tell readers where the ground is.
    pub ground_below_ego_m: f64,
    /// 1 to 100, for pictures that are not JPEG files already; those are copied.
    pub jpeg_quality: u8,
}

impl WayveScenesWriterConfig {
    /// Cameras keep their names, nanoseconds, one unit per metre, the ground at the ego's origin, JPEG quality 95.
    pub fn new(out: impl Into<PathBuf>) -> Self {
        Self {
            out: out.into(),
            force: false,
            channels: BTreeMap::new(),
            time_unit: TimeUnit::Nanoseconds,
            units_per_metre: 1.0,
            ground_below_ego_m: 0.0,
            jpeg_quality: 95,
        }
    }

    /// The camera's name in the layout.
    pub(super) fn channel<'a>(&'a self, channel: &'a str) -> &'a str {
        self.channels.get(channel).map_or(channel, String::as_str)
    }

    /// # Errors
    /// [`DataError::Config`], naming the setting.
    pub(super) fn check(&self) -> Result<(), DataError> {
        let refuse = |text: String| Err(DataError::Config(text));
        if self.time_unit == TimeUnit::Infer {
            return refuse("time_unit must be a unit to write stamps in".to_owned());
        }
        if !(self.units_per_metre.is_finite() && self.units_per_metre > 0.0) {
            return refuse(format!("units_per_metre is {}, it must be positive", self.units_per_metre));
        }
        if !self.ground_below_ego_m.is_finite() {
            return refuse(format!("ground_below_ego_m is {}", self.ground_below_ego_m));
        }
        if !(1..=100).contains(&self.jpeg_quality) {
            return refuse(format!("jpeg_quality is {}, it must be 1 to 100", self.jpeg_quality));
        }
        check_names("channel", &self.channels.values().cloned().collect::<Vec<_>>())
    }
}

/// `manifest.json` beside the data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WayveScenesManifest {
    /// Name and version of the tool.
    pub tool: String,
    /// Layout of the folder.
    pub format: String,
    /// Codec, quality and whether pictures were resampled.
    pub pictures: String,
    /// How many pictures there are.
    pub picture_count: usize,
    /// Those that were copied byte by byte.
    pub copied_pictures: usize,
    /// How many masks there are.
    pub mask_count: usize,
    /// What the sparse points are.
    pub points: String,
    /// SHA-256 of `config` as compact JSON.
    pub config_sha256: String,
    /// All settings that shape the bytes.
    pub config: WayveScenesWriterConfig,
    /// The scenes in order.
    pub scenes: Vec<WayveScenesManifestScene>,
    /// SHA-256 of every table and model file, by path inside the folder.
    pub sha256: BTreeMap<String, String>,
}

/// Where a scene of the dataset comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WayveScenesManifestScene {
    /// Its folder, its name in the source.
    pub name: String,
    /// The source dataset.
    pub dataset: String,
    /// The source frames.
    pub frames: Vec<String>,
    /// Its row of the baselines; `None` for a scene of one camera, whose scale no reader can recover.
    pub region: Option<String>,
    /// The source's words, also where the table of tags has no place for them.
    pub text: Option<String>,
}
