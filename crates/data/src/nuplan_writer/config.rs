//! What to write, and what was written.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::manifest::WriterManifest;
use crate::staging::check_names;
use crate::{DataError, FrameId};

/// Frames of any dataset in the nuPlan layout.
///
/// Start from [`NuPlanWriterConfig::new`] and change fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NuPlanWriterConfig {
    /// Folder to make. Not part of the manifest, so that the same dataset has the same bytes anywhere.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace `out` if this tool wrote it. A folder without a manifest is never replaced.
    #[serde(skip)]
    pub force: bool,
    /// Subfolder of the databases: `mini`, `trainval` or `test`.
    pub folder: String,
    /// Tokens follow from it and from names.
    pub seed: u64,
    /// Width and height of the pictures in pixels; the intrinsics scale along. `None` keeps each picture's own size, and the bytes of
    /// pictures that are JPEG files already.
    pub image_size: Option<(u32, u32)>,
    /// 1 to 100, for pictures that are encoded here.
    pub jpeg_quality: u8,
    /// Place of the source's world origin in the UTM zone, east and north, metres. Zero for poses that are UTM already.
    pub utm_origin_m: [f64; 2],
    /// Code of the UTM zone.
    pub epsg: u32,
    /// City in the `log` table.
    pub location: String,
    /// Vehicle in the `log` table.
    pub vehicle: String,
    /// New names of camera channels; the others keep theirs. Other tools know `CAM_F0`, `CAM_L0` to `CAM_L2`, `CAM_R0` to `CAM_R2`, `CAM_B0`.
    pub channels: BTreeMap<String, String>,
}

impl NuPlanWriterConfig {
    /// Databases in `mini`, pictures of their own size, JPEG quality 95, the world's origin in Las Vegas.
    pub fn new(out: PathBuf) -> Self {
        Self {
            out,
            force: false,
            folder: "mini".to_owned(),
            seed: 0,
            image_size: None,
            jpeg_quality: 95,
            utm_origin_m: [664_000.0, 3_997_000.0],
            epsg: 32_611,
            location: "us-nv-las-vegas-strip".to_owned(),
            vehicle: "veh-900".to_owned(),
            channels: BTreeMap::new(),
        }
    }

    /// # Errors
    /// [`DataError::Config`], naming the setting.
    pub(super) fn check(&self) -> Result<(), DataError> {
        let refuse = |text: String| Err(DataError::Config(text));
        check_names("folder", std::slice::from_ref(&self.folder))?;
        let renamed: Vec<String> = self.channels.values().cloned().collect();
        check_names("channel", &renamed)?;
        if !(1..=100).contains(&self.jpeg_quality) {
            return refuse(format!("jpeg_quality is {}, it must be 1 to 100", self.jpeg_quality));
        }
        if let Some((width, height)) = self.image_size.filter(|size| size.0 == 0 || size.1 == 0) {
            return refuse(format!("image_size is {width}x{height}"));
        }
        if self.utm_origin_m.iter().any(|value| !value.is_finite()) {
            return refuse(format!("utm_origin_m is {:?}", self.utm_origin_m));
        }
        Ok(())
    }

    /// The channel's name in the files.
    pub(super) fn channel<'a>(&'a self, channel: &'a str) -> &'a str {
        self.channels.get(channel).map_or(channel, String::as_str)
    }
}

/// `manifest.json` beside the data.
pub type NuPlanManifest = WriterManifest<NuPlanWriterConfig, NuPlanManifestLog>;

/// A log and the frames it was made of.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NuPlanManifestLog {
    /// Its name.
    pub name: String,
    /// Its frames in time order.
    pub frames: Vec<NuPlanManifestFrame>,
}

/// A frame and where it came from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct NuPlanManifestFrame {
    /// Dataset of the source frame.
    pub source_dataset: String,
    /// Name of the source frame.
    pub source_frame: String,
    /// Token of its lidar turn here; `None` for a frame without boxes in a log that has some.
    pub lidar_token: Option<String>,
}

impl NuPlanManifestFrame {
    pub(super) fn new(id: &FrameId, lidar_token: Option<String>) -> Self {
        Self { source_dataset: id.dataset.clone(), source_frame: id.frame.clone(), lidar_token }
    }
}
