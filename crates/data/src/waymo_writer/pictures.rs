//! The component with the pictures: large, so it is made and written a few frames at a time.

use std::path::Path;

use arrow_array::{BinaryArray, RecordBatch};
use arrow_schema::DataType;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use parquet::basic::Compression;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use rayon::prelude::*;

use super::components::keyed;
use super::config::WaymoWriterConfig;
use super::plan::Scene;
use super::table::TableWriter;
use crate::waymo::cameras::pose_numbers;
use crate::waymo::components::{CAMERA, column};
use crate::{DataError, ImageSource, View};

/// Frames per row group.
const GROUP_FRAMES: usize = 8;

/// What was written.
pub(super) struct Written {
    pub count: usize,
    pub sha256: String,
}

/// A view with its picture.
struct Shot<'a> {
    micros: i64,
    camera: i8,
    view: &'a View,
    image: &'a ImageSource,
}

/// Writes the component; `advance` is called with the number of frames just written.
pub(super) fn write(
    config: &WaymoWriterConfig,
    scene: &Scene<'_>,
    path: &Path,
    advance: &mut dyn FnMut(usize),
) -> Result<Written, DataError> {
    let like = batch(config, scene, &[], path)?;
    let mut writer = TableWriter::create(path, &like, properties())?;
    let mut count = 0;
    for (micros, frames) in scene.micros.chunks(GROUP_FRAMES).zip(scene.frames.chunks(GROUP_FRAMES)) {
        let mut shots = Vec::new();
        for (micros, frame) in micros.iter().zip(frames) {
            let mut of_frame = Vec::new();
            for view in &frame.views {
                let camera = config.camera(&view.channel)?;
                of_frame.extend(view.image.as_ref().map(|image| Shot { micros: *micros, camera, view, image }));
            }
            of_frame.sort_by_key(|shot| shot.camera);
            shots.append(&mut of_frame);
        }
        count += shots.len();
        writer.write(&batch(config, scene, &shots, path)?)?;
        advance(frames.len());
    }
    Ok(Written { count, sha256: writer.finish()? })
}

/// Pictures do not shrink further, and one of them per page lets readers pass over the others.
fn properties() -> WriterProperties {
    let image = ColumnPath::new(vec![field("image")]);
    WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_column_compression(image.clone(), Compression::UNCOMPRESSED)
        .set_column_dictionary_enabled(image.clone(), false)
        .set_column_statistics_enabled(image.clone(), EnabledStatistics::None)
        .set_column_data_page_row_count_limit(image, 1)
        .set_write_batch_size(1)
        .build()
}

fn field(name: &str) -> String {
    column("CameraImage", name)
}

fn batch(
    config: &WaymoWriterConfig,
    scene: &Scene<'_>,
    shots: &[Shot<'_>],
    path: &Path,
) -> Result<RecordBatch, DataError> {
    let encoded: Vec<Vec<u8>> = shots.par_iter().map(|shot| encode(config, shot)).collect::<Result<_, _>>()?;
    let secs = || shots.iter().map(|shot| Some(secs(shot.view.timestamp_ns)));
    let mut table = keyed(scene, shots.iter().map(|shot| shot.micros));
    table.int8(CAMERA, shots.iter().map(|shot| shot.camera));
    table.array(field("image"), BinaryArray::from_iter_values(&encoded));
    table.poses(&field("pose.transform"), shots.iter().map(|shot| pose_numbers(&shot.view.world_from_ego)))?;
    for axis in ["x", "y", "z"] {
        table.unknown(field(&format!("velocity.linear_velocity.{axis}")), DataType::Float32);
    }
    for axis in ["x", "y", "z"] {
        table.unknown(field(&format!("velocity.angular_velocity.{axis}")), DataType::Float64);
    }
    table.float64(field("pose_timestamp"), secs());
    // A global shutter: every row is exposed at the instant of the pose.
    table.float64(field("rolling_shutter_params.shutter"), shots.iter().map(|_| Some(0.0)));
    table.float64(field("rolling_shutter_params.camera_trigger_time"), secs());
    table.float64(field("rolling_shutter_params.camera_readout_done_time"), secs());
    table.batch(path)
}

/// The stored bytes of a JPEG, else the pixels encoded.
fn encode(config: &WaymoWriterConfig, shot: &Shot<'_>) -> Result<Vec<u8>, DataError> {
    if let Some(bytes) = shot.image.jpeg_bytes()? {
        return Ok(bytes);
    }
    let picture = shot.image.decode()?;
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, config.jpeg_quality)
        .encode(picture.as_raw(), picture.width(), picture.height(), ExtendedColorType::Rgb8)
        .map_err(|error| {
            DataError::Config(format!("the picture of {} cannot be encoded: {error}", shot.view.channel))
        })?;
    Ok(bytes)
}

/// Whole seconds and their rest apart: an i64 of nanoseconds does not fit into an f64.
fn secs(timestamp_ns: i64) -> f64 {
    let (whole, rest) = (timestamp_ns.div_euclid(1_000_000_000), timestamp_ns.rem_euclid(1_000_000_000));
    whole as f64 + rest as f64 * 1e-9
}
