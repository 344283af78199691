//! Writes any frames in the layout of Waymo's second release: Parquet tables with the literal column names of the published ones.
//!
//! The layout holds pictures, poses, calibration, boxes and three words about the scene. It has no place for maps, masks,
//! attributes, visibility and finer classes than its five, see [`write_waymo`].

mod components;
mod config;
mod pictures;
mod plan;
mod table;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use sha2::{Digest, Sha256};

pub use config::{WaymoManifest, WaymoManifestScene, WaymoWriterConfig};

use crate::staging::{self as files, Staging};
use crate::{DataError, SceneFrame};
use plan::Scene;

/// Writes frames: those of one scene must follow each other, in order of time. `progress` is called with the numbers of frames
/// written and to write.
///
/// JPEG pictures are copied byte for byte, others are encoded in the configured quality. A view without a picture has no row. Boxes
/// become VEHICLE, PEDESTRIAN, SIGN, CYCLIST or UNKNOWN by their native name if it is one of these, else by their class; a scene
/// must be annotated in all frames or in none. Stamps are kept to the microsecond, stamps of pictures to a quarter of one. Scene texts
/// of three parts become time of day, location and weather, other texts stand in the last of these whole. The shutter is said to be
/// global.
///
/// The folder appears at its place when it is complete; a failed or interrupted run leaves nothing there. Two runs with the same
/// frames give identical bytes, on any number of threads.
///
/// # Errors
/// [`DataError::Config`] for frames that the layout cannot hold and for an output that exists; whatever is wrong with the pictures;
/// [`DataError::Io`] naming the file.
pub fn write_waymo(
    config: &WaymoWriterConfig,
    frames: &[SceneFrame],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<WaymoManifest, DataError> {
    config.check()?;
    let scenes = plan::plan(config, frames)?;
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let (mut sha256, mut pictures, mut done) = (BTreeMap::new(), 0, 0);
    for scene in &scenes {
        let folder = |component: &str| -> Result<(String, std::path::PathBuf), DataError> {
            let name = format!("{}/{component}/{}.parquet", config.split, scene.name);
            let path = root.join(&name);
            files::create_dir(path.parent().unwrap_or(&root))?;
            Ok((name, path))
        };
        for (component, table) in components::small_tables(scene)? {
            let (name, path) = folder(component)?;
            sha256.insert(name, table.write(&path)?);
        }
        let (name, path) = folder("camera_image")?;
        let mut advance = |frames: usize| {
            done += frames;
            progress(done, total(&scenes));
        };
        let written = pictures::write(config, scene, &path, &mut advance)?;
        pictures += written.count;
        sha256.insert(name, written.sha256);
    }
    let manifest = manifest(config, &scenes, pictures, sha256, &root)?;
    staging.publish()?;
    Ok(manifest)
}

fn total(scenes: &[Scene<'_>]) -> usize {
    scenes.iter().map(|scene| scene.frames.len()).sum()
}

fn manifest(
    config: &WaymoWriterConfig,
    scenes: &[Scene<'_>],
    picture_count: usize,
    sha256: BTreeMap<String, String>,
    root: &Path,
) -> Result<WaymoManifest, DataError> {
    let path = root.join(files::MANIFEST);
    let json = |e: serde_json::Error| DataError::Json { why: e.to_string(), path: path.clone() };
    let sources: BTreeSet<&str> = scenes.iter().flat_map(|s| s.frames.iter().map(|f| f.id.dataset.as_str())).collect();
    let entry = |scene: &Scene<'_>| WaymoManifestScene {
        name: scene.name.to_owned(),
        dataset: scene.frames.first().map(|frame| frame.id.dataset.clone()).unwrap_or_default(),
        frames: scene.frames.iter().map(|frame| frame.id.frame.clone()).collect(),
    };
    let manifest = WaymoManifest {
        tool: concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned(),
        format: "waymo v2".to_owned(),
        source: sources.into_iter().map(ToOwned::to_owned).collect(),
        pictures: format!("jpeg, as stored or else quality {}; at their own size, not resampled", config.jpeg_quality),
        picture_count,
        config_sha256: table::hex(&Sha256::digest(serde_json::to_vec(config).map_err(json)?)),
        config: config.clone(),
        scenes: scenes.iter().map(entry).collect(),
        sha256,
    };
    files::write(&path, &serde_json::to_vec_pretty(&manifest).map_err(json)?)?;
    Ok(manifest)
}
