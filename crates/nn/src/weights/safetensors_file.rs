//! The safetensors container. Nothing is reserved from a length in the file before that length has been compared with the
//! bytes that are really there.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::Read;
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorView};

use super::file::{Contents, Entry};
use super::{HostTensor, WeightError};

/// The format's own limit for a header (also the limit of the `safetensors` crate).
const MAX_HEADER_BYTES: u64 = 100_000_000;

/// Reads the header of a file that stands at its start.
pub(super) fn read(file: &mut File, path: &Path) -> Result<Contents, WeightError> {
    let io = |source| WeightError::Io { source, path: path.to_path_buf() };
    let header = |reason: String| WeightError::Header { reason, path: path.to_path_buf() };
    let file_bytes = file.metadata().map_err(io)?.len();
    if file_bytes < 8 {
        return Err(header(format!("{file_bytes} bytes, the length of the header alone takes 8")));
    }
    let mut prefix = [0; 8];
    file.read_exact(&mut prefix).map_err(io)?;
    let header_bytes = u64::from_le_bytes(prefix);
    if header_bytes > MAX_HEADER_BYTES || header_bytes > file_bytes - 8 {
        return Err(header(format!("header of {header_bytes} bytes announced in a file of {file_bytes}")));
    }
    let mut text = vec![0; header_bytes as usize];
    file.read_exact(&mut text).map_err(io)?;
    // Deserialising also checks that byte ranges follow each other without gaps and hold exactly their shapes.
    let parsed: Metadata = serde_json::from_slice(&text).map_err(|error| header(error.to_string()))?;
    let data_start = 8 + header_bytes;
    let expected = data_start + parsed.data_len() as u64;
    if expected != file_bytes {
        return Err(WeightError::Length { expected, found: file_bytes, path: path.to_path_buf() });
    }
    let entry = |info: &safetensors::tensor::TensorInfo| Entry {
        dtype: info.dtype,
        shape: info.shape.clone(),
        start: data_start + info.data_offsets.0 as u64,
        span: info.shape.iter().product(),
        strides: None,
    };
    let tensors: BTreeMap<String, Entry> =
        parsed.tensors().into_iter().map(|(name, info)| (name, entry(info))).collect();
    let mut order: Vec<(u64, String)> = tensors.iter().map(|(name, entry)| (entry.start, name.clone())).collect();
    order.sort();
    Ok(Contents {
        tensors,
        order: order.into_iter().map(|(_, name)| name).collect(),
        metadata: parsed.metadata().clone().unwrap_or_default().into_iter().collect(),
        others: Vec::new(),
    })
}

/// Writes f32 tensors and text entries. The file appears under its name only when it is complete.
///
/// # Errors
/// [`WeightError::Write`] for a name given twice or a header beyond the format's limit, [`WeightError::Io`].
pub fn write_safetensors(
    path: impl AsRef<Path>,
    tensors: &[(String, HostTensor)],
    metadata: &BTreeMap<String, String>,
) -> Result<(), WeightError> {
    let path = path.as_ref();
    let refuse = |reason: String| WeightError::Write { reason, path: path.to_path_buf() };
    let bytes: Vec<Vec<u8>> =
        tensors.iter().map(|(_, tensor)| tensor.data.iter().flat_map(|value| value.to_le_bytes()).collect()).collect();
    let mut views = BTreeMap::new();
    for ((name, tensor), bytes) in tensors.iter().zip(&bytes) {
        let view = TensorView::new(Dtype::F32, tensor.shape.clone(), bytes)
            .map_err(|error| refuse(format!("{name}: {error}")))?;
        if views.insert(name.as_str(), view).is_some() {
            return Err(refuse(format!("{name} is given twice")));
        }
    }
    let metadata: Option<HashMap<_, _>> =
        (!metadata.is_empty()).then(|| metadata.iter().map(|(key, value)| (key.clone(), value.clone())).collect());
    safetensors::serialize_to_file(views, metadata, path).map_err(|error| match error {
        safetensors::SafeTensorError::IoError(source) => WeightError::Io { source, path: path.to_path_buf() },
        other => refuse(other.to_string()),
    })
}
