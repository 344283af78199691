//! Types of the second release drift: tables are written here in every form that occurs and must read alike.

use std::path::Path;
use std::sync::Arc;

use arrow_array::cast::AsArray;
use arrow_array::types::{Float64Type, Int8Type, Int64Type};
use arrow_array::{
    Array, ArrayRef, FixedSizeListArray, Float32Array, Int16Array, Int64Array, LargeStringArray, ListArray,
    RecordBatch, StringArray,
};
use arrow_buffer::OffsetBuffer;
use arrow_schema::{DataType, Field, Schema};
use data::SceneDataset;
use data::waymo::{Waymo, WaymoRelease};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;

use super::{assert_same, config, fixture, frames};

/// Copies a folder of tables.
pub(super) fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            std::fs::write(target, std::fs::read(path).unwrap()).unwrap();
        }
    }
}

/// The one table of a component.
pub(super) fn table(split: &Path, component: &str) -> std::path::PathBuf {
    std::fs::read_dir(split.join(component)).unwrap().next().unwrap().unwrap().path()
}

/// Rewrites columns of a table; `None` drops one.
pub(super) fn rewrite(path: &Path, compression: Compression, change: impl Fn(&str, &ArrayRef) -> Option<ArrayRef>) {
    let file = std::fs::File::open(path).unwrap();
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap();
    let batches: Vec<RecordBatch> = reader.map(Result::unwrap).collect();
    let changed = |batch: &RecordBatch| {
        let schema = batch.schema();
        let columns = schema.fields().iter().zip(batch.columns());
        let columns: Vec<(Field, ArrayRef)> = columns
            .filter_map(|(field, array)| change(field.name(), array).map(|a| (field.name(), a)))
            .map(|(name, array)| (Field::new(name, array.data_type().clone(), true), array))
            .collect();
        let (fields, arrays): (Vec<_>, Vec<_>) = columns.into_iter().unzip();
        RecordBatch::try_new(Arc::new(Schema::new(fields)), arrays).unwrap()
    };
    let changed: Vec<RecordBatch> = batches.iter().map(changed).collect();
    let properties = WriterProperties::builder().set_compression(compression).build();
    let file = std::fs::File::create(path).unwrap();
    let mut writer = ArrowWriter::try_new(file, changed[0].schema(), Some(properties)).unwrap();
    changed.iter().for_each(|batch| writer.write(batch).unwrap());
    writer.close().unwrap();
}

const NAMES: [&str; 6] = ["", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT"];

/// Names instead of numbers, wider or narrower numbers, lists without a fixed length.
fn drifted(name: &str, array: &ArrayRef) -> Option<ArrayRef> {
    let wide = |array: &ArrayRef| array.as_primitive_opt::<Int8Type>().map(|a| a.iter().collect::<Vec<_>>());
    Some(match name {
        "key.camera_name" => {
            Arc::new(StringArray::from_iter_values(wide(array)?.iter().map(|v| NAMES[v.unwrap() as usize])))
        }
        "[LiDARBoxComponent].type" => {
            Arc::new(wide(array)?.into_iter().map(|v| v.map(i16::from)).collect::<Int16Array>())
        }
        "key.segment_context_name" => Arc::new(array.as_string::<i32>().iter().collect::<LargeStringArray>()),
        _ if name.contains("num_") => {
            let narrow = array.as_primitive_opt::<Int64Type>()?.iter().map(|v| v.map(|v| v as i16));
            Arc::new(narrow.collect::<Int16Array>())
        }
        _ if name.ends_with(".transform") => {
            let list = array.as_fixed_size_list();
            let item = Arc::new(Field::new("item", DataType::Float64, true));
            let offsets = OffsetBuffer::from_lengths(vec![16; list.len()]);
            Arc::new(ListArray::new(item, offsets, list.values().clone(), None))
        }
        _ => array.clone(),
    })
}

#[test]
fn names_widths_lists_and_compressions_read_alike() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let original = Waymo::open(&config(&made, WaymoRelease::V2, ".")).unwrap();
    for compression in [Compression::UNCOMPRESSED, Compression::SNAPPY, Compression::ZSTD(ZstdLevel::default())] {
        let folder = tempfile::tempdir().unwrap();
        copy(&made, folder.path());
        for component in ["camera_image", "camera_calibration", "vehicle_pose", "lidar_box", "stats"] {
            rewrite(&table(folder.path(), component), compression, drifted);
        }
        let drifted = Waymo::open(&config(folder.path(), WaymoRelease::V2, ".")).unwrap();
        for (a, b) in frames(&original).iter().zip(&frames(&drifted)) {
            assert_same(a, b, 0.0);
        }
    }
}

#[test]
fn poses_of_half_the_width_are_right_to_millimetres() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let folder = tempfile::tempdir().unwrap();
    copy(&made, folder.path());
    rewrite(&table(folder.path(), "vehicle_pose"), Compression::SNAPPY, |name, array| {
        let Some(list) = array.as_fixed_size_list_opt() else { return Some(array.clone()) };
        assert!(name.ends_with(".transform"));
        let narrow = list.values().as_primitive::<Float64Type>().iter().map(|v| v.map(|v| v as f32));
        let item = Arc::new(Field::new("item", DataType::Float32, true));
        Some(Arc::new(FixedSizeListArray::new(item, 16, Arc::new(narrow.collect::<Float32Array>()), None)))
    });
    let [wide, narrow] =
        [&made, folder.path()].map(|root: &Path| Waymo::open(&config(root, WaymoRelease::V2, ".")).unwrap());
    for (a, b) in frames(&wide).iter().zip(&frames(&narrow)) {
        let off = (a.world_from_ego.translation - b.world_from_ego.translation).length();
        assert!(off > 0.0 && off < 4e-3, "{off}");
        assert!(a.world_from_ego.angle_to(&b.world_from_ego) < 1e-6);
    }
}

/// The published pose table (f32 lists) joined with made tables of one camera, which has its name as in the published key points.
#[test]
fn the_published_pose_table_loads() {
    let Some(made) = fixture("waymo/v2_made/validation") else { return };
    let published = table(&fixture("waymo/v2").unwrap(), "vehicle_pose");
    let context = published.file_stem().unwrap().to_str().unwrap().to_owned();
    let folder = tempfile::tempdir().unwrap();
    for component in ["camera_image", "camera_calibration"] {
        let target = folder.path().join(component).join(format!("{context}.parquet"));
        std::fs::create_dir_all(target.parent().unwrap()).unwrap();
        std::fs::copy(table(&made, component), &target).unwrap();
        rewrite(&target, Compression::SNAPPY, |name, array| match name {
            "key.segment_context_name" => Some(Arc::new(StringArray::from(vec![context.as_str(); array.len()]))),
            // All pictures belong to the first published stamp: their cameras repeat, so one frame cannot be read.
            "key.frame_timestamp_micros" => Some(Arc::new(Int64Array::from(vec![1_552_440_195_362_591; array.len()]))),
            _ => drifted(name, array),
        });
    }
    let poses = folder.path().join("vehicle_pose").join(format!("{context}.parquet"));
    std::fs::create_dir_all(poses.parent().unwrap()).unwrap();
    std::fs::copy(published, poses).unwrap();
    let dataset = Waymo::open(&config(folder.path(), WaymoRelease::V2, ".")).unwrap();
    assert_eq!((dataset.len(), dataset.max_views(), dataset.capabilities().boxes), (199, 5, false));
    assert_eq!(super::variant(&dataset.frame(0).unwrap_err()), "DuplicateToken");
    let mut before = dataset.frame(1).unwrap();
    assert!((before.world_from_ego.translation.x - 860.59).abs() < 5.0);
    for index in 2..199 {
        let frame = dataset.frame(index).unwrap();
        assert!(frame.boxes.is_none() && frame.scene_text.is_none());
        assert!(frame.views.len() == 5 && frame.views.iter().all(|view| view.image.is_none()));
        let gap_ms = (frame.timestamp_ns - before.timestamp_ns) as f64 * 1e-6;
        assert!((gap_ms - 100.0).abs() < 5.0, "{gap_ms}");
        let way = (frame.world_from_ego.translation - before.world_from_ego.translation).length();
        assert!(way < 4.0, "{way} m in {gap_ms} ms");
        before = frame;
    }
}
