//! Writes frames of any dataset in the nuPlan layout: one SQLite database per scene, pictures, manifest.
//!
//! The layout holds less than a [`SceneFrame`]: seven classes, one calibration per log, microseconds, and neither attributes nor point counts,
//! visibility, masks, fisheyes nor point clouds. What it cannot hold faithfully (a fisheye, two calibrations of one camera, frames too close in
//! time) is refused; the rest is left out. A frame without boxes among annotated ones loses its reference instant and its text, a frame without
//! any picture is not offered by the reader.

mod annotations;
mod config;
mod pictures;
mod plan;
mod poses;
mod rows;
mod schema;

use std::collections::BTreeMap;
use std::path::Path;

use sha2::{Digest, Sha256};

pub use config::{NuPlanManifest, NuPlanManifestFrame, NuPlanManifestLog, NuPlanWriterConfig};

use crate::manifest::WriterManifest;
use crate::staging::{self as files, Staging, hex};
use crate::{DataError, SceneFrame};
use plan::Plan;

/// Folder of the release inside `out`.
const RELEASE: &str = "nuplan-v1.1";

/// Writes the frames; each scene becomes a log of its name, its frames sorted by time. `progress` is called with the numbers of pictures
/// written and to write.
///
/// The folder appears at its place when it is complete; a failed or interrupted run leaves nothing there. Two runs with one
/// configuration and the same frames give identical bytes, on any number of threads.
///
/// # Errors
/// [`DataError::Config`] for settings and frames that cannot be met and for an output that exists; whatever is wrong with a source picture;
/// [`DataError::Io`] naming the file.
pub fn write_nuplan(
    frames: &[SceneFrame],
    config: &NuPlanWriterConfig,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<NuPlanManifest, DataError> {
    config.check()?;
    let plans = plan::plan(frames, config)?;
    if plans.is_empty() {
        return Err(DataError::Empty { what: "the list of frames to write".to_owned(), path: config.out.clone() });
    }
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let databases = format!("{RELEASE}/splits/{}", config.folder);
    files::create_dir(&root.join(&databases))?;
    // Databases first: frames that cannot be written show before hours of rendering.
    let mut sha256 = BTreeMap::new();
    for plan in &plans {
        let name = format!("{databases}/{}.db", plan.name);
        let bytes = rows::database(plan, config, &root.join(&name))?;
        files::write(&root.join(&name), &bytes)?;
        sha256.insert(name, hex(&Sha256::digest(&bytes)));
    }
    let pictures = pictures::write(&plans, config, &root.join(RELEASE).join("sensor_blobs"), progress)?;
    let manifest = manifest(config, &plans, pictures, sha256, &root)?;
    staging.publish()?;
    Ok(manifest)
}

fn manifest(
    config: &NuPlanWriterConfig,
    plans: &[Plan<'_>],
    picture_count: usize,
    sha256: BTreeMap<String, String>,
    root: &Path,
) -> Result<NuPlanManifest, DataError> {
    let path = root.join(files::MANIFEST);
    let json = |e: serde_json::Error| DataError::Json { why: e.to_string(), path: path.clone() };
    let mut sources: Vec<&str> =
        plans.iter().flat_map(|plan| &plan.frames).map(|planned| planned.frame.id.dataset.as_str()).collect();
    sources.sort_unstable();
    sources.dedup();
    let scenes = plans.iter().map(|plan| {
        let frame = |planned: &plan::PlannedFrame<'_>| {
            NuPlanManifestFrame::new(&planned.frame.id, planned.lidar.map(|lidar| lidar.to_string()))
        };
        NuPlanManifestLog { name: plan.name.clone(), frames: plan.frames.iter().map(frame).collect() }
    });
    let manifest = WriterManifest {
        tool: concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned(),
        format: RELEASE.to_owned(),
        source: sources.join(", "),
        pictures: pictures::describe(config),
        picture_count,
        config_sha256: hex(&Sha256::digest(serde_json::to_vec(config).map_err(json)?)),
        config: config.clone(),
        scenes: scenes.collect(),
        sha256,
    };
    files::write(&path, &serde_json::to_vec_pretty(&manifest).map_err(json)?)?;
    Ok(manifest)
}
