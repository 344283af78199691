//! Arrow IPC files, opened with distrust: every announced length is checked against the bytes that are there before Arrow sees it.

use std::sync::Arc;

use arrow_array::RecordBatch;
use arrow_buffer::Buffer;
use arrow_ipc::convert::try_fb_to_schema;
use arrow_ipc::reader::{FileDecoder, read_footer_length};
use arrow_ipc::{Block, Message, MessageHeader, root_as_footer, root_as_message};
use arrow_schema::{ArrowError, Schema};

/// Bytes behind the footer: its length and the magic.
const TRAILER: usize = 10;
/// LZ4 needs at least one byte for 255 bytes of output; anything beyond is a lie about the length.
const MOST_PER_BYTE: i64 = 255;
/// A continuation marker and a length stand before every message.
const PREFIX: usize = 8;

/// Arrow asserts what it believes it has checked (a column of offsets whose unpacked size is no multiple of theirs ends in a panic), and
/// unpacked sizes are known only to its decoder. A file must not be able to end the program.
pub(super) fn guarded<T>(decode: impl FnOnce() -> Result<T, ArrowError>) -> Result<T, ArrowError> {
    let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(decode));
    outcome.unwrap_or_else(|_| Err(broken("the decoder found its parts at odds with each other")))
}

/// Where a message lies in the file, and whether it is a dictionary.
pub(super) type Blocks = Vec<(Block, bool)>;

fn broken(why: &str) -> ArrowError {
    ArrowError::IpcError(why.to_owned())
}

pub(super) fn open(bytes: &Buffer) -> Result<(Arc<Schema>, FileDecoder, Blocks), ArrowError> {
    let end = bytes.len().checked_sub(TRAILER).ok_or_else(|| broken("the file is too short"))?;
    let trailer = bytes.get(end..).and_then(|tail| tail.try_into().ok()).ok_or_else(|| broken("no footer"))?;
    let start = end.checked_sub(read_footer_length(trailer)?).ok_or_else(|| broken("the footer is cut"))?;
    let footer = bytes.get(start..end).ok_or_else(|| broken("the footer is cut"))?;
    let footer = root_as_footer(footer).map_err(|error| broken(&error.to_string()))?;
    let schema = footer.schema().ok_or_else(|| broken("there is no schema"))?;
    if !schema.endianness().equals_to_target_endianness() {
        return Err(broken("the numbers have the other byte order"));
    }
    let schema = Arc::new(try_fb_to_schema(schema)?);
    let dictionaries = footer.dictionaries().into_iter().flatten().map(|block| (*block, true));
    let batches = footer.recordBatches().into_iter().flatten().map(|block| (*block, false));
    let blocks = dictionaries.chain(batches).collect();
    let decoder = FileDecoder::new(schema.clone(), footer.version());
    Ok((schema, decoder, blocks))
}

pub(super) fn decode(
    bytes: &Buffer,
    decoder: &mut FileDecoder,
    blocks: &Blocks,
) -> Result<Vec<RecordBatch>, ArrowError> {
    let mut batches = Vec::new();
    for (block, is_dictionary) in blocks {
        let data = checked_block(bytes, block)?;
        if *is_dictionary {
            decoder.read_dictionary(block, &data)?;
        } else if let Some(batch) = decoder.read_record_batch(block, &data)? {
            batches.push(batch);
        }
    }
    Ok(batches)
}

/// The bytes of a message and its body, once every length in it is known to be true.
fn checked_block(bytes: &Buffer, block: &Block) -> Result<Buffer, ArrowError> {
    let cut = || broken("a record batch lies outside the file");
    let offset = usize::try_from(block.offset()).map_err(|_| cut())?;
    let head = usize::try_from(block.metaDataLength()).map_err(|_| cut())?;
    let body = usize::try_from(block.bodyLength()).map_err(|_| cut())?;
    let length = head.checked_add(body).ok_or_else(cut)?;
    let end = offset.checked_add(length).filter(|end| *end <= bytes.len()).ok_or_else(cut)?;
    let all = bytes.get(offset..end).ok_or_else(cut)?;
    let (head, body) = all.split_at_checked(head).filter(|(head, _)| head.len() > PREFIX).ok_or_else(cut)?;
    let marked = head.starts_with(&[0xFF; 4]);
    let message = head.get(if marked { PREFIX } else { PREFIX / 2 }..).ok_or_else(cut)?;
    let message = root_as_message(message).map_err(|error| broken(&error.to_string()))?;
    check_message(&message, body)?;
    Ok(bytes.slice_with_length(offset, length))
}

fn check_message(message: &Message<'_>, body: &[u8]) -> Result<(), ArrowError> {
    let batch = match message.header_type() {
        MessageHeader::RecordBatch => message.header_as_record_batch(),
        MessageHeader::DictionaryBatch => message.header_as_dictionary_batch().and_then(|batch| batch.data()),
        _ => None,
    };
    let batch = batch.ok_or_else(|| broken("a message is no record batch"))?;
    let compressed = batch.compression().is_some();
    let mut most_bytes: i64 = 0;
    for buffer in batch.buffers().into_iter().flatten() {
        let cut = || broken("a buffer lies outside its record batch");
        let offset = usize::try_from(buffer.offset()).map_err(|_| cut())?;
        let length = usize::try_from(buffer.length()).map_err(|_| cut())?;
        let end = offset.checked_add(length).ok_or_else(cut)?;
        let data = body.get(offset..end).ok_or_else(cut)?;
        let size = if compressed && !data.is_empty() { announced(data)? } else { buffer.length() };
        most_bytes = most_bytes.saturating_add(size);
    }
    // One bit per row is the least that any column takes.
    let most_rows = most_bytes.saturating_mul(8);
    let sound = |rows: i64, nulls: i64| (0..=most_rows).contains(&rows) && (0..=rows).contains(&nulls);
    let nodes = batch.nodes().into_iter().flatten();
    if !sound(batch.length(), 0) || nodes.into_iter().any(|node| !sound(node.length(), node.null_count())) {
        return Err(broken("a record batch announces more rows than it holds"));
    }
    Ok(())
}

/// The size of a compressed buffer as it announces it, refused where no compression reaches it.
fn announced(data: &[u8]) -> Result<i64, ArrowError> {
    let size = data.first_chunk::<8>().map(|size| i64::from_le_bytes(*size));
    let size = size.ok_or_else(|| broken("a compressed buffer is cut"))?;
    let stored = (data.len() - 8) as i64;
    match size {
        -1 => Ok(stored),
        0.. if size <= stored.saturating_mul(MOST_PER_BYTE) => Ok(size),
        _ => Err(broken("a compressed buffer announces an impossible size")),
    }
}
