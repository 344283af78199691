//! What can go wrong around training. Callers tell the cases apart without reading the message.

use std::path::{Path, PathBuf};

use crate::weights::WeightDiff;

/// A run that cannot start, go on or be stored as asked.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// A device name that does not exist.
    #[error("unknown device {text:?}; known are {known}")]
    UnknownDevice {
        /// The name as given.
        text: String,
        /// The names that exist.
        known: String,
    },
    /// A backend that exists but is not part of this program.
    #[error("device {device:?} is not compiled in; build with `--features {device}` to have it")]
    BackendMissing {
        /// Name of the device, which is also the name of the Cargo feature.
        device: &'static str,
    },
    /// A backend that is compiled in but finds no usable hardware or driver.
    #[error(
        "device {device:?} cannot be used on this machine: {why}; choose another with --device, `flex` always works"
    )]
    DeviceUnavailable {
        /// Name of the device.
        device: &'static str,
        /// The backend's complaint.
        why: String,
    },
    /// The operating system refused.
    #[error("cannot {action} ({source}): {}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// Why it failed.
        source: std::io::Error,
        /// On which file.
        path: PathBuf,
    },
    /// A file that is not what its name promises.
    #[error("not a usable file, {why}: {}", path.display())]
    Damaged {
        /// Complaint.
        why: String,
        /// The file or checkpoint folder.
        path: PathBuf,
    },
    /// Weights that do not fit the module they were meant for.
    #[error("weights do not fit the model: {}\n{diff}", path.display())]
    WeightMismatch {
        /// Every missing, unexpected and wrongly shaped tensor.
        diff: WeightDiff,
        /// The weight file.
        path: PathBuf,
    },
    /// No checkpoint, or none that is whole.
    #[error("no usable checkpoint ({why}): {}", path.display())]
    NoCheckpoint {
        /// Whether there was none or all were damaged.
        why: String,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// A run folder that already holds a run.
    #[error("the run folder is not empty; continue it with --resume or choose another name: {}", path.display())]
    RunExists {
        /// The folder.
        path: PathBuf,
    },
    /// Settings that contradict each other or the checkpoint.
    #[error("{0}")]
    Config(String),
    /// Too many updates in a row with NaN or infinite numbers.
    #[error(
        "step {step}: {culprit} is not finite, {in_a_row} updates in a row were skipped; a smaller learning rate or a look at the last batches may help"
    )]
    NonFinite {
        /// The gradient, norm or scalar that is not finite.
        culprit: String,
        /// Step (counted from 0) of the last skipped update.
        step: u64,
        /// How many updates were skipped in a row.
        in_a_row: u32,
    },
    /// The task or its data failed; the cause says how.
    #[error("{0}")]
    Task(#[source] Box<dyn std::error::Error + Send + Sync>),
}

impl TrainError {
    /// Wraps an error of the task or of its data.
    pub fn task(error: impl Into<Box<dyn std::error::Error + Send + Sync>>) -> Self {
        Self::Task(error.into())
    }

    /// Names the file and the action of an operating-system error.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.to_path_buf();
        move |source| Self::Io { action, source, path }
    }

    /// A file that is not what it should be.
    pub(crate) fn damaged(why: impl Into<String>, path: &Path) -> Self {
        Self::Damaged { why: why.into(), path: path.to_path_buf() }
    }
}
