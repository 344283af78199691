//! The zip archive of torch 1.6 and later: `<name>/data.pkl`, `<name>/data/<key>` per storage, all stored without compression.

use std::fs::File;
use std::io::Read;

use zip::read::ZipArchive;
use zip::result::ZipError;
use zip::{CompressionMethod, read::ZipFile};

use super::{LIMITS, Storage, Storages};
use crate::weights::TorchFault;

const PICKLE: &str = "data.pkl";

/// The pickle and the storages. Stored entries cannot be larger than the file, so nothing in it can unfold.
pub(super) fn read(file: &File, file_bytes: u64) -> Result<(Vec<u8>, Storages), TorchFault> {
    let mut archive = ZipArchive::new(file).map_err(damaged)?;
    if archive.has_duplicate_names() {
        return Err(refused("two entries of the archive have one name"));
    }
    if archive.has_overlapping_entries().map_err(damaged)? {
        return Err(refused("entries of the archive overlap"));
    }
    if archive.file_names_raw().any(|name| name.ends_with(b"/constants.pkl")) {
        return Err(refused("a TorchScript program; load it in PyTorch and save its state_dict()"));
    }
    let mut ranges = Vec::with_capacity(archive.len());
    for index in 0..archive.len() {
        let entry = archive.by_index_raw(index).map_err(damaged)?;
        if let Some(range) = stored_range(&entry, file_bytes)? {
            ranges.push(range);
        }
    }
    let root = root_of(&ranges)?;
    let order_name = format!("{root}byteorder");
    if ranges.iter().any(|(name, _)| *name == order_name) && bytes_of(&mut archive, &order_name, 16)? != b"little" {
        return Err(refused("big-endian values; save the weights on a little-endian machine"));
    }
    let pickle = bytes_of(&mut archive, &format!("{root}{PICKLE}"), LIMITS.max_bytes)?;
    let data = format!("{root}data/");
    let storages = ranges.into_iter().filter_map(|(name, range)| Some((name.strip_prefix(&data)?.to_owned(), range)));
    Ok((pickle, storages.collect()))
}

fn damaged(error: ZipError) -> TorchFault {
    TorchFault::Container(format!("zip archive: {error}"))
}

fn refused(reason: &str) -> TorchFault {
    TorchFault::Container(reason.to_owned())
}

/// Name and bytes of an entry; none for folders.
fn stored_range<R: Read>(entry: &ZipFile<'_, R>, file_bytes: u64) -> Result<Option<(String, Storage)>, TorchFault> {
    let name = entry.name().map_err(damaged)?.into_owned();
    if name.ends_with('/') {
        return Ok(None);
    }
    let wrong = |reason: &str| TorchFault::Container(format!("entry {name} {reason}"));
    if entry.compression() != CompressionMethod::Stored || entry.size() != entry.compressed_size() {
        return Err(wrong("is compressed, which torch.save never does; pack the archive without compression"));
    }
    if entry.encrypted() {
        return Err(wrong("is encrypted"));
    }
    let start = entry.data_start().ok_or_else(|| wrong("has no data"))?;
    let bytes = entry.size();
    if start.checked_add(bytes).is_none_or(|end| end > file_bytes) {
        return Err(wrong("ends behind the file"));
    }
    Ok(Some((name, Storage { start, bytes })))
}

/// What stands before `data.pkl` in all names.
fn root_of(ranges: &[(String, Storage)]) -> Result<String, TorchFault> {
    let roots = ranges.iter().filter_map(|(name, _)| {
        let root = name.strip_suffix(PICKLE)?;
        (root.is_empty() || root.ends_with('/')).then_some(root)
    });
    match roots.collect::<Vec<_>>().as_slice() {
        [root] => Ok((*root).to_owned()),
        [] => Err(refused("a zip archive without data.pkl, so torch.save did not write it")),
        _ => Err(refused("more than one data.pkl")),
    }
}

fn bytes_of(archive: &mut ZipArchive<&File>, name: &str, limit: usize) -> Result<Vec<u8>, TorchFault> {
    let entry = archive.by_name(name).map_err(damaged)?;
    if entry.size() > limit as u64 {
        return Err(TorchFault::Container(format!("{name} has {} bytes, at most {limit} are read", entry.size())));
    }
    let mut bytes = Vec::with_capacity(entry.size() as usize);
    let read = entry.take(limit as u64).read_to_end(&mut bytes);
    read.map_err(|error| TorchFault::Container(format!("{name}: {error}")))?;
    Ok(bytes)
}
