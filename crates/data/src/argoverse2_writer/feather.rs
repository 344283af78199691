//! Feather tables as the release holds them: Arrow IPC files, LZ4 frames, batches of 65536 rows.

use std::sync::Arc;

use arrow_array::{
    ArrayRef, Float16Array, Float64Array, Int32Array, Int64Array, RecordBatch, StringArray, UInt8Array, UInt16Array,
};
use arrow_ipc::writer::{FileWriter, IpcWriteOptions};
use arrow_ipc::{CompressionType, MetadataVersion};
use arrow_schema::{ArrowError, Field, Schema};
use geometry::Rigid;
use half::f16;

use crate::DataError;

/// Rows of one record batch in the release.
const BATCH: usize = 65_536;

/// A table under construction.
#[derive(Debug, Default)]
pub(super) struct Columns {
    fields: Vec<Field>,
    arrays: Vec<ArrayRef>,
}

impl Columns {
    fn add(mut self, name: &str, array: ArrayRef) -> Self {
        self.fields.push(Field::new(name, array.data_type().clone(), true));
        self.arrays.push(array);
        self
    }

    pub(super) fn i64(self, name: &str, values: Vec<i64>) -> Self {
        self.add(name, Arc::new(Int64Array::from(values)))
    }

    pub(super) fn i32(self, name: &str, values: Vec<i32>) -> Self {
        self.add(name, Arc::new(Int32Array::from(values)))
    }

    pub(super) fn u16(self, name: &str, values: Vec<u16>) -> Self {
        self.add(name, Arc::new(UInt16Array::from(values)))
    }

    pub(super) fn u8(self, name: &str, values: Vec<u8>) -> Self {
        self.add(name, Arc::new(UInt8Array::from(values)))
    }

    pub(super) fn f64(self, name: &str, values: Vec<f64>) -> Self {
        self.add(name, Arc::new(Float64Array::from(values)))
    }

    pub(super) fn f16(self, name: &str, values: Vec<f16>) -> Self {
        self.add(name, Arc::new(Float16Array::from(values)))
    }

    pub(super) fn text(self, name: &str, values: Vec<&str>) -> Self {
        self.add(name, Arc::new(StringArray::from(values)))
    }

    /// The seven columns of rigid transforms.
    pub(super) fn poses(self, poses: &[Rigid]) -> Self {
        let part = |of: fn(&Rigid) -> f64| poses.iter().map(of).collect::<Vec<f64>>();
        self.f64("qw", part(|pose| pose.rotation.w))
            .f64("qx", part(|pose| pose.rotation.x))
            .f64("qy", part(|pose| pose.rotation.y))
            .f64("qz", part(|pose| pose.rotation.z))
            .f64("tx_m", part(|pose| pose.translation.x))
            .f64("ty_m", part(|pose| pose.translation.y))
            .f64("tz_m", part(|pose| pose.translation.z))
    }

    /// The file's bytes. A table without rows has one empty batch.
    pub(super) fn encode(self) -> Result<Vec<u8>, DataError> {
        let table = || -> Result<Vec<u8>, ArrowError> {
            let schema = Arc::new(Schema::new(self.fields));
            let batch = RecordBatch::try_new(schema.clone(), self.arrays)?;
            let options = IpcWriteOptions::try_new(64, false, MetadataVersion::V5)?;
            let options = options.try_with_compression(Some(CompressionType::LZ4_FRAME))?;
            let mut writer = FileWriter::try_new_with_options(Vec::new(), &schema, options)?;
            let mut start = 0;
            loop {
                let rows = BATCH.min(batch.num_rows() - start);
                writer.write(&batch.slice(start, rows))?;
                start += rows;
                if start == batch.num_rows() {
                    break;
                }
            }
            writer.into_inner()
        };
        table().map_err(|error| DataError::Config(format!("a table cannot be written: {error}")))
    }
}
