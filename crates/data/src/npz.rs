//! NumPy's array files: .npy holds one array, .npz is a zip of them.
//!
//! Files are not trusted. Element type and shape are compared with what the caller wants before anything is reserved, arrays of
//! Python objects are refused unread, and no more is inflated than the shape needs. Format:
//! <https://numpy.org/doc/stable/reference/generated/numpy.lib.format.html>, versions 1 to 3.

mod header;
mod write;

use std::io::{Cursor, ErrorKind, Read};
use std::path::{Path, PathBuf};

use half::f16;
use zip::ZipArchive;
use zip::result::ZipError;

pub use header::Dtype;
pub use write::{npy_bytes, npz_bytes};

use crate::DataError;
use crate::store::StoredFile;
use header::Header;

/// An array that would be larger is refused whatever its shape, bytes.
const MOST_BYTES: usize = 1 << 30;
/// Longest header; numbers, not records, need a hundred bytes.
const MOST_HEADER: usize = 1 << 16;
/// Reserved at once; longer arrays grow with the bytes that really come.
const FIRST_RESERVE: usize = 1 << 20;

/// What an array must be.
#[derive(Debug, Clone, Copy)]
pub struct Want<'a> {
    /// Allowed element types.
    pub dtypes: &'a [Dtype],
    /// Lengths of the axes; `None` for any.
    pub shape: &'a [Option<usize>],
}

impl Want<'_> {
    fn describe(&self) -> String {
        let dtypes: Vec<&str> = self.dtypes.iter().map(|dtype| dtype.descr()).collect();
        let axes: Vec<String> = self.shape.iter().map(|n| n.map_or("any".to_owned(), |n| n.to_string())).collect();
        format!("{} [{}]", dtypes.join(" or "), axes.join(", "))
    }

    fn allows(&self, header: &Header) -> Option<Dtype> {
        let dtype = Dtype::of_descr(&header.descr).filter(|dtype| self.dtypes.contains(dtype))?;
        let fits = |(want, got): (&Option<usize>, &usize)| want.is_none_or(|want| want == *got);
        let same = self.shape.len() == header.shape.len() && self.shape.iter().zip(&header.shape).all(fits);
        same.then_some(dtype)
    }
}

/// An array in memory. Elements are counted in C order (last axis fastest), however the file holds them.
#[derive(Debug, Clone, PartialEq)]
pub struct Array {
    dtype: Dtype,
    fortran_order: bool,
    shape: Vec<usize>,
    bytes: Vec<u8>,
}

impl Array {
    /// Element type.
    pub fn dtype(&self) -> Dtype {
        self.dtype
    }

    /// Lengths of the axes.
    pub fn shape(&self) -> &[usize] {
        &self.shape
    }

    /// Number of elements.
    pub fn len(&self) -> usize {
        self.bytes.len() / self.dtype.size()
    }

    /// True without elements.
    pub fn is_empty(&self) -> bool {
        self.bytes.is_empty()
    }

    /// The bytes of one-byte elements (`u8`, `i8`, `bool`), C order.
    ///
    /// # Errors
    /// The array itself, when its elements are longer.
    pub fn into_u8(self) -> Result<Vec<u8>, Self> {
        if self.dtype.size() > 1 {
            return Err(self);
        }
        if !self.fortran_order {
            return Ok(self.bytes);
        }
        Ok((0..self.bytes.len()).filter_map(|at| self.element(at)).map(|byte| byte[0]).collect())
    }

    /// All elements as integers, C order.
    ///
    /// # Errors
    /// Position of the first element that is none or does not fit.
    pub fn to_i64(&self) -> Result<Vec<i64>, usize> {
        (0..self.len()).map(|at| self.integer(at).ok_or(at)).collect()
    }

    /// All elements as floats, C order.
    pub fn to_f64(&self) -> Vec<f64> {
        (0..self.len()).filter_map(|at| self.float(at)).collect()
    }

    /// Bytes of an element given by its position in C order, padded to eight.
    fn element(&self, at: usize) -> Option<[u8; 8]> {
        let place = if self.fortran_order { fortran_place(&self.shape, at) } else { at };
        let size = self.dtype.size();
        let bytes = self.bytes.get(place * size..(place + 1) * size)?;
        let mut padded = [0; 8];
        padded.get_mut(..size)?.copy_from_slice(bytes);
        Some(padded)
    }

    fn integer(&self, at: usize) -> Option<i64> {
        let [a, b, c, d, ..] = self.element(at)?;
        let all = self.element(at)?;
        match self.dtype {
            Dtype::Bool | Dtype::U8 => Some(i64::from(a)),
            Dtype::I8 => Some(i64::from(a as i8)),
            Dtype::U16 => Some(i64::from(u16::from_le_bytes([a, b]))),
            Dtype::I16 => Some(i64::from(i16::from_le_bytes([a, b]))),
            Dtype::U32 => Some(i64::from(u32::from_le_bytes([a, b, c, d]))),
            Dtype::I32 => Some(i64::from(i32::from_le_bytes([a, b, c, d]))),
            Dtype::U64 => i64::try_from(u64::from_le_bytes(all)).ok(),
            Dtype::I64 => Some(i64::from_le_bytes(all)),
            Dtype::F16 | Dtype::F32 | Dtype::F64 => {
                // Above 2^53 a float stands for several integers.
                self.float(at).filter(|value| value.fract() == 0.0 && value.abs() < 9e15).map(|value| value as i64)
            }
        }
    }

    fn float(&self, at: usize) -> Option<f64> {
        let [a, b, c, d, ..] = self.element(at)?;
        match self.dtype {
            Dtype::F16 => Some(f16::from_le_bytes([a, b]).to_f64()),
            Dtype::F32 => Some(f64::from(f32::from_le_bytes([a, b, c, d]))),
            Dtype::F64 => Some(f64::from_le_bytes(self.element(at)?)),
            Dtype::U64 => Some(u64::from_le_bytes(self.element(at)?) as f64),
            _ => self.integer(at).map(|value| value as f64),
        }
    }
}

/// Where an element stands in a file whose first axis runs fastest.
fn fortran_place(shape: &[usize], at: usize) -> usize {
    let mut rest = at;
    let mut place = 0;
    let mut stride: usize = shape.iter().product();
    for length in shape.iter().rev() {
        stride /= length.max(&1);
        place += rest % length.max(&1) * stride;
        rest /= length.max(&1);
    }
    place
}

/// Reads an .npy file.
///
/// # Errors
/// [`DataError::Array`] for another element type or shape, [`DataError::Truncated`], [`DataError::Format`] for anything else that
/// is wrong, [`DataError::Missing`] and [`DataError::Io`].
pub fn read_npy(file: &StoredFile, want: &Want<'_>) -> Result<Array, DataError> {
    parse_npy(&file.bytes()?, file.path(), want)
}

/// [`read_npy`] for bytes in memory; the path is for messages.
///
/// # Errors
/// As [`read_npy`].
pub fn parse_npy(mut bytes: &[u8], path: &Path, want: &Want<'_>) -> Result<Array, DataError> {
    Reading { name: "npy", path, format: "npy" }.array(&mut bytes, want)
}

/// An opened .npz file.
#[derive(Debug)]
pub struct Npz {
    archive: ZipArchive<Cursor<Vec<u8>>>,
    path: PathBuf,
}

impl Npz {
    /// Reads the file's directory.
    ///
    /// # Errors
    /// [`DataError::Format`] where that cannot be done, [`DataError::Missing`] and [`DataError::Io`].
    pub fn open(file: &StoredFile) -> Result<Self, DataError> {
        Self::parse(file.bytes()?, file.path())
    }

    /// [`Npz::open`] for bytes in memory; the path is for messages.
    ///
    /// # Errors
    /// As [`Npz::open`].
    pub fn parse(bytes: Vec<u8>, path: &Path) -> Result<Self, DataError> {
        let path = path.to_owned();
        let archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| DataError::Format {
            format: "npz",
            why: error.to_string(),
            path: path.clone(),
        })?;
        Ok(Self { archive, path })
    }

    /// One of its arrays.
    ///
    /// # Errors
    /// [`DataError::Missing`] for an array that is not there, else as [`read_npy`].
    pub fn array(&mut self, name: &str, want: &Want<'_>) -> Result<Array, DataError> {
        let path = &self.path;
        let mut entry = self.archive.by_name(&format!("{name}.npy")).map_err(|error| match error {
            ZipError::FileNotFound => DataError::Missing { what: format!("array {name}"), path: path.clone() },
            error => DataError::Format { format: "npz", why: format!("array {name}: {error}"), path: path.clone() },
        })?;
        Reading { name, path, format: "npz" }.array(&mut entry, want)
    }
}

/// Where an array comes from, for messages.
struct Reading<'a> {
    name: &'a str,
    path: &'a Path,
    format: &'static str,
}

impl Reading<'_> {
    fn array(&self, source: &mut impl Read, want: &Want<'_>) -> Result<Array, DataError> {
        let (header, start) = self.header(source)?;
        let refused = || DataError::Array {
            name: self.name.to_owned(),
            got: header.describe(),
            want: want.describe(),
            path: self.path.to_owned(),
        };
        let dtype = want.allows(&header).ok_or_else(refused)?;
        let length = header.shape.iter().try_fold(dtype.size(), |bytes, axis| bytes.checked_mul(*axis));
        let length = length.filter(|length| *length <= MOST_BYTES).ok_or_else(refused)?;
        let mut bytes = Vec::with_capacity(length.min(FIRST_RESERVE));
        source.by_ref().take(length as u64).read_to_end(&mut bytes).map_err(|error| self.failure(&error, start))?;
        if bytes.len() < length {
            return Err(DataError::Truncated { offset: (start + bytes.len()) as u64, path: self.path.to_owned() });
        }
        // The look behind the last element also makes a zip entry compare its checksum.
        if source.read(&mut [0]).map_err(|error| self.failure(&error, start + length))? > 0 {
            return Err(self.format(format!("bytes follow the {length} of its shape")));
        }
        Ok(Array { dtype, fortran_order: header.fortran_order, shape: header.shape, bytes })
    }

    /// The header and the number of bytes up to its end.
    fn header(&self, source: &mut impl Read) -> Result<(Header, usize), DataError> {
        let mut start = [0; 8];
        source.read_exact(&mut start).map_err(|error| self.failure(&error, 0))?;
        let (wide, before) = match start {
            [0x93, b'N', b'U', b'M', b'P', b'Y', 1, _] => (false, 10),
            [0x93, b'N', b'U', b'M', b'P', b'Y', 2 | 3, _] => (true, 12),
            _ => return Err(self.format("it does not begin as an array of version 1, 2 or 3".to_owned())),
        };
        let mut length = [0; 4];
        let field = if wide { &mut length[..] } else { &mut length[..2] };
        source.read_exact(field).map_err(|error| self.failure(&error, 8))?;
        let length = u32::from_le_bytes(length) as usize;
        if length > MOST_HEADER {
            return Err(self.format(format!("its header would have {length} bytes")));
        }
        let mut text = vec![0; length];
        source.read_exact(&mut text).map_err(|error| self.failure(&error, before))?;
        let text = std::str::from_utf8(&text).map_err(|error| self.format(format!("header: {error}")))?;
        Ok((Header::parse(text).map_err(|why| self.format(why))?, before + length))
    }

    fn format(&self, why: String) -> DataError {
        let why = format!("array {}: {why}", self.name);
        DataError::Format { format: self.format, why, path: self.path.to_owned() }
    }

    fn failure(&self, error: &std::io::Error, offset: usize) -> DataError {
        match error.kind() {
            ErrorKind::UnexpectedEof => DataError::Truncated { offset: offset as u64, path: self.path.to_owned() },
            _ => self.format(error.to_string()),
        }
    }
}
