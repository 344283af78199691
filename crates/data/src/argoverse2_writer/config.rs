//! What to write and how, and what was written.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};

use crate::argoverse2::{RING, STEREO, Split};
use crate::manifest::WriterManifest;
use crate::{DataError, ObjectClass, taxonomy};

/// Settings of the Argoverse 2 writer.
///
/// Start from [`Argoverse2WriterConfig::new`] and change fields.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Argoverse2WriterConfig {
    /// Folder to make. Not part of the manifest, so that the same dataset has the same bytes anywhere.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace `out` if this tool wrote it. A folder without a manifest is never replaced.
    #[serde(skip)]
    pub force: bool,
    /// Where the content comes from, for the manifest: a world and its seed, a checkpoint, a dataset and its licence.
    pub source: String,
    /// Camera names of the layout by channel of the source; channels that have such a name already need no entry.
    #[serde(default)]
    pub channels: BTreeMap<String, String>,
    /// Category of a class whose boxes have no native category of the layout; see [`Argoverse2WriterConfig::category`].
    #[serde(default)]
    pub categories: BTreeMap<ObjectClass, CategoryRule>,
    /// Written picture size over raw size; the intrinsics scale along. At 1 JPEG files are copied byte for byte.
    #[serde(default = "default_image_scale")]
    pub image_scale: f64,
    /// 1 to 100.
    #[serde(default = "default_jpeg_quality")]
    pub jpeg_quality: u8,
    /// Directions per turn of the coarse lidar that is cast in frames of the procedural world; 0 writes empty sweeps. Other frames have
    /// empty sweeps in any case: the official loader finds its frames by them.
    #[serde(default)]
    pub lidar_columns: u32,
}

/// What to do with boxes of a class.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CategoryRule {
    /// Leave them out.
    Drop,
    /// Give them this category.
    #[serde(untagged)]
    As(String),
}

/// `manifest.json` beside the data.
pub type Argoverse2Manifest = WriterManifest<Argoverse2WriterConfig, ManifestLog>;

/// Where a log of the dataset comes from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ManifestLog {
    /// Its folder's name.
    pub log: String,
    /// The split it lies in.
    pub split: Split,
    /// Dataset the frames were opened under.
    pub source_dataset: String,
    /// Scene they are of.
    pub source_scene: String,
    /// The source's own names of the frames, in order.
    pub source_frames: Vec<String>,
    /// Pictures written.
    pub pictures: usize,
}

impl Argoverse2WriterConfig {
    /// Pictures of their own size, JPEG quality 95 where one must be encoded, no lidar points.
    pub fn new(out: impl Into<PathBuf>, source: impl Into<String>) -> Self {
        Self {
            out: out.into(),
            force: false,
            source: source.into(),
            channels: BTreeMap::new(),
            categories: BTreeMap::new(),
            image_scale: default_image_scale(),
            jpeg_quality: default_jpeg_quality(),
            lidar_columns: 0,
        }
    }

    /// The category a box is written with: its own if the layout has it, else the rule of its class, else the nearest category. `None`
    /// for a box that is left out.
    ///
    /// The nearest categories are those of [`taxonomy::nearest_argoverse2`].
    ///
    /// # Errors
    /// [`DataError::UnknownClass`] for class `Other` without a rule.
    pub fn category<'a>(&'a self, source_class: &'a str, class: ObjectClass) -> Result<Option<&'a str>, DataError> {
        if taxonomy::from_argoverse2(source_class).is_some() {
            return Ok(Some(source_class));
        }
        let nearest = match (self.categories.get(&class), class) {
            (Some(CategoryRule::Drop), _) => return Ok(None),
            (Some(CategoryRule::As(category)), _) => category,
            (None, class) => taxonomy::nearest_argoverse2(class).ok_or_else(|| DataError::UnknownClass {
                dataset: "the argoverse2 writer (`categories`)".to_owned(),
                name: source_class.to_owned(),
            })?,
        };
        Ok(Some(nearest))
    }

    /// The layout's camera name of a channel.
    pub(super) fn camera_name<'a>(&'a self, channel: &'a str) -> Result<&'a str, DataError> {
        let name = self.channels.get(channel).map_or(channel, String::as_str);
        if RING.iter().chain(&STEREO).any(|known| *known == name) {
            return Ok(name);
        }
        let known = [&RING[..], &STEREO[..]].concat().join(", ");
        Err(DataError::Config(format!("{name} is no camera of the layout; name one of {known} under `channels`")))
    }

    /// # Errors
    /// [`DataError::Config`], naming the setting.
    pub(super) fn check(&self) -> Result<(), DataError> {
        let refuse = |text: String| Err(DataError::Config(text));
        if !(1..=100).contains(&self.jpeg_quality) {
            return refuse(format!("jpeg_quality is {}, it must be 1 to 100", self.jpeg_quality));
        }
        if !(self.image_scale > 0.0 && self.image_scale <= 16.0) {
            return refuse(format!("image_scale is {}, it must be above 0 and at most 16", self.image_scale));
        }
        for rule in self.categories.values() {
            if let CategoryRule::As(category) = rule
                && taxonomy::from_argoverse2(category).is_none()
            {
                return refuse(format!("{category} is no category of the layout"));
            }
        }
        Ok(())
    }

    pub(super) fn picture_text(&self) -> String {
        let quality = self.jpeg_quality;
        if self.image_scale == 1.0 {
            return format!("jpeg, copied; others encoded with quality {quality}; not resampled");
        }
        format!("jpeg, quality {quality}; scaled by {}, files by area average, renderings exactly", self.image_scale)
    }
}

const fn default_image_scale() -> f64 {
    1.0
}

const fn default_jpeg_quality() -> u8 {
    95
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn categories_are_kept_found_or_refused() {
        let mut config = Argoverse2WriterConfig::new("out", "test");
        assert_eq!(config.category("BOX_TRUCK", ObjectClass::Truck).unwrap(), Some("BOX_TRUCK"));
        assert_eq!(config.category("vehicle.truck", ObjectClass::Truck).unwrap(), Some("TRUCK"));
        assert!(matches!(config.category("debris", ObjectClass::Other), Err(DataError::UnknownClass { .. })));
        config.categories.insert(ObjectClass::Other, CategoryRule::Drop);
        config.categories.insert(ObjectClass::Truck, CategoryRule::As("TRUCK_CAB".into()));
        assert_eq!(config.category("debris", ObjectClass::Other).unwrap(), None);
        assert_eq!(config.category("vehicle.truck", ObjectClass::Truck).unwrap(), Some("TRUCK_CAB"));
        config.check().unwrap();
        for class in ObjectClass::ALL {
            let category = config.category("?", class).unwrap();
            assert!(category.is_none_or(|category| taxonomy::from_argoverse2(category).is_some()));
        }
        let text = serde_json::to_string(&config).unwrap();
        assert_eq!(serde_json::from_str::<Argoverse2WriterConfig>(&text).unwrap().categories, config.categories);
    }

    #[test]
    fn settings_that_cannot_be_met_name_themselves() {
        let refused = |change: fn(&mut Argoverse2WriterConfig)| {
            let mut config = Argoverse2WriterConfig::new("out", "test");
            change(&mut config);
            config.check().unwrap_err().to_string()
        };
        assert!(refused(|c| c.jpeg_quality = 0).contains("jpeg_quality"));
        assert!(refused(|c| c.image_scale = f64::NAN).contains("image_scale"));
        let unknown = |c: &mut Argoverse2WriterConfig| {
            c.categories.insert(ObjectClass::Car, CategoryRule::As("CAR".into()));
        };
        assert!(refused(unknown).contains("CAR is no category"));
        let mut config = Argoverse2WriterConfig::new("out", "test");
        assert!(config.camera_name("CAM_FRONT").is_err());
        config.channels.insert("CAM_FRONT".into(), "ring_front_center".into());
        assert_eq!(config.camera_name("CAM_FRONT").unwrap(), "ring_front_center");
    }
}
