//! The central directory of a zip archive, read once.
//!
//! Format: PKWARE APPNOTE 6.3.10, sections 4.3 and 4.5 (zip64). Entries are stored or deflated; everything else is refused, because
//! it would only show in the middle of a run.

use std::io::{BufReader, Read};
use std::path::Path;
use std::sync::Arc;

use super::index::{Coding, Entry, entry_name};
use super::positional::{PositionFile, Window};
use crate::DataError;

pub(super) const FORMAT: &str = "zip";

/// Largest contents a deflated entry may announce. The largest table of the largest dataset inflates to 1.4 GB.
const MAX_INFLATED: u64 = 8 << 30;
/// Deflate cannot shrink further: 258 bytes by two bits.
const MAX_RATIO: u64 = 1032;
/// Encrypted, strongly encrypted, masked headers.
const ENCRYPTED: u16 = 1 | 1 << 6 | 1 << 13;

const END: [u8; 4] = *b"PK\x05\x06";
const END_64: [u8; 4] = *b"PK\x06\x06";
const LOCATOR_64: [u8; 4] = *b"PK\x06\x07";
const DIRECTORY: [u8; 4] = *b"PK\x01\x02";
const LOCAL: [u8; 4] = *b"PK\x03\x04";

fn bad(why: impl Into<String>, archive: &Path) -> DataError {
    DataError::Format { format: FORMAT, why: why.into(), path: archive.to_owned() }
}

/// Little-endian numbers of a header, one after another.
struct Fields<'b>(&'b [u8]);

impl<'b> Fields<'b> {
    fn take(&mut self, count: usize) -> Option<&'b [u8]> {
        let (head, rest) = self.0.split_at_checked(count)?;
        self.0 = rest;
        Some(head)
    }

    fn number(&mut self, bytes: usize) -> Option<u64> {
        Some(self.take(bytes)?.iter().rev().fold(0, |value, byte| value << 8 | u64::from(*byte)))
    }

    fn u16(&mut self) -> Option<u16> {
        self.number(2).map(|value| value as u16)
    }

    fn u32(&mut self) -> Option<u32> {
        self.number(4).map(|value| value as u32)
    }
}

/// Where the directory lies.
struct Directory {
    at: u64,
    size: u64,
    entries: u64,
    /// Counts of the old end record wrap at 65536.
    wraps: bool,
}

/// Reads the directory of an archive.
///
/// # Errors
/// [`DataError::Format`] for damage, encryption, unknown methods, links and impossible sizes; [`DataError::UnsafePath`].
pub(super) fn read_directory(file: &Arc<PositionFile>) -> Result<Vec<Entry>, DataError> {
    let path = &file.path;
    let directory = find_directory(file)?;
    let mut stream = BufReader::new(Window::new(file.clone(), directory.at, directory.at + directory.size));
    let (mut entries, mut count, mut left) = (Vec::new(), 0u64, directory.size);
    while left > 0 {
        let header = read_header(&mut stream).ok_or_else(|| bad("the directory ends inside an entry", path))?;
        left = left.checked_sub(header.len()).ok_or_else(|| bad("the directory ends inside an entry", path))?;
        count += 1;
        entries.extend(header.entry(directory.at, path)?);
    }
    if count != directory.entries && !(directory.wraps && count & 0xFFFF == directory.entries) {
        return Err(bad(format!("the directory holds {count} entries, not {}", directory.entries), path));
    }
    Ok(entries)
}

fn find_directory(file: &PositionFile) -> Result<Directory, DataError> {
    const END_LEN: usize = 22;
    let path = &file.path;
    let tail_len = file.len.min((END_LEN + usize::from(u16::MAX)) as u64);
    let tail = file.bytes(file.len - tail_len, tail_len)?;
    // The comment behind the record must end with the file.
    let is_end = |at: &usize| {
        let mut fields = Fields(tail.get(*at + 20..).unwrap_or_default());
        tail[*at..].starts_with(&END) && fields.u16().is_some_and(|comment| usize::from(comment) == fields.0.len())
    };
    let at = (0..(tail.len() + 1).saturating_sub(END_LEN)).rev().find(is_end);
    let at = at.ok_or_else(|| bad("there is no end record: the archive is cut or no zip", path))?;
    let end_at = file.len - tail_len + at as u64;
    let mut fields = Fields(&tail[at + 4..]);
    let old = (|| {
        let disks = [fields.u16()?, fields.u16()?];
        let counts = [fields.u16()?, fields.u16()?];
        Some((disks, counts, fields.u32()?, fields.u32()?))
    })();
    let (disks, counts, size, offset) = old.ok_or_else(|| bad("the end record is cut", path))?;
    let (directory, limit) = match end_64(file, end_at)? {
        Some(found) => found,
        None if disks != [0, 0] || counts[0] != counts[1] => return Err(bad("it is one part of several", path)),
        None => (Directory { at: offset.into(), size: size.into(), entries: counts[1].into(), wraps: true }, end_at),
    };
    if directory.at.checked_add(directory.size).is_none_or(|end| end > limit) {
        return Err(bad("the directory does not lie before its end record", path));
    }
    Ok(directory)
}

/// The directory by the zip64 end record, with that record's position, if there is one.
fn end_64(file: &PositionFile, end_at: u64) -> Result<Option<(Directory, u64)>, DataError> {
    let path = &file.path;
    let Some(locator_at) = end_at.checked_sub(20) else { return Ok(None) };
    let locator = file.bytes(locator_at, 20)?;
    if !locator.starts_with(&LOCATOR_64) {
        return Ok(None);
    }
    let record_at = Fields(&locator[8..]).number(8).unwrap_or(u64::MAX);
    if record_at.checked_add(56).is_none_or(|end| end > locator_at) {
        return Err(bad("the zip64 end record does not lie before its locator", path));
    }
    let record = file.bytes(record_at, 56)?;
    let mut fields = Fields(record.get(16..).unwrap_or_default());
    let numbers = (|| {
        let disks = [fields.u32()?, fields.u32()?];
        Some((disks, [fields.number(8)?, fields.number(8)?], fields.number(8)?, fields.number(8)?))
    })();
    match numbers.filter(|_| record.starts_with(&END_64)) {
        Some(([0, 0], [here, all], size, at)) if here == all => {
            Ok(Some((Directory { at, size, entries: all, wraps: false }, record_at)))
        }
        _ => Err(bad("the zip64 end record is damaged", path)),
    }
}

/// One directory entry as it stands in the file.
struct Header {
    fixed: [u8; 46],
    name: Vec<u8>,
    extra: Vec<u8>,
    comment: usize,
}

fn read_header(stream: &mut impl Read) -> Option<Header> {
    let mut fixed = [0u8; 46];
    stream.read_exact(&mut fixed).ok()?;
    let mut fields = Fields(&fixed[28..]);
    let lens = [fields.u16()?, fields.u16()?, fields.u16()?].map(usize::from);
    // Three 16-bit lengths: at most 196 kB.
    let mut rest = vec![0; lens.iter().sum()];
    stream.read_exact(&mut rest).ok()?;
    let extra = rest.get(lens[0]..lens[0] + lens[1])?.to_vec();
    rest.truncate(lens[0]);
    Some(Header { fixed, name: rest, extra, comment: lens[2] })
}

impl Header {
    fn len(&self) -> u64 {
        (self.fixed.len() + self.name.len() + self.extra.len() + self.comment) as u64
    }

    /// The file it describes; `None` for a folder.
    fn entry(&self, directory_at: u64, archive: &Path) -> Result<Option<Entry>, DataError> {
        let shown = String::from_utf8_lossy(&self.name);
        let refuse = |why: &str| Err(bad(format!("the entry {shown:?} {why}"), archive));
        let Some(numbers) = self.numbers() else { return refuse("has a damaged directory record") };
        let name = entry_name(FORMAT, &self.name, archive)?;
        if numbers.flags & ENCRYPTED != 0 {
            return refuse("is encrypted");
        }
        // 0: the writer set no Unix mode.
        if numbers.is_unix && !matches!(numbers.mode & 0o170_000, 0 | 0o040_000 | 0o100_000) {
            return refuse("is a link or a device");
        }
        if self.name.ends_with(b"/") {
            return Ok(None);
        }
        let Some(name) = name else { return refuse("has no name") };
        let (packed, size) = (numbers.packed, numbers.size);
        let coding = match numbers.method {
            0 if packed != size => return refuse(&format!("is stored in {packed} bytes, but announces {size}")),
            0 => Coding::Stored { crc: numbers.crc },
            8 if size > MAX_INFLATED || size > packed.saturating_mul(MAX_RATIO) => {
                return refuse(&format!("cannot hold {size} bytes in {packed} deflated ones"));
            }
            8 => Coding::Deflated { crc: numbers.crc },
            other => return refuse(&format!("has compression method {other}; only stored and deflated are read")),
        };
        let header_end = numbers.at.saturating_add(30 + self.name.len() as u64);
        if header_end.checked_add(packed).is_none_or(|end| end > directory_at) {
            return refuse("reaches beyond the archive's contents");
        }
        Ok(Some(Entry { name, at: numbers.at, packed, size, coding }))
    }

    fn numbers(&self) -> Option<Numbers> {
        let mut fields = Fields(&self.fixed);
        let signature = fields.take(4)?;
        let made_by = fields.u16()?;
        fields.u16()?;
        let (flags, method) = (fields.u16()?, fields.u16()?);
        fields.take(4)?;
        let crc = fields.u32()?;
        let (packed, size) = (fields.u32()?, fields.u32()?);
        fields.take(6)?;
        let disk = fields.u16()?;
        fields.take(2)?;
        let (attributes, at) = (fields.u32()?, fields.u32()?);
        let mut wide = Fields(self.wide_numbers());
        let mut widen = |short: u32| if short == u32::MAX { wide.number(8) } else { Some(short.into()) };
        // The wide numbers stand in this order and only for those that did not fit.
        let size = widen(size)?;
        let packed = widen(packed)?;
        let at = widen(at)?;
        let is_whole = signature == DIRECTORY && matches!(disk, 0 | u16::MAX);
        let (is_unix, mode) = (made_by >> 8 == 3, attributes >> 16);
        is_whole.then_some(Numbers { flags, method, crc, packed, size, at, is_unix, mode })
    }

    /// Contents of the zip64 field.
    fn wide_numbers(&self) -> &[u8] {
        let mut fields = Fields(&self.extra);
        while let (Some(id), Some(len)) = (fields.u16(), fields.u16()) {
            match fields.take(len.into()) {
                Some(found) if id == 1 => return found,
                Some(_) => {}
                None => break,
            }
        }
        &[]
    }
}

struct Numbers {
    flags: u16,
    method: u16,
    crc: u32,
    packed: u64,
    size: u64,
    /// Of the local header.
    at: u64,
    is_unix: bool,
    mode: u32,
}

/// Where an entry's data begins: behind the name and the extra field of its *local* header, which differ from the directory's.
///
/// # Errors
/// [`DataError::Format`] where there is no such header, or where it contradicts the directory.
pub(super) fn data_at(file: &PositionFile, entry: &Entry) -> Result<u64, DataError> {
    let header = file.bytes(entry.at, 30)?;
    let mut fields = Fields(header.get(4..).unwrap_or_default());
    let parsed = (|| {
        fields.u16()?;
        let (flags, method) = (fields.u16()?, fields.u16()?);
        fields.take(16)?;
        Some((flags, method, u64::from(fields.u16()?) + u64::from(fields.u16()?)))
    })();
    let want = if matches!(entry.coding, Coding::Deflated { .. }) { 8 } else { 0 };
    match parsed {
        Some((flags, method, lens)) if header.starts_with(&LOCAL) && method == want && flags & ENCRYPTED == 0 => {
            let at = entry.at + 30 + lens;
            if at.checked_add(entry.packed).is_some_and(|end| end <= file.len) {
                return Ok(at);
            }
            Err(DataError::Truncated { offset: file.len, path: file.path.clone() })
        }
        _ => Err(bad(format!("the local header of {:?} at byte {} is damaged", entry.name, entry.at), &file.path)),
    }
}
