//! Writes procedural scenes in the nuScenes layout: tables, pictures, lidar, semantic priors and map expansions that the official
//! devkit loads.
//!
//! Layout and field order follow the release, see <https://www.nuscenes.org/nuscenes#data-format>. Every world is a scene with a
//! log of its own; worlds of one traffic side lie beside each other on the map of one city. Scene names are borrowed from the
//! official mini split (see [`NuScenesWriterConfig::scene_names`]): the content is not theirs.

mod annotations;
mod arcline;
mod atlas;
mod config;
mod frames;
mod lidar;
mod map_expansion;
mod map_rows;
mod prior;
mod road_blocks;
mod scene;
mod tables;
mod timing;
mod tokens;
mod visibility;

use std::collections::BTreeMap;
use std::path::Path;

use world::{World, WorldConfig};

pub(crate) use config::scaled;
pub use config::{Manifest, ManifestScene, NuScenesWriterConfig};
pub(crate) use frames::write_nuscenes_frames;

use crate::DataError;
use crate::manifest::{Contents, WriterManifest};
use crate::staging::{self, Staging};
use atlas::Atlas;
use scene::{Scene, Studio};
use tables::{LogRow, SensorRow, Tables};
use tokens::TokenSpace;

/// 2031-01-01 00:00 UTC, after all drives of the release.
const FIRST_START_US: i64 = 1_924_992_000_000_000;
/// From the start of one scene to that of the next.
const HOUR_US: i64 = 3_600_000_000;
/// A car that the release does not have.
const VEHICLE: &str = "n900";

/// Makes the dataset. `progress` is called with the numbers of files written and to write (pictures and lidar turns).
///
/// The folder appears at its place when it is complete; a failed or interrupted run leaves nothing there. Two runs with one
/// configuration give identical bytes, on any number of threads.
///
/// # Errors
/// [`DataError::Config`] for settings that cannot be met and for an output that exists; [`DataError::Io`] naming the file.
pub fn write_nuscenes(
    config: &NuScenesWriterConfig,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Manifest, DataError> {
    config.check()?;
    let staging = Staging::new(&config.out, config.force)?;
    let root = staging.folder();
    let tokens = TokenSpace::new(&config.version, config.seed);
    let studio = Studio { config, cameras: config.cameras(), tokens: &tokens, root: &root };
    make_folders(&studio)?;

    let names = config.resolved_scene_names();
    let total = names.iter().map(|name| studio.files_per_scene(name)).sum();
    let mut done = 0;
    let mut advance = |files: usize| {
        done += files;
        progress(done, total);
    };
    let mut tables = Tables::with_vocabulary(&tokens);
    add_sensors(&studio, &mut tables);
    // Maps come first: a map too large for tools is found before hours of rendering. Worlds are made twice because many of them
    // do not fit into memory at once.
    let world_config = config.world_config();
    let mut atlas = Atlas::new(&tokens, names.len());
    let plans = plan_scenes(&tokens, &names, &world_config, &mut atlas);
    let mut sha256 = atlas.write(&root, &mut tables)?;
    for (index, plan) in plans.iter().enumerate() {
        let world = World::generate(plan.world_seed, &world_config);
        let mut log = log_row(&tokens, &plan.name, index);
        log.location.clone_from(&plan.location);
        let map_from_world = plan.map_from_world.into();
        let scene = Scene { name: &plan.name, world: &world, map_from_world, start_us: plan.start_us, log };
        studio.write_scene(&scene, &mut tables, &mut advance)?;
        tracing::debug!(scene = plan.name, location = plan.location, "scene written");
    }
    let tables_folder = root.join(&config.version);
    let digests = tables.write(&tables_folder)?;
    sha256.extend(digests.into_iter().map(|(name, digest)| (format!("{}/{name}", config.version), digest)));
    let pictures = tables.sample_data.iter().filter(|row| row.fileformat == "jpg").count();
    let manifest = manifest(config, plans, pictures, sha256, &root)?;
    staging.publish()?;
    Ok(manifest)
}

/// Gives every scene its world and its place on a map.
fn plan_scenes(
    tokens: &TokenSpace,
    names: &[String],
    world_config: &WorldConfig,
    atlas: &mut Atlas<'_>,
) -> Vec<ManifestScene> {
    let plan = |(index, name): (usize, &String)| {
        let world = World::generate(tokens.seed("world", name), world_config);
        let (location, map_from_world) = atlas.place(&world, &log_row(tokens, name, index).token);
        ManifestScene {
            name: name.clone(),
            world_seed: world.seed(),
            world_duration_secs: world_config.duration_secs,
            location: location.to_owned(),
            map_from_world: map_from_world.to_array(),
            start_us: FIRST_START_US + index as i64 * HOUR_US,
        }
    };
    names.iter().enumerate().map(plan).collect()
}

fn make_folders(studio: &Studio<'_>) -> Result<(), DataError> {
    staging::create_dir(&studio.root.join(&studio.config.version))?;
    staging::create_dir(&studio.root.join("samples").join(lidar::CHANNEL))?;
    for camera in &studio.cameras {
        staging::create_dir(&studio.root.join("samples").join(&camera.channel))?;
        if studio.config.sweeps {
            staging::create_dir(&studio.root.join("sweeps").join(&camera.channel))?;
        }
    }
    Ok(())
}

fn add_sensors(studio: &Studio<'_>, tables: &mut Tables) {
    let cameras = studio.cameras.iter().map(|camera| (camera.channel.as_str(), "camera"));
    for (channel, modality) in cameras.chain([(lidar::CHANNEL, "lidar")]) {
        let token = studio.tokens.token("sensor", channel);
        tables.sensor.push(SensorRow { token, channel: channel.to_owned(), modality });
    }
}

/// One drive per scene, an hour apart; the location follows once the world has its place.
fn log_row(tokens: &TokenSpace, scene: &str, index: usize) -> LogRow {
    let date = date_2031(index / 24);
    LogRow {
        token: tokens.token("log", scene),
        logfile: format!("{VEHICLE}-{date}-{:02}-00-00+0000", index % 24),
        vehicle: VEHICLE.to_owned(),
        date_captured: date,
        location: String::new(),
    }
}

/// The date so many days after 2031-01-01.
fn date_2031(days: usize) -> String {
    let mut left = days;
    for year in 2031.. {
        let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
        let february = if leap { 29 } else { 28 };
        for (month, length) in [31, february, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31].into_iter().enumerate() {
            if left < length {
                return format!("{year}-{:02}-{:02}", month + 1, left + 1);
            }
            left -= length;
        }
    }
    unreachable!("the years do not end")
}

fn manifest(
    config: &NuScenesWriterConfig,
    scenes: Vec<ManifestScene>,
    picture_count: usize,
    sha256: BTreeMap<String, String>,
    root: &Path,
) -> Result<Manifest, DataError> {
    let contents = Contents {
        format: "nuscenes",
        source: "procedural world".to_owned(),
        pictures: format!("jpeg, quality {}; rendered at the written size, not resampled", config.jpeg_quality),
        picture_count,
        sha256,
    };
    WriterManifest::write(contents, config, scenes, root)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_count_on_over_months_and_leap_years() {
        assert_eq!(date_2031(0), "2031-01-01");
        assert_eq!(date_2031(31 + 27), "2031-02-28");
        assert_eq!(date_2031(31 + 28), "2031-03-01");
        assert_eq!(date_2031(365 + 31 + 28), "2032-02-29");
        assert_eq!(date_2031(365 + 366), "2033-01-01");
    }
}
