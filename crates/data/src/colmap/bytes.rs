//! Reading a packed binary file without trusting any length in it.

use std::fs::File;
use std::io::{BufReader, Cursor, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};

use crate::DataError;
use crate::store::StoredFile;

/// Names longer than this are no file names.
const LONGEST_NAME: usize = 4096;

trait Source: Read + Seek {}
impl<T: Read + Seek> Source for T {}

/// A file and where reading has come to.
pub(super) struct Bytes {
    source: Box<dyn Source>,
    at: u64,
    length: u64,
    path: PathBuf,
}

impl Bytes {
    /// Ordinary files are read piece by piece, so that skipped parts cost nothing; others come as a whole.
    pub(super) fn open(file: &StoredFile) -> Result<Self, DataError> {
        let path = file.path().to_owned();
        let Some(on_disk) = file.on_disk() else {
            let bytes = file.bytes()?;
            return Ok(Self { at: 0, length: bytes.len() as u64, source: Box::new(Cursor::new(bytes)), path });
        };
        let opened = File::open(on_disk).and_then(|file| Ok((file.metadata()?.len(), file)));
        match opened {
            Ok((length, file)) => Ok(Self { source: Box::new(BufReader::new(file)), at: 0, length, path }),
            Err(source) if source.kind() == ErrorKind::NotFound => {
                Err(DataError::Missing { what: "COLMAP file".to_owned(), path })
            }
            Err(source) => Err(DataError::Io { action: "open", source, path }),
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Position of the next byte.
    pub(super) fn at(&self) -> u64 {
        self.at
    }

    fn left(&self) -> u64 {
        self.length.saturating_sub(self.at)
    }

    /// A complaint about what stands at a byte.
    pub(super) fn format(&self, at: u64, why: impl std::fmt::Display) -> DataError {
        DataError::Format { format: "COLMAP", why: format!("{why}, at byte {at}"), path: self.path.clone() }
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DataError> {
        let mut bytes = [0; N];
        if self.left() < N as u64 {
            return Err(DataError::Truncated { offset: self.length, path: self.path.clone() });
        }
        self.source.read_exact(&mut bytes).map_err(|source| self.io(source))?;
        self.at += N as u64;
        Ok(bytes)
    }

    fn io(&self, source: std::io::Error) -> DataError {
        let path = self.path.clone();
        match source.kind() {
            ErrorKind::UnexpectedEof => DataError::Truncated { offset: self.at, path },
            _ => DataError::Io { action: "read", source, path },
        }
    }

    pub(super) fn u8s<const N: usize>(&mut self) -> Result<[u8; N], DataError> {
        self.array()
    }

    pub(super) fn u32(&mut self) -> Result<u32, DataError> {
        Ok(u32::from_le_bytes(self.array()?))
    }

    pub(super) fn i32(&mut self) -> Result<i32, DataError> {
        Ok(i32::from_le_bytes(self.array()?))
    }

    pub(super) fn u64(&mut self) -> Result<u64, DataError> {
        Ok(u64::from_le_bytes(self.array()?))
    }

    pub(super) fn f64(&mut self) -> Result<f64, DataError> {
        Ok(f64::from_le_bytes(self.array()?))
    }

    pub(super) fn f64s<const N: usize>(&mut self) -> Result<[f64; N], DataError> {
        let mut numbers = [0.0; N];
        for number in &mut numbers {
            *number = self.f64()?;
        }
        Ok(numbers)
    }

    /// A number of records of at least `smallest` bytes each, which must fit into what is left: it may then size an allocation.
    pub(super) fn count(&mut self, what: &str, smallest: u64) -> Result<usize, DataError> {
        let at = self.at;
        let count = self.u64()?;
        if count > self.left() / smallest {
            let left = self.left();
            return Err(self.format(at, format_args!("{count} {what} are announced and {left} bytes follow")));
        }
        usize::try_from(count).map_err(|_| self.format(at, format_args!("{count} {what} are too many")))
    }

    /// Passes over records whose number [`Bytes::count`] has checked.
    pub(super) fn skip(&mut self, count: usize, size: u64) -> Result<(), DataError> {
        let bytes = (count as u64).saturating_mul(size);
        let step = i64::try_from(bytes).ok().filter(|_| bytes <= self.left());
        let Some(step) = step else {
            return Err(DataError::Truncated { offset: self.length, path: self.path.clone() });
        };
        self.source.seek_relative(step).map_err(|source| self.io(source))?;
        self.at += bytes;
        Ok(())
    }

    /// Text up to a NUL.
    pub(super) fn name(&mut self) -> Result<String, DataError> {
        let at = self.at;
        let mut text = Vec::new();
        loop {
            match self.array::<1>()? {
                [0] => break,
                [byte] if text.len() < LONGEST_NAME => text.push(byte),
                _ => return Err(self.format(at, format_args!("a name is longer than {LONGEST_NAME} bytes"))),
            }
        }
        String::from_utf8(text).map_err(|_| self.format(at, "a name is not UTF-8"))
    }

    /// Nothing may follow the last record.
    pub(super) fn finish(&self) -> Result<(), DataError> {
        match self.left() {
            0 => Ok(()),
            left => Err(self.format(self.at, format_args!("{left} bytes follow the last record"))),
        }
    }
}
