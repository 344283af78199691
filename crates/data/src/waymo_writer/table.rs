//! Columns with literal names, written as one Parquet file.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::sync::Arc;

use arrow_array::{
    Array, ArrayRef, FixedSizeListArray, Float64Array, Int8Array, Int64Array, RecordBatch, StringArray, new_null_array,
};
use arrow_schema::{DataType, Field, Schema};
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::file::properties::WriterProperties;
use sha2::{Digest, Sha256};

use crate::DataError;
use crate::staging as files;

/// Columns of one length.
#[derive(Debug, Default)]
pub(super) struct Table {
    fields: Vec<Field>,
    arrays: Vec<ArrayRef>,
}

impl Table {
    /// Any array.
    pub fn array(&mut self, name: impl Into<String>, array: impl Array + 'static) {
        self.fields.push(Field::new(name, array.data_type().clone(), true));
        self.arrays.push(Arc::new(array));
    }

    pub fn float64(&mut self, name: impl Into<String>, values: impl IntoIterator<Item = Option<f64>>) {
        self.array(name, values.into_iter().collect::<Float64Array>());
    }

    pub fn int64(&mut self, name: impl Into<String>, values: impl IntoIterator<Item = Option<i64>>) {
        self.array(name, values.into_iter().collect::<Int64Array>());
    }

    pub fn int8(&mut self, name: impl Into<String>, values: impl IntoIterator<Item = i8>) {
        self.array(name, Int8Array::from_iter_values(values));
    }

    pub fn text<T: AsRef<str>>(&mut self, name: impl Into<String>, values: impl IntoIterator<Item = Option<T>>) {
        self.array(name, values.into_iter().collect::<StringArray>());
    }

    /// A column of poses, 16 numbers each.
    pub fn poses(&mut self, name: &str, poses: impl IntoIterator<Item = [f64; 16]>) -> Result<(), DataError> {
        let numbers = Float64Array::from_iter_values(poses.into_iter().flatten());
        let item = Arc::new(Field::new("item", DataType::Float64, true));
        let list = FixedSizeListArray::try_new(item, 16, Arc::new(numbers), None);
        let list = list.map_err(|error| DataError::Config(format!("column {name} cannot be made: {error}")))?;
        self.array(name, list);
        Ok(())
    }

    /// A column that the format has and the frames do not know.
    pub fn unknown(&mut self, name: impl Into<String>, kind: DataType) {
        let rows = self.arrays.first().map_or(0, |array| array.len());
        self.fields.push(Field::new(name, kind.clone(), true));
        self.arrays.push(new_null_array(&kind, rows));
    }

    pub fn batch(self, path: &Path) -> Result<RecordBatch, DataError> {
        RecordBatch::try_new(Arc::new(Schema::new(self.fields)), self.arrays).map_err(|error| bad(path, error))
    }

    /// Writes the file in one row group; its SHA-256.
    pub fn write(self, path: &Path) -> Result<String, DataError> {
        let properties = WriterProperties::builder().set_compression(Compression::SNAPPY).build();
        let batch = self.batch(path)?;
        let mut writer = TableWriter::create(path, &batch, properties)?;
        writer.write(&batch)?;
        writer.finish()
    }
}

/// A file under construction.
pub(super) struct TableWriter {
    writer: ArrowWriter<Hashing>,
    path: std::path::PathBuf,
}

impl TableWriter {
    /// A file with the columns of `like`.
    pub fn create(path: &Path, like: &RecordBatch, properties: WriterProperties) -> Result<Self, DataError> {
        let file = File::create(path).map_err(files::io("make", path))?;
        let sink = Hashing { file: BufWriter::new(file), digest: Sha256::new() };
        let writer = ArrowWriter::try_new(sink, like.schema(), Some(properties)).map_err(|error| bad(path, error))?;
        Ok(Self { writer, path: path.to_owned() })
    }

    /// Adds a row group.
    pub fn write(&mut self, batch: &RecordBatch) -> Result<(), DataError> {
        let written = self.writer.write(batch).and_then(|()| self.writer.flush());
        written.map_err(|error| bad(&self.path, error))
    }

    /// Ends the file; its SHA-256.
    pub fn finish(self) -> Result<String, DataError> {
        let mut sink = self.writer.into_inner().map_err(|error| bad(&self.path, error))?;
        sink.file.flush().map_err(files::io("write", &self.path))?;
        Ok(hex(&sink.digest.finalize()))
    }
}

/// Lower-case hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn bad(path: &Path, error: impl std::fmt::Display) -> DataError {
    DataError::Format { format: "Parquet", why: error.to_string(), path: path.to_owned() }
}

/// A file that knows the sum of what was written to it.
struct Hashing {
    file: BufWriter<File>,
    digest: Sha256,
}

impl Write for Hashing {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.file.write(bytes)?;
        self.digest.update(bytes.get(..written).unwrap_or(bytes));
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.file.flush()
    }
}
