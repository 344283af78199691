//! Finds every missing or damaged picture before a training run does.

use std::collections::BTreeSet;

use rayon::prelude::*;

use crate::{DataError, ImageSource, SceneDataset};

/// What a check of the chosen scenes found.
#[derive(Debug)]
pub struct CheckReport {
    /// Scenes looked at.
    pub scenes: usize,
    /// Frames they give.
    pub frames: usize,
    /// Pictures and masks of those frames; a file of two frames is counted once.
    pub pictures: usize,
    /// Views of those frames for which the dataset lists no picture. No fault: cameras drop pictures.
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

/// Looks at every picture and mask of every frame (existence, size, end) and decodes `decode` of them in each scene completely, spread
/// evenly over it. Pictures that are rendered when asked for are not looked at.
///
/// # Errors
/// Frames that cannot be read; broken pictures are listed in the report.
pub fn check(dataset: &dyn SceneDataset, decode: usize) -> Result<CheckReport, DataError> {
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
        let (mut pictures, mut embedded) = (BTreeSet::new(), Vec::new());
        for index in scene {
            for view in dataset.frame(index)?.views {
                report.absent_views += usize::from(view.image.is_none());
                for source in [view.image, view.mask].into_iter().flatten() {
                    match source {
                        ImageSource::File { file, size } => _ = pictures.insert((file, size)),
                        ImageSource::Embedded { .. } => embedded.push(source),
                        ImageSource::Rendered { .. } => {}
                    }
                }
            }
        }
        let files = pictures.into_iter().map(|(file, size)| ImageSource::File { file, size });
        report.look_at(files.chain(embedded).collect(), decode);
    }
    Ok(report)
}

impl CheckReport {
    /// The pictures of one scene.
    fn look_at(&mut self, pictures: Vec<ImageSource>, decode: usize) {
        let chosen = decode.min(pictures.len());
        let decoded: BTreeSet<usize> = (0..chosen).map(|i| (2 * i + 1) * pictures.len() / (2 * chosen)).collect();
        let faults = pictures.into_par_iter().enumerate().map(|(at, source)| {
            let outcome = if decoded.contains(&at) { source.decode().map(drop) } else { source.inspect() };
            (decoded.contains(&at), outcome.err())
        });
        let faults: Vec<_> = faults.collect();
        self.pictures += faults.len();
        self.decoded += faults.iter().filter(|fault| fault.0).count();
        self.problems.extend(faults.into_iter().filter_map(|fault| fault.1));
    }
}
