//! Checkpoints of the public inference code (section 9): names, shapes, and where averaged weights lie.

mod checkpoint;
mod names;
mod report;

pub use checkpoint::{Average, OfficialCheckpoint, OfficialError};
pub use names::{is_ignored, official_name, official_shape};
pub use report::{KeyReport, KeyStatus, Report};
