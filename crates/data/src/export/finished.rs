//! Frames that are painted and wait for the others.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use geometry::ImageEdit;
use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{ExportConfig, Generator};
use crate::staging::{self, io};
use crate::store::StoredFile;
use crate::{DataError, ImageSource, SceneDataset, SceneFrame, View};

/// The resampling filter, for manifests.
pub(super) const FILTER: &str = "linear between pixel centres when enlarged, by area when shrunk";

/// What an unfinished export was begun with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Plan {
    format: String,
    source: String,
    frames: usize,
    filter: String,
    jpeg_quality: u8,
    generator: Generator,
}

/// The folder beside the output that holds finished frames.
#[derive(Debug)]
pub(super) struct Finished {
    folder: PathBuf,
    jpeg_quality: u8,
}

impl Finished {
    /// Begins the folder, or goes on with one that was begun with the same settings.
    pub(super) fn open(config: &ExportConfig<'_>, source: &dyn SceneDataset) -> Result<Self, DataError> {
        let mut name = config.out.file_name().unwrap_or_default().to_owned();
        name.push(".frames");
        let folder = config.out.with_file_name(name);
        let plan = Plan {
            format: config.format.name().to_owned(),
            source: source.name().to_owned(),
            frames: source.len(),
            filter: FILTER.to_owned(),
            jpeg_quality: config.jpeg_quality,
            generator: config.generator.clone(),
        };
        let path = folder.join("plan.json");
        if path.is_file() {
            check_plan(&plan, &path)?;
        } else {
            let bytes = serde_json::to_vec_pretty(&plan)
                .map_err(|error| DataError::Json { why: error.to_string(), path: path.clone() })?;
            staging::write_renamed(&path, &bytes)?;
        }
        Ok(Self { folder, jpeg_quality: config.jpeg_quality })
    }

    fn frame(&self, index: usize) -> PathBuf {
        self.folder.join(format!("{index:08}"))
    }

    pub(super) fn has(&self, index: usize) -> bool {
        self.frame(index).is_dir()
    }

    fn picture(&self, index: usize, view: usize) -> PathBuf {
        self.frame(index).join(format!("{view:02}.jpg"))
    }

    /// Brings the pictures to the size of their cameras and keeps them. Of two runs that paint one frame at once, the first counts.
    pub(super) fn add(&self, index: usize, frame: &SceneFrame, pictures: &[Option<RgbImage>]) -> Result<(), DataError> {
        if pictures.len() != frame.views.len() {
            let (views, pictures) = (frame.views.len(), pictures.len());
            return Err(DataError::Config(format!("{pictures} pictures for {views} views")));
        }
        let part = tempfile::Builder::new()
            .prefix(".part-")
            .tempdir_in(&self.folder)
            .map_err(io("make a temporary folder in", &self.folder))?;
        // One level deeper: the temporary folder itself is readable by its owner only.
        let whole = part.path().join("frame");
        staging::create_dir(&whole)?;
        frame.views.par_iter().zip(pictures).enumerate().try_for_each(|(at, (view, picture))| {
            let Some(picture) = picture else { return Ok(()) };
            let path = whole.join(format!("{at:02}.jpg"));
            staging::write(&path, &encode(view, picture, self.jpeg_quality, &path)?)
        })?;
        match std::fs::rename(&whole, self.frame(index)) {
            Err(_) if self.has(index) => Ok(()),
            renamed => renamed.map_err(io("finish", &self.frame(index))),
        }
    }

    /// The picture of a view of a finished frame; `None` where the painter left it out.
    pub(super) fn source(&self, index: usize, at: usize, view: &View) -> Result<Option<ImageSource>, DataError> {
        let path = self.picture(index, at);
        let size = (view.intrinsics.width, view.intrinsics.height);
        if path.is_file() {
            return Ok(Some(ImageSource::File { file: StoredFile::from(path), size }));
        }
        // Asked second, because the whole folder goes at once.
        if self.has(index) { Ok(None) } else { Err(self.gone()) }
    }

    /// Whether another run has made the dataset and taken the folder away.
    pub(super) fn is_gone(&self) -> bool {
        !self.folder.is_dir()
    }

    pub(super) fn gone(&self) -> DataError {
        let folder = self.folder.display();
        DataError::Config(format!(
            "another run of this export has finished it meanwhile, its frames are gone: {folder}"
        ))
    }

    /// Removes the folder once the dataset is made, for other runs all at once.
    pub(super) fn remove(&self) -> Result<(), DataError> {
        let old = self.folder.with_extension("frames-done");
        match std::fs::rename(&self.folder, &old) {
            // Another run of the same export was quicker.
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(()),
            renamed => renamed.and_then(|()| std::fs::remove_dir_all(&old)).map_err(io("remove", &self.folder)),
        }
    }
}

fn check_plan(plan: &Plan, path: &Path) -> Result<(), DataError> {
    let bytes = std::fs::read(path).map_err(io("read", path))?;
    let begun: Plan = serde_json::from_slice(&bytes)
        .map_err(|error| DataError::Json { why: error.to_string(), path: path.to_owned() })?;
    if begun == *plan {
        return Ok(());
    }
    let folder = path.parent().unwrap_or(path).display();
    Err(DataError::Config(format!(
        "an export with other settings was begun there ({}); finish it with those, choose another output, or remove its folder: {folder}",
        differences(&begun, plan)
    )))
}

/// The settings that differ, `name: old, now new`.
fn differences(begun: &Plan, now: &Plan) -> String {
    let flat = |plan: &Plan| {
        let mut value = serde_json::to_value(plan).unwrap_or_default();
        let generator = value.as_object_mut().and_then(|all| all.remove("generator")).unwrap_or_default();
        let (mut all, inner) = (value.as_object().cloned().unwrap_or_default(), generator.as_object().cloned());
        all.extend(inner.unwrap_or_default());
        all
    };
    let (begun, now) = (flat(begun), flat(now));
    let changed = begun.iter().filter(|(name, value)| now.get(*name) != Some(*value));
    let text = changed.map(|(name, value)| format!("{name}: {value}, now {}", now.get(name).unwrap_or(value)));
    text.collect::<Vec<_>>().join("; ")
}

fn encode(view: &View, picture: &RgbImage, quality: u8, path: &Path) -> Result<Vec<u8>, DataError> {
    let (width, height) = picture.dimensions();
    let edit = ImageEdit::identity(width, height).resize(view.intrinsics.width, view.intrinsics.height);
    let source = ImageSource::Memory { picture: Arc::new(picture.clone()), size: (width, height) };
    let pixels = source.load(&edit)?;
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, quality)
        .encode(pixels.as_raw(), pixels.width(), pixels.height(), ExtendedColorType::Rgb8)
        .map_err(|error| DataError::Image { why: error.to_string(), path: path.to_owned() })?;
    Ok(bytes)
}
