//! Writes frames of any dataset in the layout of WayveScenes101: COLMAP models, pictures, masks, baselines and the table of tags.
//!
//! What the layout has no place for is lost: boxes, maps, words that are no tags, and the origin of the ego frame. Readers recover the
//! metric scale from `baselines.json` and the ground from sparse points that are put there for them.

mod config;
mod ground;
mod pictures;
mod scene;

use std::collections::BTreeMap;
use std::path::Path;

use sha2::{Digest, Sha256};

pub use config::{WayveScenesManifest, WayveScenesManifestScene, WayveScenesWriterConfig};

use crate::staging::{self, Staging, hex};
use crate::wayvescenes::{
    BASELINES_FILE, Baselines, METADATA_FILE, MODEL_FOLDER, SCENE_COLUMN, TAG_COLUMNS, cells_of_text, choose, line,
};
use crate::{DataError, SceneFrame, colmap};
use pictures::Counts;
use scene::Shot;

/// Distances that differ by less, metres, are those of one rig.
const SAME_RIG_M: f64 = 1e-6;
/// Distances this close to published ones, metres, get their region's name.
const SAME_REGION_M: f64 = 1e-3;
/// Share by which a recovered scale may differ from the written one.
const SCALE_TOLERANCE: f64 = 1e-5;

/// The frames of one scene.
struct Scene<'a> {
    name: &'a str,
    dataset: &'a str,
    frames: Vec<&'a SceneFrame>,
}

/// Makes the dataset. Frames with one scene name form a scene, in the order given. `progress` is called with the numbers of pictures
/// written and to write.
///
/// Every picture keeps its own stamp and pose; pictures of a frame that are further apart than a reader's pairing window are read back
/// as several frames. The folder appears at its place when it is complete; a failed or interrupted run leaves nothing there. Two runs
/// with one configuration give identical bytes, on any number of threads.
///
/// # Errors
/// [`DataError::Config`] for settings that cannot be met, for frames the layout cannot hold and for an output that exists;
/// [`DataError::Frame`] around a picture that cannot be read; [`DataError::Io`] naming the file.
pub fn write_wayvescenes(
    config: &WayveScenesWriterConfig,
    frames: &[SceneFrame],
    progress: &mut dyn FnMut(usize, usize),
) -> Result<WayveScenesManifest, DataError> {
    config.check()?;
    let scenes = scenes(frames)?;
    let shots: Vec<Vec<Shot<'_>>> =
        scenes.iter().map(|scene| scene::shots(config, scene.name, &scene.frames)).collect::<Result<_, _>>()?;
    check_channels(&shots)?;
    let (baselines, regions) = baselines(config, &shots)?;
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let mut sha256 = BTreeMap::new();
    let (total, mut done) = (shots.iter().map(Vec::len).sum(), 0);
    let mut counts = Counts::default();
    for (scene, shots) in scenes.iter().zip(&shots) {
        write_model(&scene::model(config, shots)?, &root, scene.name, &mut sha256)?;
        let mut advance = |pictures: usize| {
            done += pictures;
            progress(done, total);
        };
        let written = pictures::write(shots, &root.join(scene.name), config.jpeg_quality, &mut advance)?;
        counts.pictures += written.pictures;
        counts.copied += written.copied;
        counts.masks += written.masks;
    }
    write_table(&root, BASELINES_FILE, &json(&baselines, &root.join(BASELINES_FILE))?, &mut sha256)?;
    write_table(&root, METADATA_FILE, metadata(&scenes).as_bytes(), &mut sha256)?;
    let manifest = manifest(config, &scenes, regions, counts, sha256, &root)?;
    staging::write(&root.join(staging::MANIFEST), &json(&manifest, &root.join(staging::MANIFEST))?)?;
    staging.publish()?;
    Ok(manifest)
}

/// Frames by scene, in order of their first frame.
fn scenes(frames: &[SceneFrame]) -> Result<Vec<Scene<'_>>, DataError> {
    let mut scenes: Vec<Scene<'_>> = Vec::new();
    let mut place: BTreeMap<&str, usize> = BTreeMap::new();
    for frame in frames {
        let (name, dataset) = (frame.id.scene.as_str(), frame.id.dataset.as_str());
        let at = *place.entry(name).or_insert(scenes.len());
        if at == scenes.len() {
            scenes.push(Scene { name, dataset, frames: Vec::new() });
        }
        let Some(scene) = scenes.get_mut(at) else { continue };
        if scene.dataset != dataset {
            let other = scene.dataset;
            return Err(DataError::Config(format!("{dataset} and {other} both have a scene {name}; write them apart")));
        }
        scene.frames.push(frame);
    }
    if scenes.is_empty() {
        return Err(DataError::Config("there are no frames to write".to_owned()));
    }
    staging::check_names("scene name", &scenes.iter().map(|scene| scene.name.to_owned()).collect::<Vec<_>>())?;
    Ok(scenes)
}

fn check_channels(shots: &[Vec<Shot<'_>>]) -> Result<(), DataError> {
    let mut channels: Vec<String> = shots.iter().flatten().map(|shot| shot.channel.to_owned()).collect();
    channels.sort();
    channels.dedup();
    staging::check_names("channel", &channels)
}

/// The distances of every rig, and the region of each scene. A reader must find the written scale again.
fn baselines(
    config: &WayveScenesWriterConfig,
    shots: &[Vec<Shot<'_>>],
) -> Result<(Baselines, Vec<Option<String>>), DataError> {
    let (published, mut table) = (Baselines::published(), Baselines::default());
    let distances: Vec<BTreeMap<String, f64>> = shots.iter().map(|shots| scene::distances(shots)).collect();
    let mut regions = Vec::new();
    for metres in &distances {
        // A scene of one camera has no distances.
        if metres.is_empty() {
            regions.push(None);
            continue;
        }
        let known = table.find(metres, SAME_RIG_M).map(ToOwned::to_owned);
        let region = known.unwrap_or_else(|| {
            let official = published.find(metres, SAME_REGION_M).filter(|region| !table.has(region));
            let name = official.map_or_else(|| format!("rig_{}", regions.len() + 1), ToOwned::to_owned);
            table.insert(&name, metres);
            name
        });
        regions.push(Some(region));
    }
    for metres in distances.iter().filter(|metres| !metres.is_empty()) {
        let units = metres.iter().map(|(channel, d)| (channel.clone(), d * config.units_per_metre)).collect();
        let found = choose(&table, &units, &config.out)?.metres_per_unit * config.units_per_metre;
        if (found - 1.0).abs() > SCALE_TOLERANCE {
            return Err(DataError::Config(format!(
                "the rigs of these scenes are alike but for their size; readers could not tell their scales apart ({found})"
            )));
        }
    }
    Ok((table, regions))
}

fn write_model(
    model: &colmap::Model,
    root: &Path,
    scene: &str,
    sha256: &mut BTreeMap<String, String>,
) -> Result<(), DataError> {
    let folder = format!("{scene}/{MODEL_FOLDER}");
    staging::create_dir(&root.join(&folder))?;
    for (name, bytes) in model.to_bytes() {
        write_table(root, &format!("{folder}/{name}"), &bytes, sha256)?;
    }
    Ok(())
}

fn write_table(root: &Path, name: &str, bytes: &[u8], sha256: &mut BTreeMap<String, String>) -> Result<(), DataError> {
    sha256.insert(name.to_owned(), hex(&Sha256::digest(bytes)));
    staging::write(&root.join(name), bytes)
}

/// The table of tags; blank cells for a scene whose words are no tags.
fn metadata(scenes: &[Scene<'_>]) -> String {
    let mut table = line([SCENE_COLUMN].into_iter().chain(TAG_COLUMNS));
    for scene in scenes {
        let cells = text(scene).and_then(cells_of_text).unwrap_or_default();
        table += &line([scene.name].into_iter().chain(cells.iter().map(String::as_str)));
    }
    table
}

fn text<'a>(scene: &Scene<'a>) -> Option<&'a str> {
    scene.frames.iter().find_map(|frame| frame.scene_text.as_deref())
}

fn json(value: &impl serde::Serialize, path: &Path) -> Result<Vec<u8>, DataError> {
    serde_json::to_vec_pretty(value).map_err(|e| DataError::Json { why: e.to_string(), path: path.to_owned() })
}

fn manifest(
    config: &WayveScenesWriterConfig,
    scenes: &[Scene<'_>],
    regions: Vec<Option<String>>,
    counts: Counts,
    sha256: BTreeMap<String, String>,
    root: &Path,
) -> Result<WayveScenesManifest, DataError> {
    let path = root.join(staging::MANIFEST);
    let settings = serde_json::to_vec(config).map_err(|e| DataError::Json { why: e.to_string(), path })?;
    let row = |(scene, region): (&Scene<'_>, Option<String>)| WayveScenesManifestScene {
        name: scene.name.to_owned(),
        dataset: scene.dataset.to_owned(),
        frames: scene.frames.iter().map(|frame| frame.id.frame.clone()).collect(),
        region,
        text: text(scene).map(ToOwned::to_owned),
    };
    Ok(WayveScenesManifest {
        tool: concat!("rigscape ", env!("CARGO_PKG_VERSION")).to_owned(),
        format: "wayve_scenes101".to_owned(),
        pictures: format!("jpeg; files copied, others encoded with quality {}; not resampled", config.jpeg_quality),
        picture_count: counts.pictures,
        copied_pictures: counts.copied,
        mask_count: counts.masks,
        points: "made: a grid on the ground plane of every frame".to_owned(),
        config_sha256: hex(&Sha256::digest(settings)),
        config: config.clone(),
        scenes: scenes.iter().zip(regions).map(row).collect(),
        sha256,
    })
}
