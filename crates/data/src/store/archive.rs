//! A zip or tar archive as a read-only folder.

use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Instant;

use flate2::Crc;
use flate2::read::DeflateDecoder;

use super::index::{Coding, Entry, Index};
use super::positional::{PositionFile, Window};
use super::{index_cache, tar, zip};
use crate::DataError;

/// An opened archive: its table of contents and one file handle that all threads share.
#[derive(Debug)]
pub(super) struct Archive {
    file: Arc<PositionFile>,
    index: Index,
}

/// What the first bytes of an archive say.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Zip,
    Tar,
}

impl Archive {
    /// Reads the table of contents, or takes it from the cache folder.
    ///
    /// # Errors
    /// [`DataError::Format`] for a compressed tar and whatever the readers of the formats refuse.
    pub fn open(path: &Path, cache: Option<&Path>) -> Result<Self, DataError> {
        let file = Arc::new(PositionFile::open(path)?);
        let kind = kind(&file)?;
        let start = Instant::now();
        let read = || match kind {
            Kind::Zip => zip::read_directory(&file),
            Kind::Tar => tar::scan(&file),
        };
        let entries = match cache {
            Some(folder) => index_cache::load_or_make(folder, &file, read)?,
            None => read()?,
        };
        let format = if kind == Kind::Zip { zip::FORMAT } else { tar::FORMAT };
        let index = Index::new(format, entries, file.len, path)?;
        let (files, ms) = (index.entries().len(), start.elapsed().as_millis());
        tracing::debug!(archive = %path.display(), files, ms, "mounted");
        Ok(Self { file, index })
    }

    pub fn path(&self) -> &Path {
        &self.file.path
    }

    pub fn index(&self) -> &Index {
        &self.index
    }

    /// Row and path for messages of a file.
    pub fn find(&self, name: &str) -> Option<(usize, PathBuf)> {
        self.index.find(name).map(|row| (row, self.path().join(name)))
    }

    fn entry(&self, row: usize, shown: &Path) -> Result<&Entry, DataError> {
        let missing = || DataError::Missing { what: "file".to_owned(), path: shown.to_owned() };
        self.index.entries().get(row).ok_or_else(missing)
    }

    fn data_at(&self, entry: &Entry) -> Result<u64, DataError> {
        match entry.coding {
            Coding::Raw => Ok(entry.at),
            Coding::Stored { .. } | Coding::Deflated { .. } => zip::data_at(&self.file, entry),
        }
    }

    /// All bytes, with their checksum verified where the format has one.
    pub fn bytes(&self, row: usize, shown: &Path) -> Result<Vec<u8>, DataError> {
        let entry = self.entry(row, shown)?;
        let at = self.data_at(entry)?;
        tracing::trace!(file = %shown.display(), packed = entry.packed, bytes = entry.size, "read");
        if let Coding::Deflated { .. } = entry.coding {
            let mut bytes = Vec::with_capacity(entry.size.min(entry.packed.saturating_mul(4)) as usize);
            let read = self.stream(entry, at, shown).read_to_end(&mut bytes);
            return read.map(|_| bytes).map_err(|source| read_failure(source, shown));
        }
        let bytes = self.file.bytes(at, entry.size)?;
        if let Coding::Stored { crc } = entry.coding {
            let mut sum = Crc::new();
            sum.update(&bytes);
            if sum.sum() != crc {
                return Err(DataError::Checksum { what: "entry", offset: at, path: shown.to_owned() });
            }
        }
        Ok(bytes)
    }

    pub fn size(&self, row: usize, shown: &Path) -> Result<u64, DataError> {
        Ok(self.entry(row, shown)?.size)
    }

    /// A part that lies inside the file.
    pub fn read_at(&self, row: usize, offset: u64, length: u64, shown: &Path) -> Result<Vec<u8>, DataError> {
        let entry = self.entry(row, shown)?;
        if let Coding::Deflated { .. } = entry.coding {
            let (bytes, outside) =
                (self.bytes(row, shown)?, || DataError::Truncated { offset, path: shown.to_owned() });
            let part = bytes.get(offset as usize..(offset + length) as usize).ok_or_else(outside)?;
            return Ok(part.to_vec());
        }
        self.file.bytes(self.data_at(entry)? + offset, length)
    }

    /// The bytes as a stream; a wrong checksum shows at its end.
    pub fn reader(&self, row: usize, shown: &Path) -> Result<EntryReader, DataError> {
        let entry = self.entry(row, shown)?;
        let at = self.data_at(entry)?;
        Ok(self.stream(entry, at, shown))
    }

    fn stream(&self, entry: &Entry, at: u64, shown: &Path) -> EntryReader {
        let window = Window::new(self.file.clone(), at, at + entry.packed);
        let (source, want) = match entry.coding {
            Coding::Raw => (Source::Plain(window), None),
            Coding::Stored { crc } => (Source::Plain(window), Some(crc)),
            Coding::Deflated { crc } => (Source::Deflated(Box::new(DeflateDecoder::new(window))), Some(crc)),
        };
        EntryReader { source, left: entry.size, sum: Crc::new(), want, at, path: shown.to_owned() }
    }

    /// The first bytes, at most `head`, and the last two.
    pub fn ends(&self, row: usize, head: usize, shown: &Path) -> Result<(Vec<u8>, [u8; 2]), DataError> {
        let entry = self.entry(row, shown)?;
        let mut tail = [0; 2];
        if let Coding::Deflated { .. } = entry.coding {
            let mut bytes = self.bytes(row, shown)?;
            if let Some(last) = bytes.last_chunk() {
                tail = *last;
            }
            bytes.truncate(head);
            return Ok((bytes, tail));
        }
        let at = self.data_at(entry)?;
        let first = self.file.bytes(at, entry.size.min(head as u64))?;
        if entry.size >= 2 {
            self.file.fill(&mut tail, at + entry.size - 2)?;
        }
        Ok((first, tail))
    }
}

/// By the first bytes: zip and gzip have signatures, a tar archive is what remains.
fn kind(file: &PositionFile) -> Result<Kind, DataError> {
    let head = file.bytes(0, file.len.min(4))?;
    if head.starts_with(&[0x1F, 0x8B]) {
        return Err(DataError::Format {
            format: "random-access archive",
            why: "gzip can only be read from its start: convert it once into an uncompressed tar with `index_archive`, or unpack it"
                .to_owned(),
            path: file.path.clone(),
        });
    }
    let named_zip = file.path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("zip"));
    Ok(if head.starts_with(b"PK") || named_zip { Kind::Zip } else { Kind::Tar })
}

/// An error of a stream; one of ours comes out as it went in.
pub(super) fn read_failure(source: io::Error, path: &Path) -> DataError {
    match source.downcast::<DataError>() {
        Ok(ours) => ours,
        Err(source) => DataError::Io { action: "read", source, path: path.to_owned() },
    }
}

enum Source {
    Plain(Window),
    Deflated(Box<DeflateDecoder<Window>>),
}

/// A file of an archive as a stream: never longer than announced, checked at its end.
pub(super) struct EntryReader {
    source: Source,
    left: u64,
    sum: Crc,
    /// Checksum that is still to be compared.
    want: Option<u32>,
    at: u64,
    path: PathBuf,
}

impl EntryReader {
    fn pull(&mut self, out: &mut [u8]) -> io::Result<usize> {
        match &mut self.source {
            Source::Plain(window) => window.read(out),
            Source::Deflated(decoder) => decoder.read(out).map_err(|error| match error.kind() {
                io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof => {
                    self.bad(error.to_string())
                }
                _ => error,
            }),
        }
    }

    fn bad(&self, why: String) -> io::Error {
        io::Error::other(DataError::Format { format: zip::FORMAT, why, path: self.path.clone() })
    }

    fn finish(&mut self) -> io::Result<()> {
        if let Source::Deflated(_) = self.source
            && self.pull(&mut [0])? != 0
        {
            return Err(self.bad("it inflates to more bytes than announced".to_owned()));
        }
        match self.want.take() {
            Some(want) if want != self.sum.sum() => {
                let wrong = DataError::Checksum { what: "entry", offset: self.at, path: self.path.clone() };
                Err(io::Error::other(wrong))
            }
            _ => Ok(()),
        }
    }
}

impl Read for EntryReader {
    fn read(&mut self, out: &mut [u8]) -> io::Result<usize> {
        if self.left == 0 || out.is_empty() {
            if self.left == 0 {
                self.finish()?;
            }
            return Ok(0);
        }
        let most = usize::try_from(self.left).unwrap_or(usize::MAX).min(out.len());
        let count = self.pull(&mut out[..most])?;
        if count == 0 {
            return Err(io::Error::other(DataError::Truncated { offset: self.at, path: self.path.clone() }));
        }
        self.sum.update(&out[..count]);
        self.left -= count as u64;
        Ok(count)
    }
}
