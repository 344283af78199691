//! The format before torch 1.6: pickles of a magic number, a version, the writer's machine, the objects and the list of storage
//! keys, then per key the number of elements (u64) and the values.

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};

use pickle::{Graph, Object, decode_objects};

use super::state_dict::StorageId;
use super::{LIMITS, Storage, Storages};
use crate::weights::TorchFault;

/// The magic number 0x1950a86a20f9469cfc6c as protocol 2 pickles it; the second byte is the protocol.
pub(super) const START: [u8; 14] = [0x80, 2, 0x8A, 10, 0x6C, 0xFC, 0x9C, 0x46, 0xF9, 0x20, 0x6A, 0xA8, 0x50, 0x19];

const VERSION: i64 = 1001;

/// Later protocols put a frame before the number, so only its digits are looked for.
pub(super) fn is_start(bytes: &[u8]) -> bool {
    bytes == START
}

/// What stands before the storages.
#[derive(Debug)]
pub(super) struct Parsed<'b> {
    pub graph: Graph<'b>,
    keys: Vec<String>,
    /// Where the first storage begins.
    end: usize,
}

fn refused(reason: impl Into<String>) -> TorchFault {
    TorchFault::Container(reason.into())
}

/// Decodes the five pickles; the storages may lie behind what `head` holds.
pub(super) fn parse(head: &[u8]) -> Result<Parsed<'_>, TorchFault> {
    let mut at = 0;
    let mut next = || -> Result<Graph<'_>, TorchFault> {
        let (graph, taken) = decode_objects(head.get(at..).unwrap_or_default(), LIMITS)?;
        at += taken;
        Ok(graph)
    };
    next()?;
    let version = next()?.root().integer();
    if version != Some(VERSION) {
        return Err(refused(format!("version {version:?} of the format, known is {VERSION}")));
    }
    if next()?.root().get("little_endian").and_then(Object::truth) != Some(true) {
        return Err(refused("big-endian values; save the weights on a little-endian machine"));
    }
    let graph = next()?;
    let list = next()?;
    let keys = list.root().items().unwrap_or_default();
    let keys = keys.into_iter().map(|key| key.text().map(str::to_owned)).collect::<Option<Vec<_>>>();
    Ok(Parsed { graph, keys: keys.ok_or_else(|| refused("a storage key that is no text"))?, end: at })
}

/// Walks the storages in the order of their keys.
pub(super) fn storages(file: &mut File, file_bytes: u64, parsed: &Parsed<'_>) -> Result<Storages, TorchFault> {
    let mut widths = std::collections::BTreeMap::new();
    for id in parsed.graph.persistent_ids() {
        if let Some(id) = StorageId::read(id) {
            widths.insert(id.key, id.width);
        }
    }
    let mut at = parsed.end as u64;
    let mut storages = Storages::new();
    for key in &parsed.keys {
        let width = widths.get(key.as_str()).copied();
        let width = width.ok_or_else(|| refused(format!("storage {key} has no known element type")))?;
        let mut count = [0; 8];
        let read = file.seek(SeekFrom::Start(at)).and_then(|_| file.read_exact(&mut count));
        read.map_err(|error| refused(format!("storage {key}: {error}")))?;
        let start = at + 8;
        let bytes = u64::from_le_bytes(count).checked_mul(width as u64);
        let bytes = bytes.filter(|bytes| start.checked_add(*bytes).is_some_and(|end| end <= file_bytes));
        let bytes = bytes.ok_or_else(|| refused(format!("storage {key} ends behind the file")))?;
        if storages.insert(key.clone(), Storage { start, bytes }).is_some() {
            return Err(refused(format!("storage {key} is listed twice")));
        }
        at = start + bytes;
    }
    if at != file_bytes {
        return Err(refused(format!("{} bytes behind the last storage", file_bytes - at)));
    }
    Ok(storages)
}
