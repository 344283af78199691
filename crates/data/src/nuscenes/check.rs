//! Finds every missing or damaged picture before a training run does.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::config::NuScenesConfig;
use super::{NuScenes, SceneDataset};
use crate::{DataError, ImageSource};

/// What a check of the chosen scenes found.
#[derive(Debug)]
pub struct CheckReport {
    /// Scenes looked at.
    pub scenes: usize,
    /// Frames they give.
    pub frames: usize,
    /// Pictures of those frames, each counted once.
    pub pictures: usize,
    /// Views of those frames for which the tables list no picture. No fault: cameras drop pictures.
    pub absent_views: usize,
    /// Pictures decoded completely.
    pub decoded: usize,
    /// Every fault, in order of the files' paths.
    pub problems: Vec<DataError>,
}

impl CheckReport {
    /// True when no picture is missing or damaged.
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }

    /// Number of pictures that do not exist.
    pub fn missing(&self) -> usize {
        self.problems.iter().filter(|problem| matches!(problem, DataError::Missing { .. })).count()
    }

    /// Number of pictures that exist but cannot be used.
    pub fn damaged(&self) -> usize {
        self.problems.len() - self.missing()
    }
}

/// Opens the tables, looks at every picture of every frame (existence, size, end) and decodes `decode` pictures of each scene
/// completely, spread evenly over it.
///
/// # Errors
/// Broken tables and poses; broken pictures are listed in the report.
pub fn check(config: &NuScenesConfig, decode: usize) -> Result<CheckReport, DataError> {
    check_dataset(&NuScenes::open(config)?, decode)
}

/// The same for any opened dataset.
///
/// # Errors
/// Frames that cannot be read; broken pictures are listed in the report.
pub fn check_dataset(dataset: &dyn SceneDataset, decode: usize) -> Result<CheckReport, DataError> {
    let scenes = dataset.scene_ranges();
    let mut report = CheckReport {
        scenes: scenes.len(),
        frames: dataset.len(),
        pictures: 0,
        absent_views: 0,
        decoded: 0,
        problems: Vec::new(),
    };
    for scene in scenes {
        let mut pictures = BTreeSet::new();
        for index in scene {
            for view in dataset.frame(index)?.views {
                match view.image {
                    Some(ImageSource::File { file, size }) => _ = pictures.insert((file, size)),
                    Some(ImageSource::Rendered { .. } | ImageSource::Embedded { .. }) => {}
                    None => report.absent_views += 1,
                }
            }
        }
        let pictures: Vec<_> = pictures.into_iter().collect();
        let chosen = decode.min(pictures.len());
        let decoded: BTreeSet<usize> = (0..chosen).map(|i| (2 * i + 1) * pictures.len() / (2 * chosen)).collect();
        let faults = pictures.into_par_iter().enumerate().map(|(at, (file, size))| {
            let source = ImageSource::File { file, size };
            let outcome = if decoded.contains(&at) { source.decode().map(drop) } else { source.inspect() };
            (decoded.contains(&at), outcome.err())
        });
        let faults: Vec<_> = faults.collect();
        report.pictures += faults.len();
        report.decoded += faults.iter().filter(|fault| fault.0).count();
        report.problems.extend(faults.into_iter().filter_map(|fault| fault.1));
    }
    Ok(report)
}
