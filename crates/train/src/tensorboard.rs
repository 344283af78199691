//! TensorBoard event files: protobuf events in TFRecord framing.
//!
//! Formats: tensorflow `core/util/event.proto`, `core/framework/summary.proto` (field numbers) and
//! `core/lib/io/record_writer.cc` (framing). Checked against the `tensorboard` package by
//! `tests/peers/tensorboard_check.py`.

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use prost::Message;

use crate::TrainError;

/// `event.proto`: one entry of the file. Exactly one of the last three is set.
#[derive(Clone, PartialEq, Message)]
struct Event {
    /// Seconds since 1970.
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(string, optional, tag = "3")]
    file_version: Option<String>,
    #[prost(message, optional, tag = "5")]
    summary: Option<Summary>,
    #[prost(message, optional, tag = "7")]
    session_log: Option<SessionLog>,
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<SummaryValue>,
}

/// `summary.proto`, message `Summary.Value`; a scalar or an image.
#[derive(Clone, PartialEq, Message)]
struct SummaryValue {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(float, optional, tag = "2")]
    simple_value: Option<f32>,
    #[prost(message, optional, tag = "4")]
    image: Option<SummaryImage>,
}

/// `summary.proto`, message `Summary.Image`.
#[derive(Clone, PartialEq, Message)]
struct SummaryImage {
    #[prost(int32, tag = "1")]
    height: i32,
    #[prost(int32, tag = "2")]
    width: i32,
    /// 3 is RGB.
    #[prost(int32, tag = "3")]
    colorspace: i32,
    #[prost(bytes = "vec", tag = "4")]
    encoded_image_string: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct SessionLog {
    /// 1 is START: readers drop events of earlier files at or after this event's step.
    #[prost(int32, tag = "1")]
    status: i32,
}

/// Appends to one event file. Each part of a resumed run has its own file, as TensorBoard expects.
#[derive(Debug)]
pub struct EventWriter {
    path: PathBuf,
    file: File,
}

impl EventWriter {
    /// Starts `<run_dir>/events.out.tfevents.<seconds>.<host>` for a run that goes on from `step`.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn create(run_dir: &Path, step: u64) -> Result<Self, TrainError> {
        let seconds = now_secs() as u64;
        let base = format!("events.out.tfevents.{seconds:010}.{}", host_name());
        let mut path = run_dir.join(&base);
        let mut number = 0;
        let file = loop {
            match File::create_new(&path) {
                Err(why) if why.kind() == std::io::ErrorKind::AlreadyExists => {
                    number += 1;
                    path = run_dir.join(format!("{base}.{number}"));
                }
                result => break result.map_err(TrainError::io("create", &path))?,
            }
        };
        let mut writer = Self { path, file };
        // TensorBoard reads a file only when its first event names this version.
        writer.write(Event { file_version: Some("brain.Event:2".into()), ..Event::default() })?;
        if step > 0 {
            let session_log = Some(SessionLog { status: 1 });
            writer.write(Event { step: step as i64 + 1, session_log, ..Event::default() })?;
        }
        Ok(writer)
    }

    /// Writes the values of one step under `<group>/<name>`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn scalars(&mut self, step: u64, group: &str, values: &[(String, f64)]) -> Result<(), TrainError> {
        let value = values.iter().map(|(name, value)| SummaryValue {
            tag: format!("{group}/{name}"),
            simple_value: Some(*value as f32),
            image: None,
        });
        let summary = Some(Summary { value: value.collect() });
        self.write(Event { step: step as i64, summary, ..Event::default() })
    }

    /// Writes a PNG (RGB, width × height pixels) under `tag`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn image(&mut self, step: u64, tag: &str, png: Vec<u8>, size: (u32, u32)) -> Result<(), TrainError> {
        let image =
            SummaryImage { width: size.0 as i32, height: size.1 as i32, colorspace: 3, encoded_image_string: png };
        let value = SummaryValue { tag: tag.to_string(), simple_value: None, image: Some(image) };
        self.write(Event { step: step as i64, summary: Some(Summary { value: vec![value] }), ..Event::default() })
    }

    fn write(&mut self, event: Event) -> Result<(), TrainError> {
        let event = Event { wall_time: now_secs(), ..event };
        self.file.write_all(&record(&event.encode_to_vec())).map_err(TrainError::io("write", &self.path))
    }
}

/// TFRecord framing: length, its checksum, the data, their checksum; all little-endian.
fn record(data: &[u8]) -> Vec<u8> {
    let length = (data.len() as u64).to_le_bytes();
    let mut framed = Vec::with_capacity(data.len() + 16);
    framed.extend_from_slice(&length);
    framed.extend_from_slice(&masked_crc(&length).to_le_bytes());
    framed.extend_from_slice(data);
    framed.extend_from_slice(&masked_crc(data).to_le_bytes());
    framed
}

/// CRC-32C, rotated and offset so that a checksum of data that hold checksums stays meaningful (`core/lib/hash/crc32c.h`).
fn masked_crc(data: &[u8]) -> u32 {
    crc32c::crc32c(data).rotate_right(15).wrapping_add(0xa282_ead8)
}

fn now_secs() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |since| since.as_secs_f64())
}

fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname").ok().or_else(|| std::env::var("HOSTNAME").ok());
    let name: String =
        name.unwrap_or_default().trim().chars().filter(|c| c.is_ascii_alphanumeric() || *c == '-').collect();
    if name.is_empty() { "localhost".to_string() } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_has_the_known_checksums() {
        // CRC-32C of "123456789" is 0xe3069283 (RFC 3720's polynomial); masked by hand: rotate right 15, add the offset.
        assert_eq!(masked_crc(b"123456789"), 0xe306_9283_u32.rotate_right(15).wrapping_add(0xa282_ead8));
        let framed = record(b"abc");
        assert_eq!(framed.len(), 8 + 4 + 3 + 4);
        assert_eq!(&framed[..8], [3, 0, 0, 0, 0, 0, 0, 0]);
        assert_eq!(&framed[12..15], b"abc");
    }

    #[test]
    fn two_writers_in_one_second_do_not_share_a_file() {
        let folder = tempfile::tempdir().unwrap();
        for step in [0, 7] {
            let mut writer = EventWriter::create(folder.path(), step).unwrap();
            writer.scalars(step + 1, "train", &[("loss".to_string(), 0.5)]).unwrap();
        }
        let names = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
        let names: Vec<String> = names.map(|name| name.into_string().unwrap()).collect();
        assert_eq!(names.len(), 2);
        assert!(names.iter().all(|name| name.starts_with("events.out.tfevents.")), "{names:?}");
    }
}
