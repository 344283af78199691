//! Evaluation of pictures against pictures: all metrics in one pass, by named protocols.
//!
//! `source` gives the pictures, `pass` walks over them once, `scalar` and `streams` collect, `report` and `page` tell.

mod chart;
mod detections;
mod network;
mod page;
mod painted;
mod pass;
mod report;
mod scalar;
mod segmentation;
mod source;
mod statistics_file;
mod streams;

use std::path::Path;

use anyhow::Context;

pub use chart::Curve;
pub use detections::{detection_markdown, detection_score};
pub use network::{
    FeatureNetwork, Loaded, NetworkFolder, PairNetwork, Pictures, SeamMatcher, WeightsUsed, network_input,
};
pub use page::{draw_curves, draw_report};
pub use painted::Painted;
pub use pass::{Pass, PassOptions};
pub use report::{MetricReport, Replaced, Report, STAND_IN, numbers};
pub use scalar::{ScalarMetric, measure, needs_pairs, prepared};
pub use segmentation::{ClassScore, SegmentationScore, segmentation_score};
pub use source::{DatasetPictures, Folder, Instant, PictureSource, Shot};
pub use statistics_file::SavedStatistics;
pub use streams::{ClipCutter, FeatureStream, SeamStream, Side, SideFeatures};

/// Writes a file so that no reader meets half of it; makes the folder it lies in.
///
/// # Errors
/// Names the file.
pub fn write_file(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        std::fs::create_dir_all(parent).with_context(|| format!("cannot make the folder {}", parent.display()))?;
    }
    Ok(train::replace_file(path, bytes)?)
}
