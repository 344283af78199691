//! TFRecord containers: an index from one pass over the record headers, records by position afterwards.
//!
//! A record is its length (u64, little endian), the masked CRC-32C of those eight bytes, the payload, and the masked CRC-32C of the
//! payload. See the comment at the top of TensorFlow's `record_writer.h`.

use prost::bytes::Bytes;

use crate::DataError;
use crate::store::StoredFile;

/// Length and its checksum.
const HEADER: u64 = 12;
/// Checksum behind the payload.
const FOOTER: u64 = 4;

/// Where a record's payload lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RecordSpan {
    /// First byte of the payload.
    pub offset: u64,
    /// Bytes of the payload.
    pub length: u64,
}

/// Visits the records in order without reading their payloads, except for the first `peek` bytes of each. Those are not checked: the
/// checksum covers a whole payload.
///
/// # Errors
/// [`DataError::Checksum`] for a wrong length, [`DataError::Truncated`] for a file that ends inside a record, and what `each` returns.
pub fn index(
    file: &StoredFile,
    peek: u64,
    mut each: impl FnMut(RecordSpan, &[u8]) -> Result<(), DataError>,
) -> Result<(), DataError> {
    let size = file.size()?;
    let mut start = 0;
    while start < size {
        let left = size - start;
        let head = file.read_at(start, left.min(HEADER + peek))?;
        let truncated = || DataError::Truncated { offset: size, path: file.path().to_owned() };
        let (length, rest) = head.split_first_chunk::<8>().ok_or_else(truncated)?;
        let (checksum, rest) = rest.split_first_chunk::<4>().ok_or_else(truncated)?;
        if masked_crc32c(length) != u32::from_le_bytes(*checksum) {
            return Err(DataError::Checksum { what: "record length", offset: start, path: file.path().to_owned() });
        }
        let length = u64::from_le_bytes(*length);
        if left.checked_sub(HEADER + FOOTER).is_none_or(|most| length > most) {
            return Err(truncated());
        }
        let peeked = rest.get(..length.min(peek) as usize).unwrap_or(rest);
        each(RecordSpan { offset: start + HEADER, length }, peeked)?;
        start += HEADER + length + FOOTER;
    }
    Ok(())
}

/// A record's payload, checked.
///
/// # Errors
/// [`DataError::Checksum`], [`DataError::Truncated`] for a file that has shrunk since it was indexed.
pub fn payload(file: &StoredFile, span: RecordSpan) -> Result<Bytes, DataError> {
    let mut bytes = Bytes::from(file.read_at(span.offset, span.length.saturating_add(FOOTER))?);
    let checksum = bytes.split_off(bytes.len().saturating_sub(FOOTER as usize));
    if masked_crc32c(&bytes).to_le_bytes() != *checksum {
        return Err(DataError::Checksum { what: "record", offset: span.offset, path: file.path().to_owned() });
    }
    Ok(bytes)
}

/// The format stores checksums rotated and shifted, so that a checksum of data that holds checksums stays meaningful.
pub fn masked_crc32c(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(0xa282_ead8)
}

#[cfg(test)]
pub(crate) mod tests;
