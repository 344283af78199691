//! What to write, and what was written.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::DataError;
use crate::staging::check_names;
use crate::waymo::cameras;

/// How frames become a split of Waymo's second release. Start from [`WaymoWriterConfig::new`] and change fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WaymoWriterConfig {
    /// Folder to make. Not part of the manifest, so that the same frames have the same bytes anywhere.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace `out` if this tool wrote it. A folder without a manifest is never replaced.
    #[serde(skip)]
    pub force: bool,
    /// Folder of the split below `out`.
    pub split: String,
    /// The format's camera for each channel of the frames. Channels that are not listed keep their names, which must be the format's.
    pub cameras: BTreeMap<String, String>,
    /// Of pictures that are not JPEG already, 1 to 100.
    pub jpeg_quality: u8,
    /// Whatever seed made the frames, for the manifest.
    pub seed: Option<u64>,
}

impl WaymoWriterConfig {
    /// The training split, channels that bear the format's names, JPEG quality 95.
    pub fn new(out: PathBuf) -> Self {
        let (split, cameras) = ("training".to_owned(), BTreeMap::new());
        Self { out, force: false, split, cameras, jpeg_quality: 95, seed: None }
    }

    /// The camera number of a channel.
    pub(super) fn camera(&self, channel: &str) -> Result<i8, DataError> {
        let name = self.cameras.get(channel).map_or(channel, String::as_str);
        let number = cameras::number(name).and_then(|number| i8::try_from(number).ok());
        number.ok_or_else(|| {
            let known = cameras::CHANNELS.join(", ");
            DataError::Config(format!(
                "camera {name:?} is none of {known}; give channel {channel:?} one under `cameras`"
            ))
        })
    }

    /// # Errors
    /// [`DataError::Config`], naming the setting.
    pub(super) fn check(&self) -> Result<(), DataError> {
        check_names("split", std::slice::from_ref(&self.split))?;
        if !(1..=100).contains(&self.jpeg_quality) {
            return Err(DataError::Config(format!("jpeg_quality is {}, it must be 1 to 100", self.jpeg_quality)));
        }
        self.cameras.keys().try_for_each(|channel| self.camera(channel).map(drop))
    }
}

/// `manifest.json` beside the split: where the frames come from and what was written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WaymoManifest {
    /// Name and version of the tool.
    pub tool: String,
    /// Layout of the folder.
    pub format: String,
    /// Names of the datasets the frames came from; their licences hold for what was written.
    pub source: Vec<String>,
    /// Codec, quality and whether pictures were resampled.
    pub pictures: String,
    /// How many pictures there are.
    pub picture_count: usize,
    /// SHA-256 of `config` as compact JSON.
    pub config_sha256: String,
    /// All settings that shape the bytes.
    pub config: WaymoWriterConfig,
    /// The scenes in order.
    pub scenes: Vec<WaymoManifestScene>,
    /// SHA-256 of every file, by path inside the folder.
    pub sha256: BTreeMap<String, String>,
}

/// The origin of a segment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct WaymoManifestScene {
    /// Its name here and there.
    pub name: String,
    /// The dataset it came from.
    pub dataset: String,
    /// Native names of its frames.
    pub frames: Vec<String>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_need_a_camera_of_the_format() {
        let mut config = WaymoWriterConfig::new(PathBuf::from("out"));
        assert_eq!(config.camera("SIDE_LEFT").unwrap(), 4);
        assert!(config.camera("CAM_BACK").unwrap_err().to_string().contains("CAM_BACK"));
        config.cameras.insert("CAM_BACK".to_owned(), "REAR".to_owned());
        config.check().unwrap();
        assert_eq!(config.camera("CAM_BACK").unwrap(), 7);
        config.cameras.insert("CAM_FRONT".to_owned(), "AHEAD".to_owned());
        assert!(config.check().unwrap_err().to_string().contains("AHEAD"));
        let config = WaymoWriterConfig { split: "../x".to_owned(), ..WaymoWriterConfig::new(PathBuf::from("out")) };
        assert!(config.check().is_err());
    }
}
