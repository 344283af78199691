//! The files of an uncompressed tar archive, found in one pass over its headers.

use std::sync::Arc;

use ::tar::EntryType;

use super::index::{Coding, Entry, entry_name};
use super::positional::{PositionFile, Window};
use crate::DataError;

pub(super) const FORMAT: &str = "tar";

/// Walks from header to header; contents are skipped, not read. Long names and sizes of the GNU and pax forms are understood.
///
/// # Errors
/// [`DataError::Format`] for wrong checksums and for links, devices and sparse files; [`DataError::Truncated`];
/// [`DataError::UnsafePath`].
pub(super) fn scan(file: &Arc<PositionFile>) -> Result<Vec<Entry>, DataError> {
    let path = &file.path;
    let bad = |why: String| DataError::Format { format: FORMAT, why, path: path.clone() };
    let mut archive = ::tar::Archive::new(Window::new(file.clone(), 0, file.len));
    let mut entries = Vec::new();
    let mut last = 0;
    for found in archive.entries_with_seek().map_err(|error| bad(error.to_string()))? {
        let found = found.map_err(|error| bad(format!("{error}, behind byte {last}")))?;
        last = found.raw_header_position();
        let bytes = found.path_bytes();
        let kind = found.header().entry_type();
        if kind == EntryType::XGlobalHeader {
            continue;
        }
        let name = entry_name(FORMAT, &bytes, path)?;
        // Before ustar, a folder was an ordinary entry whose name ends with a slash.
        if kind == EntryType::Directory || kind == EntryType::Regular && bytes.ends_with(b"/") {
            continue;
        }
        let shown = String::from_utf8_lossy(&bytes);
        if kind != EntryType::Regular {
            return Err(bad(format!("the entry {shown:?} is neither a file nor a folder, but {kind:?}")));
        }
        let name = name.ok_or_else(|| bad(format!("the entry {shown:?} has no name")))?;
        let (at, size) = (found.raw_file_position(), found.size());
        if at.checked_add(size).is_none_or(|end| end > file.len) {
            return Err(DataError::Truncated { offset: file.len, path: path.clone() });
        }
        entries.push(Entry { name, at, packed: size, size, coding: Coding::Raw });
    }
    Ok(entries)
}
