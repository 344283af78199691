//! One log: what the layout demands of its frames, and its files.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use geometry::{ImageEdit, Lens, RigCamera, Rigid};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::boxes::Boxes;
use super::config::{Argoverse2WriterConfig, ManifestLog};
use super::feather::Columns;
use super::source::Argoverse2Log;
use super::sweep::{cast, lidar_mounts};
use super::{Sums, put};
use crate::argoverse2::Split;
use crate::manifest::hex;
use crate::{DataError, ImageSource, jpeg};

/// A checked log, ready to be written.
#[derive(Debug)]
pub(super) struct LogWriter<'a> {
    config: &'a Argoverse2WriterConfig,
    log: &'a Argoverse2Log,
    pub(super) name: String,
    /// Cameras under the layout's names with the written size, and the edit from raw to written pictures.
    cameras: Vec<(RigCamera, ImageEdit)>,
    /// The car at every stamp used.
    poses: BTreeMap<i64, Rigid>,
    pictures: Vec<Picture<'a>>,
}

/// A picture to write.
#[derive(Debug, Clone, Copy)]
struct Picture<'a> {
    camera: usize,
    timestamp_ns: i64,
    source: &'a ImageSource,
}

impl<'a> LogWriter<'a> {
    /// # Errors
    /// [`DataError::Config`] for frames that one log cannot hold.
    pub(super) fn new(config: &'a Argoverse2WriterConfig, log: &'a Argoverse2Log) -> Result<Self, DataError> {
        let refuse = |why: String| DataError::Config(format!("a log cannot be written: {why}"));
        let first = log.frames.first().ok_or_else(|| refuse("it has no frames".to_owned()))?;
        if log.split == Split::All {
            return Err(refuse("its split must be train, val or test".to_owned()));
        }
        if log.city.is_empty() || !log.city.bytes().all(|byte| byte.is_ascii_alphanumeric()) {
            return Err(refuse(format!("{:?} is no short name of a city", log.city)));
        }
        let name = log_name(&first.id.dataset, &first.id.scene);
        let cameras = first.rig().cameras.into_iter().map(|camera| written_camera(camera, config));
        let cameras = cameras.collect::<Result<_, _>>()?;
        let mut writer = Self { config, log, name, cameras, poses: BTreeMap::new(), pictures: Vec::new() };
        let names: BTreeSet<&str> = writer.cameras.iter().map(|camera| camera.0.channel.as_str()).collect();
        if names.len() != writer.cameras.len() {
            return Err(refuse("two cameras have the same name".to_owned()));
        }
        let rig = first.rig();
        for pair in log.frames.windows(2) {
            if let [a, b] = pair
                && (a.timestamp_ns >= b.timestamp_ns || a.id.scene != b.id.scene)
            {
                return Err(refuse(format!(
                    "frame {} does not follow frame {} in time and scene",
                    b.id.frame, a.id.frame
                )));
            }
        }
        for frame in &log.frames {
            if frame.rig() != rig {
                return Err(refuse(format!(
                    "frame {} of {} has another rig than the first",
                    frame.id.frame, frame.id.scene
                )));
            }
            writer.add_pose(frame.timestamp_ns, frame.world_from_ego)?;
            for (camera, view) in frame.views.iter().enumerate() {
                if let Some(source) = &view.image {
                    writer.add_pose(view.timestamp_ns, view.world_from_ego)?;
                    writer.pictures.push(Picture { camera, timestamp_ns: view.timestamp_ns, source });
                }
            }
        }
        writer.check_pictures()?;
        Ok(writer)
    }

    fn add_pose(&mut self, timestamp_ns: i64, world_from_ego: Rigid) -> Result<(), DataError> {
        match self.poses.insert(timestamp_ns, world_from_ego) {
            Some(other) if other != world_from_ego => {
                Err(DataError::Config(format!("{} has two different poses at {timestamp_ns} ns", self.name)))
            }
            _ => Ok(()),
        }
    }

    fn check_pictures(&self) -> Result<(), DataError> {
        let mut seen = BTreeSet::new();
        match self.pictures.iter().find(|picture| !seen.insert((picture.camera, picture.timestamp_ns))) {
            Some(twice) => Err(DataError::Config(format!(
                "{} has two pictures of a camera at {} ns",
                self.name, twice.timestamp_ns
            ))),
            None => Ok(()),
        }
    }

    pub(super) fn picture_count(&self) -> usize {
        self.pictures.len()
    }

    fn folder(&self) -> String {
        let split = self.log.split.folders().first().copied().unwrap_or_default();
        format!("{split}/{}", self.name)
    }

    /// Writes all files. `advance` is called with the number of pictures just written.
    pub(super) fn write(&self, sums: &mut Sums, advance: &mut dyn FnMut(usize)) -> Result<ManifestLog, DataError> {
        let folder = self.folder();
        self.write_calibration(sums, &folder)?;
        let (stamps, poses): (Vec<i64>, Vec<Rigid>) = self.poses.iter().map(|(stamp, pose)| (*stamp, *pose)).unzip();
        let table = Columns::default().i64("timestamp_ns", stamps).poses(&poses);
        sums.put(&format!("{folder}/city_SE3_egovehicle.feather"), &table.encode()?)?;
        self.write_sweeps_and_boxes(sums, &folder)?;
        self.write_map(sums, &folder)?;
        // A few pictures per thread at a time, so that progress moves and few pictures are in memory.
        for chunk in self.pictures.chunks(2 * rayon::current_num_threads()) {
            chunk.par_iter().try_for_each(|picture| self.write_picture(picture, &sums.root, &folder))?;
            advance(chunk.len());
        }
        let first = self.log.frames.first().map(|frame| frame.id.clone());
        let (source_dataset, source_scene) = first.map(|id| (id.dataset, id.scene)).unwrap_or_default();
        Ok(ManifestLog {
            log: self.name.clone(),
            split: self.log.split,
            source_dataset,
            source_scene,
            source_frames: self.log.frames.iter().map(|frame| frame.id.frame.clone()).collect(),
            pictures: self.pictures.len(),
        })
    }

    fn write_calibration(&self, sums: &mut Sums, folder: &str) -> Result<(), DataError> {
        // Rows lie in the order of names, as in the release.
        let mut cameras: Vec<&RigCamera> = self.cameras.iter().map(|camera| &camera.0).collect();
        cameras.sort_by(|a, b| a.channel.cmp(&b.channel));
        let lidars = lidar_mounts();
        let mut names: Vec<&str> = cameras.iter().map(|camera| camera.channel.as_str()).collect();
        let numbers = |of: fn(&RigCamera) -> f64| cameras.iter().map(|camera| of(camera)).collect::<Vec<f64>>();
        let sizes = |of: fn(&RigCamera) -> u32| {
            let size = |camera: &&RigCamera| {
                u16::try_from(of(camera)).map_err(|_| DataError::Config(format!("{} is too large", camera.channel)))
            };
            cameras.iter().map(size).collect::<Result<Vec<u16>, DataError>>()
        };
        // Files follow OpenCV: integer coordinates are pixel centres. The pictures are rectified, so no lens is left to describe.
        let table = Columns::default()
            .text("sensor_name", names.clone())
            .f64("fx_px", numbers(|camera| camera.intrinsics.fx))
            .f64("fy_px", numbers(|camera| camera.intrinsics.fy))
            .f64("cx_px", numbers(|camera| camera.intrinsics.cx - 0.5))
            .f64("cy_px", numbers(|camera| camera.intrinsics.cy - 0.5))
            .f64("k1", numbers(|_| 0.0))
            .f64("k2", numbers(|_| 0.0))
            .f64("k3", numbers(|_| 0.0))
            .u16("height_px", sizes(|camera| camera.intrinsics.height)?)
            .u16("width_px", sizes(|camera| camera.intrinsics.width)?);
        sums.put(&format!("{folder}/calibration/intrinsics.feather"), &table.encode()?)?;
        names.extend(lidars.iter().map(|lidar| lidar.0));
        let mounts = cameras.iter().map(|camera| camera.ego_from_cam).chain(lidars.iter().map(|lidar| lidar.1));
        let table = Columns::default().text("sensor_name", names).poses(&mounts.collect::<Vec<_>>());
        sums.put(&format!("{folder}/calibration/egovehicle_SE3_sensor.feather"), &table.encode()?)
    }

    fn write_sweeps_and_boxes(&self, sums: &mut Sums, folder: &str) -> Result<(), DataError> {
        let mut boxes = Boxes::default();
        for frame in &self.log.frames {
            let sweep = cast(frame, self.config.lidar_columns);
            boxes.add(frame, sweep.as_ref(), self.config)?;
            let bytes = sweep.unwrap_or_default().encode()?;
            put(&sums.root, &format!("{folder}/sensors/lidar/{}.feather", frame.timestamp_ns), &bytes)?;
        }
        if self.log.frames.iter().all(|frame| frame.boxes.is_none()) {
            return Ok(());
        }
        sums.put(&format!("{folder}/annotations.feather"), &boxes.encode()?)
    }

    fn write_map(&self, sums: &mut Sums, folder: &str) -> Result<(), DataError> {
        let (name, city) = (&self.name, &self.log.city);
        if let Some(map) = &self.log.map {
            // The number behind the city tells versions of its map apart; here there is one.
            let file = format!("{folder}/map/log_map_archive_{name}____{city}_city_1.json");
            sums.put(&file, &json(&file, map)?)?;
        }
        if let Some(ground) = &self.log.ground {
            let file = format!("{folder}/map/{name}___img_Sim2_city.json");
            sums.put(&file, &json(&file, &ground.raster_from_city())?)?;
            sums.put(&format!("{folder}/map/{name}_ground_height_surface____{city}.npy"), &ground.to_npy())?;
        }
        Ok(())
    }

    fn write_picture(&self, picture: &Picture<'_>, root: &Path, folder: &str) -> Result<(), DataError> {
        let Some((camera, edit)) = self.cameras.get(picture.camera) else { return Ok(()) };
        let name = format!("{folder}/sensors/cameras/{}/{}.jpg", camera.channel, picture.timestamp_ns);
        if let (ImageSource::File { file, .. }, true) = (picture.source, self.config.image_scale == 1.0) {
            let bytes = file.bytes()?;
            if jpeg::is_jpeg(&bytes) {
                // A damaged picture must not travel on.
                picture.source.inspect()?;
                return put(root, &name, &bytes);
            }
        }
        let pixels = picture.source.load(edit)?;
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, self.config.jpeg_quality)
            .encode(pixels.as_raw(), pixels.width(), pixels.height(), ExtendedColorType::Rgb8)
            .map_err(|error| DataError::Image { why: error.to_string(), path: root.join(&name) })?;
        put(root, &name, &bytes)
    }
}

/// A camera under its new name at its new size.
fn written_camera(camera: RigCamera, config: &Argoverse2WriterConfig) -> Result<(RigCamera, ImageEdit), DataError> {
    if camera.lens != Lens::Pinhole {
        let channel = camera.channel;
        let why = "has a lens, but the layout holds rectified pictures only; use a pinhole rig";
        return Err(DataError::Config(format!("camera {channel} {why}")));
    }
    let raw = camera.intrinsics;
    let size = |pixels: u32| (f64::from(pixels) * config.image_scale).round().max(1.0) as u32;
    let identity = ImageEdit::identity(raw.width, raw.height);
    let edit = if config.image_scale == 1.0 { identity } else { identity.resize(size(raw.width), size(raw.height)) };
    let channel = config.camera_name(&camera.channel)?.to_owned();
    Ok((RigCamera { channel, intrinsics: edit.intrinsics(&raw), ..camera }, edit))
}

/// Scenes that are called by a UUID keep their name; others get one that follows from it.
fn log_name(dataset: &str, scene: &str) -> String {
    let mut parts = scene.split('-').map(|part| part.bytes().all(|b| b.is_ascii_hexdigit()).then_some(part.len()));
    if parts.by_ref().eq([8, 4, 4, 4, 12].map(Some)) {
        return scene.to_owned();
    }
    let digits = hex(&Sha256::digest(format!("rigscape/argoverse2/{dataset}\u{1f}{scene}")));
    let part = |range: std::ops::Range<usize>| digits.get(range).unwrap_or_default();
    // Version 8: a digest of one's own.
    format!("{}-{}-8{}-8{}-{}", part(0..8), part(8..12), part(12..15), part(15..18), part(18..30))
}

fn json<T: serde::Serialize>(name: &str, value: &T) -> Result<Vec<u8>, DataError> {
    serde_json::to_vec(value).map_err(|error| DataError::Json { why: error.to_string(), path: name.into() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uuids_stay_and_other_names_become_one() {
        let uuid = "7fab2350-7eaf-3b7e-a39d-6937a4c1bede";
        assert_eq!(log_name("a", uuid), uuid);
        let made = log_name("procedural", "scene-0001");
        assert_eq!(log_name("b", &made), made);
        assert_ne!(made, log_name("procedural", "scene-0002"));
        assert_ne!(made, log_name("other", "scene-0001"));
        assert_eq!(log_name("a", "7fab2350-7eaf-3b7e-a39d-6937a4c1bedg").len(), 36);
    }
}
