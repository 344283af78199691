//! One scene: its pictures, lidar turns and rows.

use std::collections::BTreeMap;
use std::path::Path;

use geometry::{RigCamera, Rigid};
use glam::DVec2;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use world::{Rendering, World};

use super::config::NuScenesWriterConfig;
use super::tables::{CalibratedSensorRow, EgoPoseRow, LogRow, SampleDataRow, SampleRow, SceneRow, Tables, neighbours};
use super::timing::{self, Exposure, Timetable, TimingPlan};
use super::tokens::TokenSpace;
use super::visibility::{self, Sight};
use super::{annotations, lidar};
use crate::{DataError, staging};

/// What all scenes share.
#[derive(Debug)]
pub(super) struct Studio<'a> {
    pub(super) config: &'a NuScenesWriterConfig,
    pub(super) cameras: Vec<RigCamera>,
    pub(super) tokens: &'a TokenSpace,
    /// Folder that holds `samples`.
    pub(super) root: &'a Path,
}

/// One scene on its map.
#[derive(Debug)]
pub(super) struct Scene<'a> {
    pub(super) name: &'a str,
    pub(super) world: &'a World,
    pub(super) map_from_world: DVec2,
    /// Stamp of the world's time zero.
    pub(super) start_us: i64,
    pub(super) log: LogRow,
}

/// What the sensors saw of the actors at one key frame, by actor id.
#[derive(Debug, Clone, Default)]
pub(super) struct Evidence {
    pub(super) sights: BTreeMap<u32, Sight>,
    pub(super) lidar_points: BTreeMap<u32, u32>,
}

/// A picture to take.
#[derive(Debug)]
struct Shot<'a> {
    camera: &'a RigCamera,
    exposure: Exposure,
    filename: String,
}

impl Studio<'_> {
    /// Pictures and lidar turns of one scene.
    pub(super) fn files_per_scene(&self, scene: &str) -> usize {
        let table = self.timetable(scene);
        table.samples_us.len() + table.exposures.iter().map(Vec::len).sum::<usize>()
    }

    fn timetable(&self, scene: &str) -> Timetable {
        let azimuths: Vec<f64> = self.cameras.iter().map(RigCamera::azimuth).collect();
        let plan = TimingPlan {
            key_frames: self.config.key_frames_per_scene,
            sweeps: self.config.sweeps,
            drop_share: self.config.sweep_drop_share,
        };
        timing::timetable(self.tokens, scene, &azimuths, plan)
    }

    /// Writes the files of a scene and appends its rows. `advance` is called with the number of files just written.
    pub(super) fn write_scene(
        &self,
        scene: &Scene<'_>,
        tables: &mut Tables,
        advance: &mut dyn FnMut(usize),
    ) -> Result<(), DataError> {
        let timetable = self.timetable(scene.name);
        self.add_scene_rows(scene, &timetable, tables);
        let mut evidence = vec![Evidence::default(); timetable.samples_us.len()];
        for (camera, exposures) in self.cameras.iter().zip(&timetable.exposures) {
            let shots: Vec<Shot<'_>> = exposures.iter().map(|exposure| shot(scene, camera, *exposure)).collect();
            self.add_camera_rows(scene, camera, &shots, tables);
            // A few pictures per thread at a time, so that progress moves and few pictures are in memory.
            for chunk in shots.chunks(2 * rayon::current_num_threads()) {
                let seen: Vec<_> =
                    chunk.par_iter().map(|shot| self.take(scene, shot)).collect::<Result<_, DataError>>()?;
                for (shot, sights) in chunk.iter().zip(seen) {
                    add_sights(&mut evidence[shot.exposure.sample].sights, sights);
                }
                advance(chunk.len());
            }
        }
        self.sweep_lidar(scene, &timetable, &mut evidence, tables, advance)?;
        annotations::add(self.tokens, scene, &timetable.samples_us, &evidence, tables);
        Ok(())
    }

    fn add_scene_rows(&self, scene: &Scene<'_>, timetable: &Timetable, tables: &mut Tables) {
        let scene_token = self.tokens.token("scene", scene.name);
        let samples: Vec<String> =
            (0..timetable.samples_us.len()).map(|i| sample_token(self.tokens, scene, i)).collect();
        for (index, time_us) in timetable.samples_us.iter().enumerate() {
            let (prev, next) = neighbours(&samples, index);
            let (token, timestamp) = (samples[index].clone(), scene.start_us + time_us);
            tables.sample.push(SampleRow { token, timestamp, prev, next, scene_token: scene_token.clone() });
        }
        tables.scene.push(SceneRow {
            token: scene_token,
            log_token: scene.log.token.clone(),
            nbr_samples: samples.len(),
            first_sample_token: samples.first().cloned().unwrap_or_default(),
            last_sample_token: samples.last().cloned().unwrap_or_default(),
            name: scene.name.to_owned(),
            description: scene.world.caption(),
        });
        tables.log.push(scene.log.clone());
    }

    /// Calibration, one row per picture and its pose.
    fn add_camera_rows(&self, scene: &Scene<'_>, camera: &RigCamera, shots: &[Shot<'_>], tables: &mut Tables) {
        let i = &camera.intrinsics;
        // Files follow OpenCV: integer coordinates are pixel centres.
        let matrix = vec![[i.fx, 0.0, i.cx - 0.5], [0.0, i.fy, i.cy - 0.5], [0.0, 0.0, 1.0]];
        let calibrated = self.add_calibration(scene, &camera.channel, &camera.ego_from_cam, matrix, tables);
        let tokens: Vec<String> = shots.iter().map(|shot| self.tokens.token("sample_data", &shot.filename)).collect();
        for (index, shot) in shots.iter().enumerate() {
            let (prev, next) = neighbours(&tokens, index);
            let (token, timestamp) = (tokens[index].clone(), scene.start_us + shot.exposure.time_us);
            tables.ego_pose.push(ego_pose(scene, &token, shot.exposure.time_us));
            tables.sample_data.push(SampleDataRow {
                ego_pose_token: token.clone(),
                token,
                sample_token: sample_token(self.tokens, scene, shot.exposure.sample),
                calibrated_sensor_token: calibrated.clone(),
                timestamp,
                fileformat: "jpg",
                is_key_frame: shot.exposure.is_key_frame,
                height: i.height,
                width: i.width,
                filename: shot.filename.clone(),
                prev,
                next,
            });
        }
    }

    fn add_calibration(
        &self,
        scene: &Scene<'_>,
        channel: &str,
        ego_from_sensor: &Rigid,
        camera_intrinsic: Vec<[f64; 3]>,
        tables: &mut Tables,
    ) -> String {
        let token = self.tokens.token("calibrated_sensor", &format!("{}/{channel}", scene.name));
        tables.calibrated_sensor.push(CalibratedSensorRow {
            token: token.clone(),
            sensor_token: self.tokens.token("sensor", channel),
            translation: ego_from_sensor.translation.to_array(),
            rotation: ego_from_sensor.wxyz(),
            camera_intrinsic,
        });
        token
    }

    /// Renders, encodes and writes one picture; at key frames also looks which actors it shows.
    fn take(&self, scene: &Scene<'_>, shot: &Shot<'_>) -> Result<BTreeMap<u32, Sight>, DataError> {
        let path = self.root.join(&shot.filename);
        let calibration =
            |source| DataError::Calibration { row: shot.camera.channel.clone(), source, path: path.clone() };
        let camera = shot.camera.camera().map_err(calibration)?;
        let time_secs = secs(shot.exposure.time_us);
        let world_from_cam = scene.world.world_from_ego(time_secs) * shot.camera.ego_from_cam;
        let snapshot = scene.world.snapshot(time_secs);
        let picture = snapshot.render_serial(&camera, &world_from_cam, &self.config.render);
        staging::write(&path, &self.encode(&picture, &path)?)?;
        if !shot.exposure.is_key_frame {
            return Ok(BTreeMap::new());
        }
        let actors = scene.world.actors_at(time_secs);
        Ok(visibility::look(&actors, &camera, &world_from_cam, &picture, annotations::RANGE_M))
    }

    fn encode(&self, picture: &Rendering, path: &Path) -> Result<Vec<u8>, DataError> {
        let mut bytes = vec![];
        JpegEncoder::new_with_quality(&mut bytes, self.config.jpeg_quality)
            .encode(&picture.rgb, picture.width, picture.height, ExtendedColorType::Rgb8)
            .map_err(|e| DataError::Image { why: e.to_string(), path: path.to_owned() })?;
        Ok(bytes)
    }

    /// One turn per key frame.
    fn sweep_lidar(
        &self,
        scene: &Scene<'_>,
        timetable: &Timetable,
        evidence: &mut [Evidence],
        tables: &mut Tables,
        advance: &mut dyn FnMut(usize),
    ) -> Result<(), DataError> {
        let ego_from_lidar = lidar::ego_from_lidar();
        let calibrated = self.add_calibration(scene, lidar::CHANNEL, &ego_from_lidar, vec![], tables);
        let filename = |time_us: &i64| filename(scene, lidar::CHANNEL, *time_us, true, "pcd.bin");
        let names: Vec<String> = timetable.samples_us.iter().map(filename).collect();
        let tokens: Vec<String> = names.iter().map(|name| self.tokens.token("sample_data", name)).collect();
        for (index, time_us) in timetable.samples_us.iter().enumerate() {
            let world_from_lidar = scene.world.world_from_ego(secs(*time_us)) * ego_from_lidar;
            let turn = lidar::cast(&scene.world.snapshot(secs(*time_us)), &world_from_lidar, self.config.lidar_columns);
            staging::write(&self.root.join(&names[index]), &turn.bytes)?;
            evidence[index].lidar_points = turn.points;
            let (prev, next) = neighbours(&tokens, index);
            let token = tokens[index].clone();
            tables.ego_pose.push(ego_pose(scene, &token, *time_us));
            tables.sample_data.push(SampleDataRow {
                ego_pose_token: token.clone(),
                token,
                sample_token: sample_token(self.tokens, scene, index),
                calibrated_sensor_token: calibrated.clone(),
                timestamp: scene.start_us + time_us,
                fileformat: "pcd",
                is_key_frame: true,
                height: 0,
                width: 0,
                filename: names[index].clone(),
                prev,
                next,
            });
            advance(1);
        }
        Ok(())
    }
}

pub(super) fn sample_token(tokens: &TokenSpace, scene: &Scene<'_>, sample: usize) -> String {
    tokens.token("sample", &format!("{}/{sample}", scene.name))
}

/// Seconds of the world's clock.
pub(super) fn secs(time_us: i64) -> f64 {
    time_us as f64 * 1e-6
}

/// The car on the map, by the token of its picture as in the release.
fn ego_pose(scene: &Scene<'_>, token: &str, time_us: i64) -> EgoPoseRow {
    let world_from_ego = scene.world.world_from_ego(secs(time_us));
    EgoPoseRow {
        token: token.to_owned(),
        timestamp: scene.start_us + time_us,
        rotation: world_from_ego.wxyz(),
        translation: (world_from_ego.translation + scene.map_from_world.extend(0.0)).to_array(),
    }
}

fn shot<'a>(scene: &Scene<'_>, camera: &'a RigCamera, exposure: Exposure) -> Shot<'a> {
    let filename = filename(scene, &camera.channel, exposure.time_us, exposure.is_key_frame, "jpg");
    Shot { camera, exposure, filename }
}

/// The release's pattern.
fn filename(scene: &Scene<'_>, channel: &str, time_us: i64, is_key_frame: bool, extension: &str) -> String {
    let folder = if is_key_frame { "samples" } else { "sweeps" };
    format!("{folder}/{channel}/{}__{channel}__{}.{extension}", scene.log.logfile, scene.start_us + time_us)
}

fn add_sights(sum: &mut BTreeMap<u32, Sight>, sights: BTreeMap<u32, Sight>) {
    for (actor, sight) in sights {
        let entry = sum.entry(actor).or_default();
        entry.seen += sight.seen;
        entry.hidden += sight.hidden;
    }
}
