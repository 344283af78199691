//! The first release: one TFRecord file per segment, one record per frame.

use std::path::Path;

use geometry::glam::DVec3;
use geometry::{RigCamera, Rigid};
use prost::Message;
use prost::bytes::Bytes;
use rayon::prelude::*;

use super::cameras::{self, StoredCamera};
use super::config::WaymoConfig;
use super::map::WorldMap;
use super::raw::{RawBox, RawFrame, RawPicture, checked_micros, joined_text, picture_ns};
use super::{ProjectedLabel, head, proto, select};
use crate::store::{Store, StoredFile};
use crate::tfrecord::{self, RecordSpan};
use crate::{DataError, EmbeddedPicture};

/// One file. Holds the places of its records, nothing of their contents.
#[derive(Debug)]
pub(super) struct Segment {
    pub name: String,
    /// Its place among all files of the split.
    pub number: usize,
    /// Number of wanted cameras.
    pub views: usize,
    file: StoredFile,
    /// Wanted frames in order of time.
    records: Vec<RecordSpan>,
    /// Their places among all records of the file.
    pub frame_numbers: Vec<usize>,
    /// The first frame of the file, wanted or not: it holds the map.
    first: Option<RecordSpan>,
}

/// Visits the records of all files of a split, without reading more than the first bytes of each.
pub(super) fn open(config: &WaymoConfig, store: &Store) -> Result<Vec<Segment>, DataError> {
    let mut files = Vec::new();
    for entry in store.list(&config.inside(""))? {
        if let (false, Some(stem)) = (entry.is_folder, entry.name.strip_suffix(".tfrecord")) {
            let context = stem.strip_prefix("segment-").unwrap_or(stem);
            let context = context.strip_suffix("_with_camera_labels").unwrap_or(context);
            let file = store.file(&config.inside(&entry.name), "segment")?;
            files.push((context.to_owned(), (files.len(), file)));
        }
    }
    select(files, &config.scenes, &store.path(&config.inside("")))?
        .into_par_iter()
        .map(|(name, (number, file))| Segment::open(config, name, number, file))
        .collect()
}

impl Segment {
    fn open(config: &WaymoConfig, name: String, number: usize, file: StoredFile) -> Result<Self, DataError> {
        let (records, frame_numbers) = (Vec::new(), Vec::new());
        let mut segment = Self { name, number, views: 0, file: file.clone(), records, frame_numbers, first: None };
        let (mut last, mut frame_number) = (i64::MIN, 0);
        tfrecord::index(&file, head::PEEK, |span, bytes| {
            let micros = match head::look(bytes) {
                Some(head) => head.micros,
                None => required(decode(&file, span)?.1.timestamp_micros, "timestamp_micros", file.path())?,
            };
            let micros = checked_micros(micros, file.path())?;
            if micros < last {
                return Err(bad(file.path(), &format!("frame {micros} comes after frame {last}")));
            }
            last = micros;
            if segment.first.is_none() {
                segment.first = Some(span);
                segment.views = rig_at(config, &file, span, bytes)?.len();
            }
            if !config.excludes(micros) {
                segment.records.push(span);
                segment.frame_numbers.push(frame_number);
            }
            frame_number += 1;
            Ok(())
        })?;
        Ok(segment)
    }

    pub fn len(&self) -> usize {
        self.records.len()
    }

    /// Reads, checks and decodes a record.
    pub fn frame(&self, config: &WaymoConfig, at: usize) -> Result<RawFrame, DataError> {
        let (payload, span, frame) = self.decode(at)?;
        let path = self.file.path();
        let micros = required(frame.timestamp_micros, "timestamp_micros", path)?;
        let context = required(frame.context.as_ref(), "context", path)?;
        let mut pictures = Vec::new();
        for image in &frame.images {
            let number = i64::from(required(image.name, "images.name", path)?);
            if !context.camera_calibrations.iter().any(|camera| camera.name == image.name) {
                let token = format!("{micros} camera {number}");
                return Err(DataError::Dangling { table: "images", token, field: "name", path: path.to_owned() });
            }
            pictures.extend(self.picture(&payload, span, micros, number, image)?);
        }
        let stats = context.stats.as_ref();
        // The test split has no labels; every other segment counts its objects, so a frame without any is empty there.
        let labelled = !frame.laser_labels.is_empty() || stats.is_some_and(|s| !s.laser_object_counts.is_empty());
        let boxes = labelled.then(|| frame.laser_labels.iter().map(|label| raw_box(label, micros, path)).collect());
        Ok(RawFrame {
            micros: checked_micros(micros, path)?,
            world_from_ego: pose_of(frame.pose.as_ref(), "vehicle pose", &micros.to_string(), path)?,
            cameras: rig(config, context, path)?,
            pictures,
            boxes: boxes.transpose()?,
            text: stats
                .and_then(|s| joined_text([s.time_of_day.as_deref(), s.location.as_deref(), s.weather.as_deref()])),
            path: path.to_owned(),
        })
    }

    /// `None` for a camera whose entry holds no picture.
    fn picture(
        &self,
        payload: &Bytes,
        span: RecordSpan,
        micros: i64,
        camera: i64,
        image: &proto::CameraImage,
    ) -> Result<Option<RawPicture>, DataError> {
        let Some(bytes) = &image.image else { return Ok(None) };
        let path = self.file.path();
        let row = format!("{micros} camera {camera}");
        let within = offset_in(payload, bytes).ok_or_else(|| bad(path, "a picture outside its record"))?;
        let place = EmbeddedPicture::at(self.file.clone(), span.offset + within, bytes.len() as u64);
        Ok(Some(RawPicture {
            camera,
            timestamp_ns: picture_ns(required(image.pose_timestamp, "images.pose_timestamp", path)?, path)?,
            world_from_ego: pose_of(image.pose.as_ref(), "picture pose", &row, path)?,
            picture: place,
        }))
    }

    /// The map of the segment.
    pub fn map(&self) -> Result<WorldMap, DataError> {
        let absent = || DataError::Missing {
            what: "map features, which releases from 1.4.2 on hold in the first frame".to_owned(),
            path: self.file.path().to_owned(),
        };
        let payload = tfrecord::payload(&self.file, self.first.ok_or_else(absent)?)?;
        let frame = proto::MapFrame::decode(payload).map_err(|error| bad(self.file.path(), &error.to_string()))?;
        if frame.map_features.is_empty() {
            return Err(absent());
        }
        WorldMap::new(&frame.map_features, self.file.path())
    }

    /// The car on the map: the pose of its frame, corrected by the frame's drift.
    pub fn map_from_ego(&self, at: usize) -> Result<Rigid, DataError> {
        let (_, _, frame) = self.decode(at)?;
        let row = frame.timestamp_micros.unwrap_or_default().to_string();
        let mut pose = pose_of(frame.pose.as_ref(), "vehicle pose", &row, self.file.path())?;
        let offset = frame.map_pose_offset.unwrap_or_default();
        pose.translation += DVec3::new(offset.x(), offset.y(), offset.z());
        if !pose.translation.is_finite() {
            return Err(bad(self.file.path(), &format!("frame {row} has a map offset that is not finite")));
        }
        Ok(pose)
    }

    /// The labels as the release itself projected them.
    pub fn projected(&self, at: usize) -> Result<Vec<ProjectedLabel>, DataError> {
        let (_, _, frame) = self.decode(at)?;
        let path = self.file.path();
        let mut found = Vec::new();
        for of_camera in &frame.projected_lidar_labels {
            let number = i64::from(required(of_camera.name, "projected_lidar_labels.name", path)?);
            let channel = cameras::channel(number);
            let channel = channel.ok_or_else(|| cameras::unknown_camera(&number.to_string(), path))?;
            for label in &of_camera.labels {
                let area = label.r#box.clone().unwrap_or_default();
                found.push(ProjectedLabel {
                    channel: channel.to_owned(),
                    id: label.id().to_owned(),
                    center_px: [area.center_x() + 0.5, area.center_y() + 0.5],
                    // Of pictures, length is the horizontal side.
                    size_px: [area.length(), area.width()],
                });
            }
        }
        Ok(found)
    }

    fn decode(&self, at: usize) -> Result<(Bytes, RecordSpan, proto::Frame), DataError> {
        let absent = || DataError::Config(format!("frame {at} of {} does not exist", self.name));
        let span = *self.records.get(at).ok_or_else(absent)?;
        let (payload, frame) = decode(&self.file, span)?;
        Ok((payload, span, frame))
    }
}

fn decode(file: &StoredFile, span: RecordSpan) -> Result<(Bytes, proto::Frame), DataError> {
    let payload = tfrecord::payload(file, span)?;
    let frame = proto::Frame::decode(payload.clone());
    let why = |error: prost::DecodeError| bad(file.path(), &format!("record at byte {}: {error}", span.offset));
    Ok((payload, frame.map_err(why)?))
}

/// The cameras of a record, from its first bytes if they suffice. Those are not covered by a checksum of their own, so that any
/// complaint about them must come from the checked record.
fn rig_at(
    config: &WaymoConfig,
    file: &StoredFile,
    span: RecordSpan,
    bytes: &[u8],
) -> Result<Vec<RigCamera>, DataError> {
    let context = head::look(bytes).and_then(|head| proto::Context::decode(head.context).ok());
    match context.map(|context| rig(config, &context, file.path())) {
        Some(Ok(rig)) => Ok(rig),
        _ => {
            let (_, frame) = decode(file, span)?;
            rig(config, required(frame.context.as_ref(), "context", file.path())?, file.path())
        }
    }
}

/// The wanted cameras in rig order.
fn rig(config: &WaymoConfig, context: &proto::Context, path: &Path) -> Result<Vec<RigCamera>, DataError> {
    let mut rig = Vec::new();
    for camera in &context.camera_calibrations {
        let stored = StoredCamera {
            number: i64::from(camera.name()),
            intrinsic: &camera.intrinsic,
            vehicle_from_camera: camera.vehicle_from_camera.as_ref().map_or(&[], |pose| &pose.transform),
            size: (i64::from(camera.width()), i64::from(camera.height())),
        };
        rig.push(stored.rig_camera(path)?);
    }
    rig.retain(|camera| config.wants(&camera.channel));
    cameras::in_rig_order(rig, path)
}

fn raw_box(label: &proto::Label, micros: i64, path: &Path) -> Result<RawBox, DataError> {
    let id = label.id().to_owned();
    let absent = || DataError::Annotation {
        token: format!("{micros} {id}"),
        why: "it has no box".to_owned(),
        path: path.to_owned(),
    };
    let found = label.r#box.as_ref().ok_or_else(absent)?;
    let speed = label.metadata.as_ref().filter(|m| m.speed_x.is_some() && m.speed_y.is_some());
    Ok(RawBox {
        center: [found.center_x(), found.center_y(), found.center_z()],
        size: [found.length(), found.width(), found.height()],
        heading: found.heading(),
        kind: i64::from(label.r#type()),
        points: label.num_lidar_points_in_box.map(i64::from),
        world_velocity: speed.map(|m| [m.speed_x(), m.speed_y(), m.speed_z()]),
        id,
    })
}

fn pose_of(pose: Option<&proto::Transform>, what: &'static str, row: &str, path: &Path) -> Result<Rigid, DataError> {
    cameras::pose(what, pose.map_or(&[], |pose| &pose.transform)).map_err(|source| DataError::Calibration {
        row: row.to_owned(),
        source,
        path: path.to_owned(),
    })
}

/// Where a part that shares the record's memory begins in it.
fn offset_in(payload: &Bytes, part: &Bytes) -> Option<u64> {
    if part.is_empty() {
        return Some(0);
    }
    let offset = part.as_ptr().addr().checked_sub(payload.as_ptr().addr())?;
    (offset.checked_add(part.len())? <= payload.len()).then_some(offset as u64)
}

fn required<T>(value: Option<T>, field: &str, path: &Path) -> Result<T, DataError> {
    value.ok_or_else(|| bad(path, &format!("a frame without {field}")))
}

fn bad(path: &Path, why: &str) -> DataError {
    DataError::Format { format: "Waymo frame", why: why.to_owned(), path: path.to_owned() }
}

#[cfg(test)]
mod tests;
