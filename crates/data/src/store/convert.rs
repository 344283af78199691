//! From archives that can only be read from their start to such that can be read anywhere.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Write};
use std::path::Path;
use std::sync::Arc;

use flate2::read::MultiGzDecoder;

use super::index::Index;
use super::positional::PositionFile;
use super::tar;
use crate::DataError;

/// Unpacks a `.tar.gz` once into an uncompressed tar, which a [`Store`](super::Store) can mount. Returns the number of files in it.
///
/// The target appears whole or not at all and is never overwritten. `max_bytes` bounds it, because a few kilobytes of gzip can
/// announce and fill any disk.
///
/// # Errors
/// [`DataError::Config`] where the target exists; [`DataError::Format`] for damaged gzip data, more than `max_bytes` and everything
/// that mounting the tar would refuse; [`DataError::Missing`] and [`DataError::Io`].
pub fn index_archive(source: &Path, target: &Path, max_bytes: u64) -> Result<usize, DataError> {
    if target.exists() {
        return Err(DataError::Config(format!("the target exists already: {}", target.display())));
    }
    let io = |action, source, path: &Path| DataError::Io { action, source, path: path.to_owned() };
    let packed = File::open(source).map_err(|error| match error.kind() {
        io::ErrorKind::NotFound => DataError::Missing { what: "archive".to_owned(), path: source.to_owned() },
        _ => io("open", error, source),
    })?;
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut unpacked = tempfile::NamedTempFile::new_in(folder).map_err(|error| io("write", error, target))?;
    let mut stream = MultiGzDecoder::new(BufReader::new(packed)).take(max_bytes.saturating_add(1));
    let size = copy(&mut stream, unpacked.as_file_mut(), source, target)?;
    if size > max_bytes {
        let why = format!("it unpacks to more than the allowed {max_bytes} bytes");
        return Err(DataError::Format { format: "gzip", why, path: source.to_owned() });
    }
    let mut scanned = PositionFile::open(unpacked.path())?;
    // Whatever is wrong in the tar is wrong in the source.
    scanned.path = source.to_owned();
    let scanned = Arc::new(scanned);
    let index = Index::new(tar::FORMAT, tar::scan(&scanned)?, scanned.len, source)?;
    unpacked.persist_noclobber(target).map_err(|error| io("write", error.error, target))?;
    Ok(index.entries().len())
}

/// As [`io::copy`], but telling apart which side failed.
fn copy(from: &mut impl Read, to: &mut File, source: &Path, target: &Path) -> Result<u64, DataError> {
    let mut to = BufWriter::new(to);
    let write = |error| DataError::Io { action: "write", source: error, path: target.to_owned() };
    let mut buffer = vec![0; 1 << 16];
    let mut size = 0;
    loop {
        let count = match from.read(&mut buffer) {
            Ok(0) => break,
            Ok(count) => count,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => {
                return Err(DataError::Format { format: "gzip", why: error.to_string(), path: source.to_owned() });
            }
        };
        to.write_all(&buffer[..count]).map_err(write)?;
        size += count as u64;
    }
    to.flush().map_err(write)?;
    Ok(size)
}
