//! Tables of contents kept between runs, for archives with millions of entries. Only in a folder the user names.

use std::fmt::Write as _;
use std::io::Write as _;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::index::Entry;
use super::positional::PositionFile;
use crate::DataError;

/// Begins every key: another form of the rows is another key.
const VERSION: &str = "rigscape archive index 1";
/// Bytes of both ends that enter the key.
const END: u64 = 64 * 1024;

/// The entries kept for exactly this archive (size, time of change, first and last 64 kB), else those that `make` finds, which are
/// then kept. A kept file that is damaged is made anew.
///
/// # Errors
/// Whatever `make` returns; [`DataError::Io`] for a folder that cannot be written.
pub(super) fn load_or_make(
    folder: &Path,
    archive: &PositionFile,
    make: impl FnOnce() -> Result<Vec<Entry>, DataError>,
) -> Result<Vec<Entry>, DataError> {
    let path = folder.join(format!("{}.json", key(archive)?));
    let io = |action, source| DataError::Io { action, source, path: path.clone() };
    match std::fs::read(&path) {
        Ok(kept) => match parse(&kept) {
            Some(entries) => return Ok(entries),
            None => tracing::warn!("a damaged archive index is made anew: {}", path.display()),
        },
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {}
        Err(error) => return Err(io("read", error)),
    }
    let entries = make()?;
    std::fs::create_dir_all(folder).map_err(|error| io("create", error))?;
    let rows = serde_json::to_vec(&entries).map_err(|error| io("write", error.into()))?;
    let mut file = tempfile::NamedTempFile::new_in(folder).map_err(|error| io("write", error))?;
    let written = file.write_all(hex(Sha256::digest(&rows)).as_bytes()).and_then(|()| file.write_all(&rows));
    written.map_err(|error| io("write", error))?;
    file.persist(&path).map_err(|error| io("write", error.error))?;
    Ok(entries)
}

/// The sum of the rows in 64 hex digits, then the rows.
fn parse(kept: &[u8]) -> Option<Vec<Entry>> {
    let (sum, rows) = kept.split_at_checked(64)?;
    if hex(Sha256::digest(rows)).as_bytes() != sum {
        return None;
    }
    serde_json::from_slice(rows).ok()
}

fn key(archive: &PositionFile) -> Result<String, DataError> {
    let (secs, nanos) = archive.modified().map_err(|source| DataError::Io {
        action: "read the time of",
        source,
        path: archive.path.clone(),
    })?;
    let end = archive.len.min(END);
    let mut sum = Sha256::new();
    sum.update(VERSION);
    sum.update(archive.len.to_le_bytes());
    sum.update(secs.to_le_bytes());
    sum.update(nanos.to_le_bytes());
    sum.update(archive.bytes(0, end)?);
    sum.update(archive.bytes(archive.len - end, end)?);
    Ok(hex(sum.finalize()))
}

fn hex(bytes: impl AsRef<[u8]>) -> String {
    bytes.as_ref().iter().fold(String::new(), |mut text, byte| {
        // Writing into a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}
