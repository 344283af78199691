//! Frames of any dataset in the nuScenes layout: key frames with their cameras, poses and boxes. The lidar files are empty and the map is
//! blank, both are there because the official devkit asks for them.

use std::collections::BTreeMap;
use std::path::Path;

use geometry::glam::DVec3;
use geometry::{Lens, Rigid};
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;

use super::tables::{
    AnnotationRow, CalibratedSensorRow, EgoPoseRow, InstanceRow, LogRow, MapRow, SampleDataRow, SampleRow, SceneRow,
    SensorRow, Tables, neighbours,
};
use super::tokens::TokenSpace;
use super::{lidar, prior};
use crate::manifest::{Contents, WriterManifest};
use crate::staging::{self, Staging, check_names};
use crate::{DataError, ImageSource, ObjectBox, SceneFrame, View, taxonomy};

/// Name of the folder with the tables.
const VERSION: &str = "v1.0-generated";
/// Where the blank map lies.
const LOCATION: &str = "nowhere";
/// Side of the blank map, metres.
const MAP_M: f64 = 10.0;
/// The official evaluation drops boxes without points; those whose points were never counted shall stay.
const UNCOUNTED_POINTS: u32 = 1;
/// Encodes pictures that are no JPEG files yet.
const JPEG_QUALITY: u8 = 95;

/// Writes frames, those of a scene one after the other in time.
///
/// Names of frames that look like tokens of the release stay, others give a token. A box has its own category if the release knows it, else
/// the nearest of its class; signs and other things have none and are left out. Boxes without a count of lidar points get 1.
///
/// # Errors
/// [`DataError::Config`] for frames that the layout cannot hold: lenses, names that are no file names; whatever is wrong with a picture.
pub(crate) fn write_nuscenes_frames(out: &Path, source: &str, frames: &[SceneFrame]) -> Result<(), DataError> {
    let staging = Staging::new(out, false)?;
    let root = staging.folder();
    let dataset = frames.first().map(|frame| frame.id.dataset.clone()).unwrap_or_default();
    let space = TokenSpace::new(&format!("frames/{dataset}"), 0);
    let mut writer = FrameWriter { tokens: &space, tables: Tables::with_vocabulary(&space), pictures: Vec::new() };
    let scenes: Vec<&[SceneFrame]> = frames.chunk_by(|a, b| a.id.scene == b.id.scene).collect();
    check_names("scene", &scenes.iter().filter_map(|scene| Some(scene.first()?.id.scene.clone())).collect::<Vec<_>>())?;
    writer.add_sensors(frames)?;
    for scene in &scenes {
        writer.add_scene(scene)?;
    }
    writer.pictures.par_iter().try_for_each(|picture| picture.write(&root))?;
    for row in writer.tables.sample_data.iter().filter(|row| row.fileformat == "pcd") {
        put(&root, &row.filename, &[])?;
    }
    staging::create_dir(&root.join("maps"))?;
    let map = format!("maps/{}.png", space.token("map", LOCATION));
    prior::write(&root.join(&map), glam::DVec2::splat(MAP_M), &[])?;
    let log_tokens = writer.tables.log.iter().map(|log| log.token.clone()).collect();
    let token = space.token("map", LOCATION);
    writer.tables.map.push(MapRow { category: "semantic_prior", token, filename: map, log_tokens });
    staging::create_dir(&root.join(VERSION))?;
    let sums = writer.tables.write(&root.join(VERSION))?;
    let names = writer.tables.scene.iter().map(|scene| scene.name.clone()).collect();
    let contents = Contents {
        format: "nuscenes",
        source: source.to_owned(),
        pictures: "jpeg, as painted".to_owned(),
        picture_count: writer.pictures.len(),
        sha256: sums.into_iter().map(|(name, sum)| (format!("{VERSION}/{name}"), sum)).collect(),
    };
    WriterManifest::<(), String>::write(contents, &(), names, &root)?;
    staging.publish()
}

struct FrameWriter<'a> {
    tokens: &'a TokenSpace,
    tables: Tables,
    pictures: Vec<Picture<'a>>,
}

/// A picture to write.
struct Picture<'a> {
    name: String,
    source: &'a ImageSource,
    size: (u32, u32),
}

impl Picture<'_> {
    fn write(&self, root: &Path) -> Result<(), DataError> {
        if let (Some(bytes), true) = (self.source.jpeg_bytes()?, self.source.size() == self.size) {
            return put(root, &self.name, &bytes);
        }
        let (width, height) = self.source.size();
        let edit = geometry::ImageEdit::identity(width, height).resize(self.size.0, self.size.1);
        let pixels = self.source.load(&edit)?;
        let mut bytes = Vec::new();
        JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY)
            .encode(pixels.as_raw(), pixels.width(), pixels.height(), ExtendedColorType::Rgb8)
            .map_err(|error| DataError::Image { why: error.to_string(), path: root.join(&self.name) })?;
        put(root, &self.name, &bytes)
    }
}

fn put(root: &Path, name: &str, bytes: &[u8]) -> Result<(), DataError> {
    let path = root.join(name);
    staging::create_dir(path.parent().unwrap_or(root))?;
    staging::write(&path, bytes)
}

impl<'a> FrameWriter<'a> {
    fn add_sensors(&mut self, frames: &[SceneFrame]) -> Result<(), DataError> {
        let mut channels: Vec<String> =
            frames.iter().flat_map(|frame| &frame.views).map(|view| view.channel.clone()).collect();
        channels.sort();
        channels.dedup();
        check_names("camera", &channels)?;
        let cameras = channels.into_iter().map(|channel| (channel, "camera"));
        for (channel, modality) in cameras.chain([(lidar::CHANNEL.to_owned(), "lidar")]) {
            self.tables.sensor.push(SensorRow { token: self.tokens.token("sensor", &channel), channel, modality });
        }
        Ok(())
    }

    fn add_scene(&mut self, frames: &'a [SceneFrame]) -> Result<(), DataError> {
        let Some(first) = frames.first() else { return Ok(()) };
        let name = first.id.scene.clone();
        let log = self.tokens.token("log", &name);
        let samples: Vec<String> = frames.iter().map(|frame| self.sample_token(frame)).collect();
        for (at, frame) in frames.iter().enumerate() {
            let (prev, next) = neighbours(&samples, at);
            let scene_token = self.tokens.token("scene", &name);
            let token = samples.get(at).cloned().unwrap_or_default();
            self.tables.sample.push(SampleRow { token, timestamp: frame.timestamp_ns / 1000, prev, next, scene_token });
        }
        self.tables.scene.push(SceneRow {
            token: self.tokens.token("scene", &name),
            log_token: log.clone(),
            nbr_samples: samples.len(),
            first_sample_token: samples.first().cloned().unwrap_or_default(),
            last_sample_token: samples.last().cloned().unwrap_or_default(),
            name: name.clone(),
            description: first.scene_text.clone().unwrap_or_default(),
        });
        self.tables.log.push(LogRow {
            token: log,
            logfile: format!("rigscape-{name}"),
            vehicle: "rigscape".to_owned(),
            date_captured: date(first.timestamp_ns),
            location: LOCATION.to_owned(),
        });
        self.add_pictures(frames, &samples)?;
        self.add_lidar(frames, &samples);
        self.add_boxes(frames, &samples);
        Ok(())
    }

    fn sample_token(&self, frame: &SceneFrame) -> String {
        let name = &frame.id.frame;
        let is_token = name.len() == 32 && name.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f'));
        if is_token { name.clone() } else { self.tokens.token("sample", &format!("{}/{name}", frame.id.scene)) }
    }

    fn add_pictures(&mut self, frames: &'a [SceneFrame], samples: &[String]) -> Result<(), DataError> {
        let mut by_channel: BTreeMap<&str, Vec<(&View, &str)>> = BTreeMap::new();
        for (frame, sample) in frames.iter().zip(samples) {
            for view in frame.views.iter().filter(|view| view.image.is_some()) {
                by_channel.entry(&view.channel).or_default().push((view, sample));
            }
        }
        for (channel, views) in by_channel {
            let tokens: Vec<String> = views
                .iter()
                .map(|(_, sample)| self.tokens.token("sample_data", &format!("{sample}/{channel}")))
                .collect();
            for (at, (view, sample)) in views.iter().enumerate() {
                let row = DataRow { channel, at, tokens: &tokens, sample, timestamp_ns: view.timestamp_ns };
                self.add_picture(view, &row)?;
            }
        }
        Ok(())
    }

    fn add_picture(&mut self, view: &'a View, row: &DataRow<'_>) -> Result<(), DataError> {
        if view.lens != Lens::Pinhole {
            let channel = row.channel;
            return Err(DataError::Config(format!(
                "camera {channel} has a lens, but the layout holds pinhole cameras only; choose a pinhole rig"
            )));
        }
        let i = &view.intrinsics;
        // Files follow OpenCV: integer coordinates are pixel centres.
        let matrix = vec![[i.fx, 0.0, i.cx - 0.5], [0.0, i.fy, i.cy - 0.5], [0.0, 0.0, 1.0]];
        let name = format!("samples/{0}/{1}__{0}.jpg", row.channel, row.sample);
        let calibrated = self.calibration(row.channel, &view.ego_from_cam, matrix);
        self.add_data(row, &calibrated, &view.world_from_ego, ("jpg", &name, (i.width, i.height)));
        if let Some(source) = &view.image {
            self.pictures.push(Picture { name, source, size: (i.width, i.height) });
        }
        Ok(())
    }

    /// One row for every calibration that differs.
    fn calibration(&mut self, channel: &str, ego_from_sensor: &Rigid, camera_intrinsic: Vec<[f64; 3]>) -> String {
        let numbers = format!("{channel}/{:?}/{:?}", ego_from_sensor.to_rows(), camera_intrinsic);
        let token = self.tokens.token("calibrated_sensor", &numbers);
        // Rigs change from scene to scene at most, so the row is among the last ones.
        if !self.tables.calibrated_sensor.iter().rev().any(|row| row.token == token) {
            self.tables.calibrated_sensor.push(CalibratedSensorRow {
                token: token.clone(),
                sensor_token: self.tokens.token("sensor", channel),
                translation: ego_from_sensor.translation.to_array(),
                rotation: ego_from_sensor.wxyz(),
                camera_intrinsic,
            });
        }
        token
    }

    fn add_data(
        &mut self,
        row: &DataRow<'_>,
        calibrated: &str,
        world_from_ego: &Rigid,
        (fileformat, filename, (width, height)): (&'static str, &str, (u32, u32)),
    ) {
        let token = row.tokens.get(row.at).cloned().unwrap_or_default();
        let (prev, next) = neighbours(row.tokens, row.at);
        let timestamp = row.timestamp_ns / 1000;
        self.tables.ego_pose.push(EgoPoseRow {
            token: token.clone(),
            timestamp,
            rotation: world_from_ego.wxyz(),
            translation: world_from_ego.translation.to_array(),
        });
        self.tables.sample_data.push(SampleDataRow {
            ego_pose_token: token.clone(),
            token,
            sample_token: row.sample.to_owned(),
            calibrated_sensor_token: calibrated.to_owned(),
            timestamp,
            fileformat,
            is_key_frame: true,
            height,
            width,
            filename: filename.to_owned(),
            prev,
            next,
        });
    }

    /// Empty turns; their poses are those of the reference instants.
    fn add_lidar(&mut self, frames: &[SceneFrame], samples: &[String]) {
        let calibrated = self.calibration(lidar::CHANNEL, &lidar::ego_from_lidar(), Vec::new());
        let name = |sample: &String| self.tokens.token("sample_data", &format!("{sample}/{}", lidar::CHANNEL));
        let tokens: Vec<String> = samples.iter().map(name).collect();
        for (at, (frame, sample)) in frames.iter().zip(samples).enumerate() {
            let timestamp_ns = frame.timestamp_ns;
            let row = DataRow { channel: lidar::CHANNEL, at, tokens: &tokens, sample, timestamp_ns };
            let file = format!("samples/{0}/{sample}__{0}.pcd.bin", lidar::CHANNEL);
            self.add_data(&row, &calibrated, &frame.world_from_ego, ("pcd", &file, (0, 0)));
        }
    }

    fn add_boxes(&mut self, frames: &[SceneFrame], samples: &[String]) {
        let mut tracks: BTreeMap<&str, Vec<(&str, &ObjectBox, &SceneFrame)>> = BTreeMap::new();
        for (frame, sample) in frames.iter().zip(samples) {
            for found in frame.boxes.iter().flatten().filter(|found| category(found).is_some()) {
                tracks.entry(&found.track).or_default().push((sample, found, frame));
            }
        }
        for (track, rows) in tracks {
            let Some((_, kind, frame)) = rows.first() else { continue };
            let scene = &frame.id.scene;
            let instance_token = self.tokens.token("instance", &format!("{scene}/{track}"));
            let chain: Vec<String> = rows
                .iter()
                .map(|(sample, ..)| self.tokens.token("sample_annotation", &format!("{sample}/{track}")))
                .collect();
            for (at, (sample, found, frame)) in rows.iter().enumerate() {
                let row = self.annotation(&chain, at, found, &frame.world_from_ego);
                let (sample_token, instance_token) = ((*sample).to_owned(), instance_token.clone());
                self.tables.sample_annotation.push(AnnotationRow { sample_token, instance_token, ..row });
            }
            self.tables.instance.push(InstanceRow {
                token: instance_token,
                category_token: self.tokens.token("category", category(kind).unwrap_or_default()),
                nbr_annotations: chain.len(),
                first_annotation_token: chain.first().cloned().unwrap_or_default(),
                last_annotation_token: chain.last().cloned().unwrap_or_default(),
            });
        }
    }

    /// Without the keys of sample and instance.
    fn annotation(&self, chain: &[String], at: usize, found: &ObjectBox, world_from_ego: &Rigid) -> AnnotationRow {
        let (prev, next) = neighbours(chain, at);
        let DVec3 { x: length, y: width, z: height } = found.box3d.size;
        let world_from_box = *world_from_ego * Rigid::from_yaw(found.box3d.yaw, found.box3d.center);
        let known = |name: &&String| self.tables.attribute.iter().any(|row| row.name == **name);
        AnnotationRow {
            token: chain.get(at).cloned().unwrap_or_default(),
            sample_token: String::new(),
            instance_token: String::new(),
            visibility_token: found
                .visibility
                .filter(|level| (1..=4).contains(level))
                .map(|level| level.to_string())
                .unwrap_or_default(),
            attribute_tokens: found
                .attributes
                .iter()
                .filter(known)
                .map(|name| self.tokens.token("attribute", name))
                .collect(),
            translation: world_from_box.translation.to_array(),
            size: [width, length, height],
            rotation: world_from_box.wxyz(),
            prev,
            next,
            num_lidar_pts: found.points.unwrap_or(UNCOUNTED_POINTS),
            num_radar_pts: 0,
        }
    }
}

/// What the rows of one sensor's files share.
struct DataRow<'a> {
    channel: &'a str,
    at: usize,
    tokens: &'a [String],
    sample: &'a str,
    timestamp_ns: i64,
}

/// The release's category of a box, if there is one.
fn category(found: &ObjectBox) -> Option<&str> {
    let own = Some(found.source_class.as_str()).filter(|name| taxonomy::from_nuscenes(name).is_some());
    own.or_else(|| taxonomy::nearest_nuscenes(found.class))
}

/// Year-month-day of a stamp, by the proleptic Gregorian calendar.
fn date(timestamp_ns: i64) -> String {
    // Days are counted in eras of 400 years that begin on a 1 March, so that the leap day comes last.
    let days = timestamp_ns.div_euclid(86_400_000_000_000) + 719_468;
    let (era, day) = (days.div_euclid(146_097), days.rem_euclid(146_097));
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let of_year = day - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let of_month = of_year - (153 * month + 2) / 5 + 1;
    let (calendar, carry) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    format!("{:04}-{calendar:02}-{of_month:02}", year + era * 400 + carry)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        const DAY_NS: i64 = 86_400_000_000_000;
        for (days, text) in
            [(0, "1970-01-01"), (59, "1970-03-01"), (11_016, "2000-02-29"), (20_783, "2026-11-26"), (-1, "1969-12-31")]
        {
            assert_eq!(date(days * DAY_NS), text);
        }
    }
}
