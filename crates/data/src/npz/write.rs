//! The same bytes for the same arrays: no clock, fixed compression.

use std::io::{Cursor, Write};

use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::header::{Dtype, Header};
use crate::DataError;

/// An .npy file of elements in C order, given as their little-endian bytes.
///
/// # Errors
/// [`DataError::Config`] when bytes and shape do not fit each other.
pub fn npy_bytes(dtype: Dtype, shape: &[usize], bytes: &[u8]) -> Result<Vec<u8>, DataError> {
    let length = shape.iter().try_fold(dtype.size(), |length, axis| length.checked_mul(*axis));
    if length != Some(bytes.len()) {
        let count = bytes.len();
        return Err(DataError::Config(format!("{count} bytes are no array {shape:?} of {}", dtype.descr())));
    }
    Ok([Header::write(dtype, shape).as_slice(), bytes].concat())
}

/// An .npz file of arrays, each with name, element type, shape and little-endian bytes in C order. Deflated.
///
/// # Errors
/// As [`npy_bytes`]; a name that occurs twice.
pub fn npz_bytes(arrays: &[(&str, Dtype, &[usize], &[u8])]) -> Result<Vec<u8>, DataError> {
    let refused = |error: zip::result::ZipError| DataError::Config(format!("cannot write the arrays: {error}"));
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(zip::DateTime::default());
    for (name, dtype, shape, bytes) in arrays {
        zip.start_file(format!("{name}.npy"), options).map_err(refused)?;
        let file = npy_bytes(*dtype, shape, bytes)?;
        zip.write_all(&file).map_err(|error| refused(error.into()))?;
    }
    Ok(zip.finish().map_err(refused)?.into_inner())
}
