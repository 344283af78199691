//! Parquet tables whose columns are asked for by their literal names, dots and brackets included, and whose types may vary in width.

use std::io::{BufReader, Read};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

use arrow_array::cast::AsArray;
use arrow_array::types::{
    ArrowPrimitiveType, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type,
    UInt32Type,
};
use arrow_array::{Array, RecordBatch};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder, RowSelection,
    RowSelector,
};
use parquet::errors::ParquetError;
use parquet::file::reader::{ChunkReader, Length};
use prost::bytes::Bytes;

use crate::DataError;
use crate::store::StoredFile;

/// More rows than any table that is read whole may have: run lengths let a few bytes claim billions.
const MAX_ROWS: usize = 1 << 22;
/// Rows decoded at a time.
const BATCH_ROWS: usize = 4096;
/// Read ahead for page headers, which are a few dozen bytes.
const HEADER_BYTES: usize = 512;

/// An opened table: its footer is in memory, its pages are read on demand. Cheap to clone.
#[derive(Debug, Clone)]
pub(crate) struct ParquetFile {
    file: StoredFile,
    metadata: ArrowReaderMetadata,
}

/// Some columns of a table, read whole.
#[derive(Debug)]
pub(crate) struct Columns {
    path: PathBuf,
    batches: Vec<RecordBatch>,
}

impl ParquetFile {
    /// Reads the footer.
    pub(crate) fn open(file: StoredFile) -> Result<Self, DataError> {
        let chunks = Chunks { size: file.size()?, file: file.clone() };
        // Without the embedded Arrow schema every list is a plain list and every text a plain text, whoever wrote the file.
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let metadata = guarded(file.path(), || ArrowReaderMetadata::load(&chunks, options))?;
        Ok(Self { file, metadata })
    }

    pub(crate) fn path(&self) -> &Path {
        self.file.path()
    }

    /// Whether there is a column of this name.
    pub(crate) fn has(&self, column: &str) -> bool {
        self.root(column).is_some()
    }

    /// The named columns; no other is read.
    ///
    /// # Errors
    /// [`DataError::Column`] for an absent one, [`DataError::Format`] for broken pages.
    pub(crate) fn columns(&self, names: &[&str]) -> Result<Columns, DataError> {
        let groups = self.metadata.metadata().row_groups();
        let rows =
            groups.iter().try_fold(0usize, |sum, group| sum.checked_add(usize::try_from(group.num_rows()).ok()?));
        if rows.is_none_or(|rows| rows > MAX_ROWS) {
            return Err(bad(self.path(), format!("more than {MAX_ROWS} rows")));
        }
        let reader = self.reader(names, None)?;
        let batches = guarded(self.path(), || reader.collect::<Result<_, _>>())?;
        Ok(Columns { path: self.path().to_owned(), batches })
    }

    /// One value of a binary column; pages of other rows are passed over.
    ///
    /// # Errors
    /// As [`ParquetFile::columns`].
    pub(crate) fn cell(&self, column: &str, row: usize) -> Result<Vec<u8>, DataError> {
        let mut reader = self.reader(&[column], Some(row))?;
        let batch = guarded(self.path(), || reader.next().transpose())?;
        let array = batch.as_ref().and_then(|batch| batch.columns().first());
        let array = array.and_then(|array| array.as_binary_opt::<i32>());
        let array = array.ok_or_else(|| column_error(self.path(), column, "it holds no bytes"))?;
        if array.is_empty() || array.is_null(0) {
            return Err(column_error(self.path(), column, &format!("row {row} is empty")));
        }
        Ok(array.value(0).to_vec())
    }

    /// Position of a column among the top-level ones.
    fn root(&self, column: &str) -> Option<usize> {
        self.metadata.parquet_schema().root_schema().get_fields().iter().position(|field| field.name() == column)
    }

    /// A reader of these columns, over all rows or one.
    fn reader(&self, names: &[&str], row: Option<usize>) -> Result<ParquetRecordBatchReader, DataError> {
        let root = |name: &&str| self.root(name).ok_or_else(|| column_error(self.path(), name, "there is none"));
        let roots = names.iter().map(root).collect::<Result<Vec<_>, _>>()?;
        let chunks = Chunks { size: self.file.size()?, file: self.file.clone() };
        let mut builder = ParquetRecordBatchReaderBuilder::new_with_metadata(chunks, self.metadata.clone())
            .with_projection(ProjectionMask::roots(self.metadata.parquet_schema(), roots))
            .with_batch_size(BATCH_ROWS);
        if let Some(row) = row {
            let (group, before) = self
                .group_of(row)
                .ok_or_else(|| column_error(self.path(), names.first().copied().unwrap_or_default(), "too few rows"))?;
            let selection = RowSelection::from(vec![RowSelector::skip(before), RowSelector::select(1)]);
            builder = builder.with_row_groups(vec![group]).with_row_selection(selection).with_batch_size(1);
        }
        guarded(self.path(), || builder.build())
    }

    /// The row group of a row, and how many of its rows come before.
    fn group_of(&self, row: usize) -> Option<(usize, usize)> {
        let mut before = row;
        for (index, group) in self.metadata.metadata().row_groups().iter().enumerate() {
            let rows = usize::try_from(group.num_rows()).ok()?;
            if before < rows {
                return Some((index, before));
            }
            before -= rows;
        }
        None
    }
}

impl Columns {
    /// Numbers of either float width or any integer type.
    pub(crate) fn floats(&self, name: &str) -> Result<Vec<Option<f64>>, DataError> {
        self.gather(name, "numbers", floats_of)
    }

    /// Integers of any width.
    pub(crate) fn integers(&self, name: &str) -> Result<Vec<Option<i64>>, DataError> {
        self.gather(name, "integers", integers_of)
    }

    /// Texts.
    pub(crate) fn texts(&self, name: &str) -> Result<Vec<Option<String>>, DataError> {
        self.gather(name, "texts", |array| {
            Some(array.as_string_opt::<i32>()?.iter().map(|text| text.map(ToOwned::to_owned)).collect())
        })
    }

    /// Lists of numbers, each of its own length.
    pub(crate) fn lists(&self, name: &str) -> Result<Vec<Option<Vec<f64>>>, DataError> {
        self.gather(name, "lists of numbers", |array| {
            let numbers = |list: Option<std::sync::Arc<dyn Array>>| match list {
                None => Some(None),
                // A missing number inside a list is no number.
                Some(list) => Some(Some(floats_of(&list)?.into_iter().map(|v| v.unwrap_or(f64::NAN)).collect())),
            };
            array.as_list_opt::<i32>()?.iter().map(numbers).collect()
        })
    }

    /// All values of a column that must have one in every row.
    pub(crate) fn filled<T>(&self, name: &str, values: Vec<Option<T>>) -> Result<Vec<T>, DataError> {
        let row =
            |(row, value): (usize, Option<T>)| value.ok_or_else(|| self.bad(name, &format!("row {row} is empty")));
        values.into_iter().enumerate().map(row).collect()
    }

    /// A complaint about a column of this table.
    pub(crate) fn bad(&self, name: &str, why: &str) -> DataError {
        column_error(&self.path, name, why)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    fn gather<T>(
        &self,
        name: &str,
        what: &str,
        read: impl Fn(&dyn Array) -> Option<Vec<T>>,
    ) -> Result<Vec<T>, DataError> {
        let mut values = Vec::new();
        for batch in &self.batches {
            let array = batch.column_by_name(name).ok_or_else(|| self.bad(name, "there is none"))?;
            let part = read(array.as_ref());
            values.extend(part.ok_or_else(|| self.bad(name, &format!("{} instead of {what}", array.data_type())))?);
        }
        Ok(values)
    }
}

fn primitives<T: ArrowPrimitiveType, V>(array: &dyn Array, convert: impl Fn(T::Native) -> V) -> Option<Vec<Option<V>>> {
    Some(array.as_primitive_opt::<T>()?.iter().map(|value| value.map(&convert)).collect())
}

fn integers_of(array: &dyn Array) -> Option<Vec<Option<i64>>> {
    primitives::<Int64Type, _>(array, |v| v)
        .or_else(|| primitives::<Int32Type, _>(array, i64::from))
        .or_else(|| primitives::<Int16Type, _>(array, i64::from))
        .or_else(|| primitives::<Int8Type, _>(array, i64::from))
        .or_else(|| primitives::<UInt32Type, _>(array, i64::from))
        .or_else(|| primitives::<UInt16Type, _>(array, i64::from))
        .or_else(|| primitives::<UInt8Type, _>(array, i64::from))
}

fn floats_of(array: &dyn Array) -> Option<Vec<Option<f64>>> {
    primitives::<Float64Type, _>(array, |v| v)
        .or_else(|| primitives::<Float32Type, _>(array, f64::from))
        .or_else(|| Some(integers_of(array)?.into_iter().map(|value| value.map(|v| v as f64)).collect()))
}

/// The library panics on some broken pages instead of refusing them; nothing outlives the call, so the file is all that is wrong.
fn guarded<T, E: std::fmt::Display>(path: &Path, read: impl FnOnce() -> Result<T, E>) -> Result<T, DataError> {
    match catch_unwind(AssertUnwindSafe(read)) {
        Ok(outcome) => outcome.map_err(|error| bad(path, error)),
        Err(_) => Err(bad(path, "a page breaks the rules of its encoding")),
    }
}

fn bad(path: &Path, why: impl std::fmt::Display) -> DataError {
    DataError::Format { format: "Parquet", why: why.to_string(), path: path.to_owned() }
}

fn column_error(path: &Path, column: &str, why: &str) -> DataError {
    DataError::Column { column: column.to_owned(), why: why.to_owned(), path: path.to_owned() }
}

/// Positional reads for the Parquet library.
#[derive(Debug, Clone)]
struct Chunks {
    file: StoredFile,
    size: u64,
}

impl Chunks {
    fn read(&self, start: u64, length: u64) -> Result<Vec<u8>, DataError> {
        self.file.read_at(start, length.min(self.size.saturating_sub(start)))
    }
}

impl Length for Chunks {
    fn len(&self) -> u64 {
        self.size
    }
}

impl ChunkReader for Chunks {
    type T = BufReader<ChunkStream>;

    fn get_read(&self, start: u64) -> parquet::errors::Result<Self::T> {
        Ok(BufReader::with_capacity(HEADER_BYTES, ChunkStream { chunks: self.clone(), at: start }))
    }

    fn get_bytes(&self, start: u64, length: usize) -> parquet::errors::Result<Bytes> {
        let bytes = self.file.read_at(start, length as u64);
        bytes.map(Bytes::from).map_err(|error| ParquetError::External(Box::new(error)))
    }
}

/// Bytes from some place on.
struct ChunkStream {
    chunks: Chunks,
    at: u64,
}

impl Read for ChunkStream {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let bytes = self.chunks.read(self.at, buffer.len() as u64).map_err(std::io::Error::other)?;
        let into = buffer.iter_mut().zip(&bytes);
        into.for_each(|(to, from)| *to = *from);
        self.at += bytes.len() as u64;
        Ok(bytes.len())
    }
}
