//! COLMAP sparse models: reader and writer of `cameras.bin`, `images.bin` and `points3D.bin`.
//!
//! Format: <https://colmap.github.io/format.html#binary-file-format>, little endian and packed. Poses are `cam_from_world`, pixel
//! centres lie at +0.5 as everywhere in this project, the unit of length is whatever the model was solved in. The newer `rigs.bin`
//! and `frames.bin` are not needed and not read.

mod bytes;
mod camera;
mod images;
mod points;

use std::collections::{HashMap, HashSet};
use std::path::Path;

pub use camera::{Camera, CameraModel, read_cameras, write_cameras};
pub use images::{Image, Point2d, read_images, write_images};
pub use points::{Point3d, TrackElement, read_points, write_points};

use crate::store::Store;
use crate::{DataError, staging};

/// File names inside a model's folder.
const FILES: [&str; 3] = ["cameras.bin", "images.bin", "points3D.bin"];

/// How much of a model to read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Detail {
    /// Everything, links between pictures and points included.
    Whole,
    /// Cameras, poses and point positions; observations and tracks, most of the bytes, are skipped over and come back empty.
    WithoutTracks,
}

/// A sparse model.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Model {
    /// Cameras in file order, ids unique.
    pub cameras: Vec<Camera>,
    /// Pictures in file order, which means nothing; ids and names unique.
    pub images: Vec<Image>,
    /// Points in file order, ids unique.
    pub points: Vec<Point3d>,
}

impl Model {
    /// Reads the three files of a folder below a root and checks that they fit together.
    ///
    /// # Errors
    /// [`DataError::Missing`] for an absent file, [`DataError::Format`] and [`DataError::Truncated`] with the byte,
    /// [`DataError::Calibration`], [`DataError::UnsafePath`] and [`DataError::DuplicateToken`] for single records,
    /// [`DataError::Dangling`] for a picture without camera and (when read whole) for links that lead nowhere.
    pub fn read(store: &Store, folder: &str, detail: Detail) -> Result<Self, DataError> {
        let file = |name: &str| {
            let path = if folder.is_empty() { name.to_owned() } else { format!("{folder}/{name}") };
            store.file(&path, "COLMAP file")
        };
        let [cameras, images, points] = FILES.map(file);
        let (images, points) = (images?, points?);
        let model = Self {
            cameras: read_cameras(&cameras?)?,
            images: read_images(&images, detail)?,
            points: read_points(&points, detail)?,
        };
        model.check_cameras(images.path())?;
        if detail == Detail::Whole {
            model.check_observations(images.path())?;
            model.check_tracks(points.path())?;
        }
        Ok(model)
    }

    /// Names and bytes of the three files.
    pub fn to_bytes(&self) -> [(&'static str, Vec<u8>); 3] {
        let [cameras, images, points] = FILES;
        [
            (cameras, write_cameras(&self.cameras)),
            (images, write_images(&self.images)),
            (points, write_points(&self.points)),
        ]
    }

    /// Writes the three files into an existing folder.
    ///
    /// # Errors
    /// [`DataError::Io`], naming the file.
    pub fn write(&self, folder: &Path) -> Result<(), DataError> {
        self.to_bytes().iter().try_for_each(|(name, bytes)| staging::write(&folder.join(name), bytes))
    }

    fn check_cameras(&self, path: &Path) -> Result<(), DataError> {
        let known: HashSet<u32> = self.cameras.iter().map(|camera| camera.id).collect();
        match self.images.iter().find(|image| !known.contains(&image.camera_id)) {
            Some(image) => Err(dangling("images", &image.name, "camera_id", path)),
            None => Ok(()),
        }
    }

    fn check_observations(&self, path: &Path) -> Result<(), DataError> {
        let known: HashSet<u64> = self.points.iter().map(|point| point.id).collect();
        let lost =
            |image: &&Image| image.points.iter().filter_map(|seen| seen.point3d_id).any(|id| !known.contains(&id));
        match self.images.iter().find(lost) {
            Some(image) => Err(dangling("images", &image.name, "point3D_id", path)),
            None => Ok(()),
        }
    }

    fn check_tracks(&self, path: &Path) -> Result<(), DataError> {
        let counts: HashMap<u32, usize> = self.images.iter().map(|image| (image.id, image.points.len())).collect();
        let lost = |element: &TrackElement| {
            counts.get(&element.image_id).is_none_or(|count| element.point2d_index as usize >= *count)
        };
        match self.points.iter().find(|point| point.track.iter().any(lost)) {
            Some(point) => Err(dangling("points3D", &point.id.to_string(), "track", path)),
            None => Ok(()),
        }
    }
}

fn dangling(table: &'static str, token: &str, field: &'static str, path: &Path) -> DataError {
    DataError::Dangling { table, token: token.to_owned(), field, path: path.to_owned() }
}

/// The first key that occurs twice.
fn check_unique<K: std::hash::Hash + Eq>(
    table: &'static str,
    keys: impl Iterator<Item = (K, String)>,
    path: &Path,
) -> Result<(), DataError> {
    let mut seen = HashSet::new();
    for (key, token) in keys {
        if !seen.insert(key) {
            return Err(DataError::DuplicateToken { table, token, path: path.to_owned() });
        }
    }
    Ok(())
}
