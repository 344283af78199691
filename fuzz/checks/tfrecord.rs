//! Any bytes are refused or are exactly the records they give. A first byte below 128 mends the checksums of lengths and payloads
//! first, so that mutations get past them.

use std::path::PathBuf;
use std::sync::LazyLock;

use data::store::StoredFile;
use data::tfrecord::{RecordSpan, index, masked_crc32c, payload};
use tempfile::NamedTempFile;

/// Length and its checksum.
const HEADER: usize = 12;
/// Bytes of each payload to look at while indexing.
const PEEK: u64 = 16;

/// The reader reads files, so the bytes go through one.
static SCRATCH: LazyLock<NamedTempFile> = LazyLock::new(|| NamedTempFile::new().expect("a writable folder"));

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    let Some((mode, bytes)) = bytes.split_first() else { return };
    let mut bytes = bytes.to_vec();
    if *mode < 128 {
        mend(&mut bytes);
    }
    std::fs::write(SCRATCH.path(), &bytes).expect("a writable folder");
    let file = StoredFile::from(PathBuf::from(SCRATCH.path()));
    let mut spans: Vec<RecordSpan> = Vec::new();
    let indexed = index(&file, PEEK, |span, peeked| {
        let whole = &bytes[span.offset as usize..][..span.length as usize];
        assert_eq!(peeked, &whole[..span.length.min(PEEK) as usize]);
        spans.push(span);
        Ok(())
    });
    let mut size = 0;
    for span in &spans {
        size += HEADER + span.length as usize + 4;
        if let Ok(payload) = payload(&file, *span) {
            assert_eq!(payload, bytes[span.offset as usize..][..span.length as usize]);
        }
    }
    // An accepted file has no byte outside its records.
    assert!(indexed.is_err() || size == bytes.len());
}

/// Sets the checksums of every record that fits.
fn mend(bytes: &mut [u8]) {
    let mut rest = bytes;
    while rest.len() >= HEADER + 4 {
        let length: [u8; 8] = rest[..8].try_into().expect("eight bytes");
        rest[8..HEADER].copy_from_slice(&masked_crc32c(&length).to_le_bytes());
        let Ok(length) = usize::try_from(u64::from_le_bytes(length)) else { return };
        if length > rest.len() - HEADER - 4 {
            return;
        }
        let end = HEADER + length;
        let checksum = masked_crc32c(&rest[HEADER..end]).to_le_bytes();
        rest[end..end + 4].copy_from_slice(&checksum);
        rest = &mut rest[end + 4..];
    }
}
