//! Generated pictures under the names of real ones: tables and maps are copied, only pictures are new, so that evaluation tools run
//! unchanged.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use geometry::ImageEdit;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::NuScenes;
use crate::manifest::{Contents, WriterManifest, hex};
use crate::sample::in_frame;
use crate::staging::{self, Staging};
use crate::store::checked_name;
use crate::{DataError, ImageSource, SceneDataset, SceneFrame};

/// Every table of the layout.
const TABLES: [&str; 13] = [
    "attribute",
    "calibrated_sensor",
    "category",
    "ego_pose",
    "instance",
    "log",
    "map",
    "sample",
    "sample_annotation",
    "sample_data",
    "scene",
    "sensor",
    "visibility",
];
const EXPANSION: &str = "maps/expansion";

/// Settings of [`export_nuscenes`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NuScenesExportConfig {
    /// Folder to make.
    #[serde(skip)]
    pub out: PathBuf,
    /// Replace a folder that this crate has written.
    #[serde(skip)]
    pub force: bool,
    /// Quality of the JPEG files, 1 to 100.
    pub jpeg_quality: u8,
    /// What made the pictures, for the manifest: a model's name, its seed.
    pub made_by: String,
}

impl NuScenesExportConfig {
    /// The defaults.
    pub fn new(out: impl Into<PathBuf>, made_by: impl Into<String>) -> Self {
        Self { out: out.into(), force: false, jpeg_quality: 95, made_by: made_by.into() }
    }
}

/// The manifest of an export; its scenes are their names.
pub type NuScenesExportManifest = WriterManifest<NuScenesExportConfig, String>;

/// From the number of a frame and the frame to a picture for each of its views.
pub type NewPictures<'a> = dyn FnMut(usize, &SceneFrame) -> Result<Vec<Option<ImageSource>>, DataError> + 'a;

/// Writes the dataset again with other pictures.
///
/// `pictures` is asked for each frame in order and gives one entry for each of its views, in their order; `None` leaves a picture out.
/// A JPEG file of the size in the tables is copied. Any other picture may have any size: it is brought to the one in the tables (between pixel centres when enlarging, by area when shrinking).
/// Lidar and radar files are not copied. The folder appears when it is complete.
///
/// # Errors
/// [`DataError::Config`] for an output that exists and for pictures that fit no view; [`DataError::Missing`] for an absent table;
/// whatever is wrong with the pictures, naming the frame.
pub fn export_nuscenes(
    source: &NuScenes,
    config: &NuScenesExportConfig,
    pictures: &mut NewPictures<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<NuScenesExportManifest, DataError> {
    if !(1..=100).contains(&config.jpeg_quality) {
        return Err(DataError::Config(format!("jpeg_quality must lie in 1..=100, but is {}", config.jpeg_quality)));
    }
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let sha256 = source.copy_tables(&root)?;
    let (mut count, mut scenes) = (0, Vec::new());
    for index in 0..source.len() {
        let frame = source.frame(index)?;
        let made = pictures(index, &frame)?;
        count += source.write_pictures(index, &frame, &made, config, &root).map_err(|e| in_frame(&frame.id, e))?;
        scenes.push(frame.id.scene);
        progress(index + 1, source.len());
    }
    scenes.dedup();
    let quality = config.jpeg_quality;
    let contents = Contents {
        format: "nuScenes",
        source: format!("{} in place of the pictures of {} {}", config.made_by, source.name(), source.config.version),
        pictures: format!(
            "jpeg, quality {quality}; brought to the size in the tables, linear when enlarged, by area when shrunk"
        ),
        picture_count: count,
        sha256,
    };
    let manifest = WriterManifest::write(contents, config, scenes, &root)?;
    staging.publish()?;
    Ok(manifest)
}

impl NuScenes {
    /// Copies tables, map pictures and map expansions; gives their sums.
    fn copy_tables(&self, root: &Path) -> Result<BTreeMap<String, String>, DataError> {
        let store = &self.base.tables.store;
        let mut names: BTreeSet<String> =
            TABLES.iter().map(|table| format!("{}/{table}.json", self.config.version)).collect();
        for name in self.base.priors.iter().map(|prior| &prior.file_name) {
            // The tables of a release name maps that a user need not have.
            names.extend(store.find(checked_name(name, &self.base.path("map"))?).map(|_| name.to_string()));
        }
        names.extend(store.list(EXPANSION)?.into_iter().map(|file| format!("{EXPANSION}/{}", file.name)));
        let copy = |name: String| {
            let bytes = store.read(&name, "table or map")?;
            let path = root.join(&name);
            staging::create_dir(path.parent().unwrap_or(root))?;
            staging::write(&path, &bytes)?;
            Ok((name, hex(&Sha256::digest(&bytes))))
        };
        names.into_iter().map(copy).collect()
    }

    fn write_pictures(
        &self,
        index: usize,
        frame: &SceneFrame,
        made: &[Option<ImageSource>],
        config: &NuScenesExportConfig,
        root: &Path,
    ) -> Result<usize, DataError> {
        if made.len() != frame.views.len() {
            let (views, pictures) = (frame.views.len(), made.len());
            return Err(DataError::Config(format!("{pictures} pictures for {views} views")));
        }
        let rows = &self.set(index)?.pictures;
        let jobs: Vec<_> =
            frame.views.iter().zip(rows).zip(made).filter_map(|(v, made)| Some((v, made.as_ref()?))).collect();
        jobs.par_iter().try_for_each(|((view, row), picture)| {
            let row =
                row.ok_or_else(|| DataError::Config(format!("the tables name no picture of {}", view.channel)))?;
            let name = self.pictures.file_name(&self.pictures.rows[row as usize], &self.base);
            let path = root.join(&name);
            let (width, height) = picture.size();
            let same_size = (width, height) == (view.intrinsics.width, view.intrinsics.height);
            if let Some(bytes) = picture.jpeg_bytes()?.filter(|_| same_size) {
                staging::create_dir(path.parent().unwrap_or(root))?;
                return staging::write(&path, &bytes);
            }
            let edit = ImageEdit::identity(width, height).resize(view.intrinsics.width, view.intrinsics.height);
            let pixels = picture.load(&edit)?;
            let mut bytes = Vec::new();
            JpegEncoder::new_with_quality(&mut bytes, config.jpeg_quality)
                .encode(pixels.as_raw(), pixels.width(), pixels.height(), ExtendedColorType::Rgb8)
                .map_err(|error| DataError::Image { why: error.to_string(), path: path.clone() })?;
            staging::create_dir(path.parent().unwrap_or(root))?;
            staging::write(&path, &bytes)
        })?;
        Ok(jobs.len())
    }
}
