//! One shard: a safetensors file of moments `[N, 2, C, h, w]`, and of each sample its record as JSON text.
//!
//! A sample is read at its place in the file (from the system's page cache after the first time), so opening costs a header and memory
//! stays flat. Nothing in a header is trusted: places are checked against the file's length.

use std::borrow::Cow;
use std::path::Path;

use half::f16;
use safetensors::tensor::{Dtype, Metadata, View, serialize};

use super::record::Record;
use super::{Latent, LatentType, json_error, write_whole};
use crate::DataError;
use crate::store::PositionFile;

const MOMENTS: &str = "moments";
/// Records one after another, UTF-8.
const RECORDS: &str = "records";
/// Where each record ends, bytes.
const ENDS: &str = "record_ends";
/// Longest header; three tensors need three hundred bytes.
const MOST_HEADER: u64 = 1 << 16;
/// Longest record; ten thousand boxes need two megabytes.
const MOST_RECORD: u64 = 1 << 26;

/// An opened shard.
#[derive(Debug)]
pub(super) struct Shard {
    file: PositionFile,
    shape: [usize; 3],
    dtype: LatentType,
    moments: u64,
    records: u64,
    record_bytes: u64,
    ends: u64,
    samples: usize,
}

impl Shard {
    /// Reads the header.
    pub fn open(path: &Path, samples: usize, shape: [usize; 3], dtype: LatentType) -> Result<Self, DataError> {
        let file = PositionFile::open(path)?;
        let refuse =
            |why: &str| DataError::Format { format: "latent shard", why: why.to_owned(), path: path.to_owned() };
        let mut size = [0; 8];
        file.fill(&mut size, 0)?;
        let size = u64::from_le_bytes(size);
        if size > MOST_HEADER || size + 8 > file.len {
            return Err(refuse("its header is longer than a shard's"));
        }
        let header: Metadata = serde_json::from_slice(&file.bytes(8, size)?).map_err(json_error(path))?;
        let begin = 8 + size;
        if begin + header.data_len() as u64 != file.len {
            return Err(DataError::Truncated { offset: file.len, path: path.to_owned() });
        }
        let place = |name: &str, dtype: Dtype, shape: &[usize]| {
            let info = header.info(name).filter(|info| info.dtype == dtype);
            let info = info.ok_or_else(|| refuse(&format!("it has no {name} of {dtype:?}")))?;
            let fits = info.shape.len() == shape.len()
                && info.shape.iter().zip(shape).all(|(got, want)| *want == usize::MAX || got == want);
            let text = || format!("{name} is {:?}, the manifest says {shape:?}", info.shape);
            if fits { Ok((begin + info.data_offsets.0 as u64, info.shape.clone())) } else { Err(refuse(&text())) }
        };
        let [c, h, w] = shape;
        let (moments, _) = place(MOMENTS, stored(dtype), &[samples, 2, c, h, w])?;
        let (ends, _) = place(ENDS, Dtype::U64, &[samples])?;
        let (records, lengths) = place(RECORDS, Dtype::U8, &[usize::MAX])?;
        let record_bytes = lengths.first().map_or(0, |length| *length as u64);
        Ok(Self { file, shape, dtype, moments, records, record_bytes, ends, samples })
    }

    /// Mean and log variance of a sample.
    pub fn latent(&self, at: usize) -> Result<Latent, DataError> {
        self.check(at)?;
        let count = self.shape.iter().product::<usize>();
        let size = 2 * count * bytes_of(self.dtype);
        let bytes = self.file.bytes(self.moments + (at * size) as u64, size as u64)?;
        let mut mean = numbers(&bytes, self.dtype);
        let log_var = Some(mean.split_off(count.min(mean.len())));
        Latent { mean, log_var }.checked(self.shape, &self.file.path)
    }

    /// What belongs to a sample.
    pub fn record(&self, at: usize) -> Result<Record, DataError> {
        self.check(at)?;
        let start = if at == 0 { 0 } else { self.end(at - 1)? };
        let end = self.end(at)?;
        if end < start || end > self.record_bytes || end - start > MOST_RECORD {
            let why = format!("record {at} would go from byte {start} to {end} of {}", self.record_bytes);
            return Err(DataError::Format { format: "latent shard", why, path: self.file.path.clone() });
        }
        let text = self.file.bytes(self.records + start, end - start)?;
        serde_json::from_slice(&text).map_err(json_error(&self.file.path))
    }

    fn end(&self, at: usize) -> Result<u64, DataError> {
        let mut bytes = [0; 8];
        self.file.fill(&mut bytes, self.ends + 8 * at as u64)?;
        Ok(u64::from_le_bytes(bytes))
    }

    fn check(&self, at: usize) -> Result<(), DataError> {
        if at < self.samples {
            return Ok(());
        }
        let why = format!("there is no sample {at}, only {}", self.samples);
        Err(DataError::Format { format: "latent shard", why, path: self.file.path.clone() })
    }
}

const fn stored(dtype: LatentType) -> Dtype {
    match dtype {
        LatentType::F16 => Dtype::F16,
        LatentType::F32 => Dtype::F32,
    }
}

const fn bytes_of(dtype: LatentType) -> usize {
    match dtype {
        LatentType::F16 => 2,
        LatentType::F32 => 4,
    }
}

fn numbers(bytes: &[u8], dtype: LatentType) -> Vec<f32> {
    match dtype {
        LatentType::F16 => bytes.as_chunks::<2>().0.iter().map(|value| f16::from_le_bytes(*value).to_f32()).collect(),
        LatentType::F32 => bytes.as_chunks::<4>().0.iter().map(|value| f32::from_le_bytes(*value)).collect(),
    }
}

/// The samples of a shard before it is written.
#[derive(Debug, Default)]
pub(super) struct ShardContent {
    moments: Vec<u8>,
    records: Vec<u8>,
    ends: Vec<u8>,
}

impl ShardContent {
    /// `latent` has a log variance and fitting lengths.
    pub fn push(&mut self, latent: &Latent, record: &Record, dtype: LatentType, path: &Path) -> Result<(), DataError> {
        for value in latent.mean.iter().chain(latent.log_var.iter().flatten()) {
            match dtype {
                LatentType::F32 => self.moments.extend(value.to_le_bytes()),
                LatentType::F16 => {
                    let half = f16::from_f32(*value);
                    if !half.is_finite() {
                        let why = format!("{value} does not fit half precision; store f32 instead");
                        return Err(DataError::Format { format: "latent", why, path: path.to_owned() });
                    }
                    self.moments.extend(half.to_le_bytes());
                }
            }
        }
        serde_json::to_writer(&mut self.records, record).map_err(json_error(path))?;
        self.ends.extend((self.records.len() as u64).to_le_bytes());
        Ok(())
    }

    pub fn samples(&self) -> usize {
        self.ends.len() / 8
    }

    /// Writes the file whole and returns its length.
    pub fn write(&self, path: &Path, [c, h, w]: [usize; 3], dtype: LatentType) -> Result<u64, DataError> {
        let n = self.samples();
        let tensors = [
            (MOMENTS, Bytes { dtype: stored(dtype), shape: vec![n, 2, c, h, w], bytes: &self.moments }),
            (ENDS, Bytes { dtype: Dtype::U64, shape: vec![n], bytes: &self.ends }),
            (RECORDS, Bytes { dtype: Dtype::U8, shape: vec![self.records.len()], bytes: &self.records }),
        ];
        let bytes = serialize(tensors, None).map_err(|error| DataError::Io {
            action: "write",
            source: std::io::Error::other(error.to_string()),
            path: path.to_owned(),
        })?;
        write_whole(path, &bytes)?;
        Ok(bytes.len() as u64)
    }
}

struct Bytes<'a> {
    dtype: Dtype,
    shape: Vec<usize>,
    bytes: &'a [u8],
}

impl View for Bytes<'_> {
    fn dtype(&self) -> Dtype {
        self.dtype
    }

    fn shape(&self) -> &[usize] {
        &self.shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        Cow::Borrowed(self.bytes)
    }

    fn data_len(&self) -> usize {
        self.bytes.len()
    }
}
