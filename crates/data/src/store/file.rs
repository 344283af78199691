//! One file below a store, wherever it lies.

use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::archive::{Archive, read_failure};
use crate::DataError;

/// A file below a [`Store`]; holds no bytes and no file handle of its own. Ordered and compared by its path.
#[derive(Debug, Clone)]
pub struct StoredFile {
    pub(super) path: PathBuf,
    pub(super) place: Place,
}

#[derive(Debug, Clone)]
pub(super) enum Place {
    Disk,
    Entry {
        archive: Arc<Archive>,
        /// Row of its table of contents.
        row: usize,
    },
    /// In none of this many roots.
    Nowhere(usize),
}

impl StoredFile {
    /// Its path, for messages only; that of an archive is followed by the name inside it.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its path when it is an ordinary file, for libraries that open files themselves (SQLite, memory maps).
    pub fn on_disk(&self) -> Option<&Path> {
        matches!(self.place, Place::Disk).then_some(&self.path)
    }

    /// All bytes.
    ///
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`]; from archives also [`DataError::Checksum`], [`DataError::Format`] and
    /// [`DataError::Truncated`].
    pub fn bytes(&self) -> Result<Vec<u8>, DataError> {
        match &self.place {
            Place::Disk => std::fs::read(&self.path).map_err(|source| self.failure("read", source)),
            Place::Entry { archive, row } => archive.bytes(*row, &self.path),
            Place::Nowhere(roots) => Err(missing("file", *roots, self.path.clone())),
        }
    }

    /// The bytes as a stream, for files too large to hold. Its errors become ours by [`StoredFile::read_failure`]; a wrong checksum shows
    /// when the end is read.
    ///
    /// # Errors
    /// As [`StoredFile::bytes`].
    pub fn reader(&self) -> Result<Box<dyn Read + Send>, DataError> {
        match &self.place {
            Place::Disk => {
                let file = std::fs::File::open(&self.path).map_err(|source| self.failure("open", source))?;
                Ok(Box::new(file))
            }
            Place::Entry { archive, row } => Ok(Box::new(archive.reader(*row, &self.path)?)),
            Place::Nowhere(roots) => Err(missing("file", *roots, self.path.clone())),
        }
    }

    /// What an error of [`StoredFile::reader`]'s stream means.
    pub fn read_failure(&self, source: std::io::Error) -> DataError {
        read_failure(source, &self.path)
    }

    /// Number of bytes.
    ///
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`].
    pub fn size(&self) -> Result<u64, DataError> {
        match &self.place {
            Place::Disk => Ok(std::fs::metadata(&self.path).map_err(|source| self.failure("look at", source))?.len()),
            Place::Entry { archive, row } => archive.size(*row, &self.path),
            Place::Nowhere(roots) => Err(missing("file", *roots, self.path.clone())),
        }
    }

    /// Exactly `length` bytes from `offset`. Memory is reserved for bytes that exist only. Checksums of archives cover whole files and
    /// are not looked at; a deflated file is inflated from its start at every call.
    ///
    /// # Errors
    /// [`DataError::Truncated`] where the file ends before, else as [`StoredFile::bytes`].
    pub fn read_at(&self, offset: u64, length: u64) -> Result<Vec<u8>, DataError> {
        let size = self.size()?;
        let inside = offset.checked_add(length).is_some_and(|end| end <= size);
        if !inside {
            return Err(DataError::Truncated { offset: size, path: self.path.clone() });
        }
        match &self.place {
            Place::Disk => self.read_at_on_disk(offset, length),
            Place::Entry { archive, row } => archive.read_at(*row, offset, length, &self.path),
            Place::Nowhere(roots) => Err(missing("file", *roots, self.path.clone())),
        }
    }

    fn read_at_on_disk(&self, offset: u64, length: u64) -> Result<Vec<u8>, DataError> {
        let mut file = std::fs::File::open(&self.path).map_err(|source| self.failure("open", source))?;
        file.seek(SeekFrom::Start(offset)).map_err(|source| self.failure("read", source))?;
        let mut bytes = Vec::new();
        file.take(length).read_to_end(&mut bytes).map_err(|source| self.failure("read", source))?;
        if bytes.len() as u64 != length {
            return Err(DataError::Truncated { offset: offset + bytes.len() as u64, path: self.path.clone() });
        }
        Ok(bytes)
    }

    /// The first bytes, at most `head`, and the last two, for a look at a picture without reading it.
    ///
    /// # Errors
    /// As [`StoredFile::bytes`].
    pub fn ends(&self, head: usize) -> Result<(Vec<u8>, [u8; 2]), DataError> {
        match &self.place {
            Place::Disk => self.ends_on_disk(head),
            Place::Entry { archive, row } => archive.ends(*row, head, &self.path),
            Place::Nowhere(roots) => Err(missing("file", *roots, self.path.clone())),
        }
    }

    fn ends_on_disk(&self, head: usize) -> Result<(Vec<u8>, [u8; 2]), DataError> {
        let io = |source| DataError::Io { action: "read", source, path: self.path.clone() };
        let mut file = std::fs::File::open(&self.path).map_err(|source| self.failure("open", source))?;
        let mut first = Vec::new();
        file.by_ref().take(head as u64).read_to_end(&mut first).map_err(io)?;
        let mut tail = [0u8; 2];
        if file.seek(SeekFrom::End(0)).map_err(io)? >= 2 {
            file.seek(SeekFrom::End(-2)).map_err(io)?;
            file.read_exact(&mut tail).map_err(io)?;
        }
        Ok((first, tail))
    }

    fn failure(&self, action: &'static str, source: std::io::Error) -> DataError {
        let path = self.path.clone();
        match source.kind() {
            ErrorKind::NotFound | ErrorKind::NotADirectory => DataError::Missing { what: "file".to_owned(), path },
            _ => DataError::Io { action, source, path },
        }
    }
}

pub(super) fn missing(what: &str, roots: usize, path: PathBuf) -> DataError {
    let what = if roots > 1 { format!("{what} (in all of the {roots} roots)") } else { what.to_owned() };
    DataError::Missing { what, path }
}

impl From<PathBuf> for StoredFile {
    fn from(path: PathBuf) -> Self {
        Self { path, place: Place::Disk }
    }
}

impl PartialEq for StoredFile {
    fn eq(&self, other: &Self) -> bool {
        self.path == other.path
    }
}

impl Eq for StoredFile {}

impl Hash for StoredFile {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.path.hash(state);
    }
}

impl PartialOrd for StoredFile {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for StoredFile {
    fn cmp(&self, other: &Self) -> Ordering {
        self.path.cmp(&other.path)
    }
}

impl fmt::Display for StoredFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}
