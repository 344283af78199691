//! Generated pictures as a native dataset: the frames of a dataset painted by any model, with their calibration and boxes.
//!
//! Frames are painted one by one into a folder beside the output, each in a folder of its own that appears when it is complete. So a run
//! that ends early goes on where it stood, and several runs may share the work ([`Shard`]); the one that finds all frames there makes the
//! dataset. What is written depends on the frame alone, never on the run that painted it.

mod conditioned;
mod config;
mod finished;
mod history;
mod publish;

use rayon::prelude::*;

use crate::{DataError, SceneDataset, SceneFrame};

pub use conditioned::{Conditioned, conditioned};
pub use config::{ExportConfig, ExportFormat, Generator, Shard};
pub use history::{HistoryConfig, HistoryManifest, LinkKind, ReplacedFrame, replace_history};
pub use publish::{ExportManifest, ExportedFrame};

use finished::Finished;

/// From the number of a frame and the frame to a picture for each of its views, in their order and of any size; `None` leaves one out.
pub type Painter<'a> = dyn FnMut(usize, &SceneFrame) -> Result<Vec<Option<image::RgbImage>>, DataError> + 'a;

/// What a run of [`export`] came to.
#[derive(Debug, Clone, PartialEq)]
pub enum Exported {
    /// All frames are there, the dataset is made.
    Whole(Box<ExportManifest>),
    /// This run's part is done; frames of other parts are not.
    Part {
        /// Frames that are finished, by any run.
        finished: usize,
        /// Frames in all.
        frames: usize,
    },
}

/// Paints the frames of `source` that belong to this run's shard and are not finished yet, then makes the dataset if no frame is missing.
///
/// `source` says what is written: frames of any dataset, with the cameras that shall be painted and the boxes that the pictures were made
/// from. `progress` is called with the numbers of this run's frames done and to do.
///
/// # Errors
/// [`DataError::Config`] for an output that exists, for settings and frames that the layout cannot hold, and for an unfinished export that
/// was begun with other settings; whatever the painter says; [`DataError::Io`], naming the file.
pub fn export(
    source: &dyn SceneDataset,
    config: &ExportConfig,
    painter: &mut Painter<'_>,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Exported, DataError> {
    config.check()?;
    crate::staging::check_target(&config.out, config.force)?;
    if source.is_empty() {
        return Err(DataError::Empty { what: source.name().to_owned(), path: config.out.clone() });
    }
    let finished = Finished::open(config, source)?;
    let mine: Vec<usize> = (0..source.len()).filter(|index| config.shard.holds(*index)).collect();
    for (done, index) in mine.iter().enumerate() {
        progress(done, mine.len());
        if finished.has(*index) {
            continue;
        }
        let frame = source.frame(*index)?;
        let pictures = painter(*index, &frame).map_err(|error| crate::sample::in_frame(&frame.id, error))?;
        finished.add(*index, &frame, &pictures).map_err(|error| {
            if finished.is_gone() { finished.gone() } else { crate::sample::in_frame(&frame.id, error) }
        })?;
    }
    progress(mine.len(), mine.len());
    let frames = source.len();
    let there = (0..frames).into_par_iter().filter(|index| finished.has(*index)).count();
    if there < frames {
        return Ok(Exported::Part { finished: there, frames });
    }
    let manifest = publish::publish(source, config, &finished)?;
    finished.remove()?;
    Ok(Exported::Whole(Box::new(manifest)))
}
