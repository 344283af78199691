//! Reads at given positions of a shared file, so that threads need no lock around a seek position.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::DataError;

/// An open file that many threads read at once.
#[derive(Debug)]
pub(crate) struct PositionFile {
    file: File,
    /// Bytes when it was opened.
    pub len: u64,
    /// For messages.
    pub path: PathBuf,
}

impl PositionFile {
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let io = |source| DataError::Io { action: "open", source, path: path.to_owned() };
        let file = File::open(path).map_err(io)?;
        let len = file.metadata().map_err(io)?.len();
        Ok(Self { file, len, path: path.to_owned() })
    }

    /// Seconds and nanoseconds since 1970 of its last change.
    pub fn modified(&self) -> io::Result<(u64, u32)> {
        let since = self.file.metadata()?.modified()?.duration_since(std::time::UNIX_EPOCH);
        Ok(since.map_or((0, 0), |since| (since.as_secs(), since.subsec_nanos())))
    }

    #[cfg(unix)]
    fn read_at(&self, out: &mut [u8], at: u64) -> io::Result<usize> {
        std::os::unix::fs::FileExt::read_at(&self.file, out, at)
    }

    /// The call moves the file's cursor, which nobody uses.
    #[cfg(windows)]
    fn read_at(&self, out: &mut [u8], at: u64) -> io::Result<usize> {
        std::os::windows::fs::FileExt::seek_read(&self.file, out, at)
    }

    /// Fills the buffer.
    pub fn fill(&self, out: &mut [u8], at: u64) -> Result<(), DataError> {
        let mut done = 0;
        while done < out.len() {
            match self.read_at(&mut out[done..], at + done as u64) {
                Ok(0) => return Err(DataError::Truncated { offset: at + done as u64, path: self.path.clone() }),
                Ok(count) => done += count,
                Err(source) if source.kind() == io::ErrorKind::Interrupted => {}
                Err(source) => return Err(DataError::Io { action: "read", source, path: self.path.clone() }),
            }
        }
        Ok(())
    }

    /// A range as bytes; it is known to lie inside the file, so its size may be reserved.
    pub fn bytes(&self, at: u64, size: u64) -> Result<Vec<u8>, DataError> {
        let inside = at.checked_add(size).is_some_and(|end| end <= self.len);
        let (true, Ok(size)) = (inside, usize::try_from(size)) else {
            return Err(DataError::Truncated { offset: self.len, path: self.path.clone() });
        };
        let mut bytes = vec![0; size];
        self.fill(&mut bytes, at)?;
        Ok(bytes)
    }
}

/// A range of a shared file as a stream.
pub(super) struct Window {
    file: Arc<PositionFile>,
    at: u64,
    end: u64,
    /// Bytes that may still be read before the next seek.
    budget: u64,
}

impl Window {
    pub fn new(file: Arc<PositionFile>, at: u64, end: u64) -> Self {
        Self { file, at, end, budget: u64::MAX }
    }
}

impl Read for Window {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        let most = usize::try_from(self.end.saturating_sub(self.at)).unwrap_or(usize::MAX).min(out.len());
        let count = self.file.read_at(&mut out[..most], self.at)?;
        self.at += count as u64;
        self.budget = self.budget.checked_sub(count as u64).ok_or_else(|| {
            io::Error::new(io::ErrorKind::InvalidData, "an extended header is longer than a megabyte")
        })?;
        Ok(count)
    }
}

/// The most bytes read from one position on: headers of archives are short, whatever sizes they announce.
const MAX_HEADER: u64 = 1 << 20;

impl Seek for Window {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        let target = match to {
            SeekFrom::Start(at) => Some(at),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
            SeekFrom::End(by) => self.end.checked_add_signed(by),
        };
        self.at = target.ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "a position outside the file"))?;
        self.budget = MAX_HEADER;
        Ok(self.at)
    }
}
