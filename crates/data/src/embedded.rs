//! Encoded pictures inside larger files: a handle says where one is, so that frames stay free of pixels.

use std::path::Path;
use std::sync::Arc;

use crate::DataError;
use crate::parquet_file::ParquetFile;
use crate::store::StoredFile;

/// Where an encoded picture lies inside a file. Cheap to clone.
#[derive(Debug, Clone)]
pub struct EmbeddedPicture(Place);

#[derive(Debug, Clone)]
enum Place {
    Bytes { file: StoredFile, offset: u64, length: u64 },
    Cell { table: ParquetFile, column: Arc<str>, row: usize },
}

impl EmbeddedPicture {
    /// Consecutive bytes of a file.
    pub(crate) fn at(file: StoredFile, offset: u64, length: u64) -> Self {
        Self(Place::Bytes { file, offset, length })
    }

    /// One value of a binary column.
    pub(crate) fn in_table(table: ParquetFile, column: Arc<str>, row: usize) -> Self {
        Self(Place::Cell { table, column, row })
    }

    /// The file around it, for messages.
    pub fn path(&self) -> &Path {
        match &self.0 {
            Place::Bytes { file, .. } => file.path(),
            Place::Cell { table, .. } => table.path(),
        }
    }

    /// The encoded picture.
    ///
    /// # Errors
    /// [`DataError::Missing`], [`DataError::Truncated`] or [`DataError::Format`], naming the file around it.
    pub fn bytes(&self) -> Result<Vec<u8>, DataError> {
        match &self.0 {
            Place::Bytes { file, offset, length } => file.read_at(*offset, *length),
            Place::Cell { table, column, row } => table.cell(column, *row),
        }
    }
}
