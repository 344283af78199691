//! Reading and writing safetensors files. Tensors are read on demand; nothing is reserved from a length in the file
//! before that length has been compared with the bytes that are really there.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use half::{bf16, f16};
use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo, TensorView};

use super::{HostTensor, WeightError};

/// The format's own limit for a header (also the limit of the `safetensors` crate).
const MAX_HEADER_BYTES: u64 = 100_000_000;

/// Bytes converted at a time, so that a large tensor is not in memory twice. A multiple of every element size.
const CHUNK_BYTES: usize = 1 << 20;

/// An open safetensors file whose header has been checked.
#[derive(Debug)]
pub struct WeightFile {
    path: PathBuf,
    file: Mutex<File>,
    data_start: u64,
    tensors: BTreeMap<String, TensorInfo>,
    metadata: BTreeMap<String, String>,
}

impl WeightFile {
    /// Opens a file and checks that header, shapes, byte ranges and file length agree.
    ///
    /// # Errors
    /// [`WeightError::Io`], [`WeightError::Header`] or [`WeightError::Length`].
    pub fn open(path: impl AsRef<Path>) -> Result<Self, WeightError> {
        let path = path.as_ref();
        let io = |source| WeightError::Io { source, path: path.to_path_buf() };
        let header = |reason: String| WeightError::Header { reason, path: path.to_path_buf() };

        let mut file = File::open(path).map_err(io)?;
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

        let expected = 8 + header_bytes + parsed.data_len() as u64;
        if expected != file_bytes {
            return Err(WeightError::Length { expected, found: file_bytes, path: path.to_path_buf() });
        }
        Ok(Self {
            path: path.to_path_buf(),
            file: Mutex::new(file),
            data_start: 8 + header_bytes,
            tensors: parsed.tensors().into_iter().map(|(name, info)| (name, info.clone())).collect(),
            metadata: parsed.metadata().clone().unwrap_or_default().into_iter().collect(),
        })
    }

    /// The file that was opened.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Free text entries of the header.
    #[must_use]
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// Names of all tensors, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Shape of a tensor, if the file holds it.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.tensors.get(name).map(|info| info.shape.as_slice())
    }

    /// Reads one tensor, widened to f32.
    ///
    /// # Errors
    /// [`WeightError::MissingTensor`], [`WeightError::ElementType`], or [`WeightError::Io`] when the file shrank.
    pub fn tensor(&self, name: &str) -> Result<HostTensor, WeightError> {
        let info = self
            .tensors
            .get(name)
            .ok_or_else(|| WeightError::MissingTensor { name: name.to_owned(), path: self.path.clone() })?;
        let widen: fn(&[u8], &mut Vec<f32>) = match info.dtype {
            Dtype::F32 => {
                |bytes, out| out.extend(bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])))
            }
            Dtype::F16 => {
                |bytes, out| out.extend(bytes.chunks_exact(2).map(|b| f16::from_le_bytes([b[0], b[1]]).to_f32()))
            }
            Dtype::BF16 => {
                |bytes, out| out.extend(bytes.chunks_exact(2).map(|b| bf16::from_le_bytes([b[0], b[1]]).to_f32()))
            }
            other => {
                return Err(WeightError::ElementType {
                    name: name.to_owned(),
                    dtype: other.to_string(),
                    path: self.path.clone(),
                });
            }
        };
        let data =
            self.read_range(info, widen).map_err(|source| WeightError::Io { source, path: self.path.clone() })?;
        Ok(HostTensor { shape: info.shape.clone(), data })
    }

    fn read_range(&self, info: &TensorInfo, widen: fn(&[u8], &mut Vec<f32>)) -> std::io::Result<Vec<f32>> {
        let (start, end) = info.data_offsets;
        let mut data = Vec::with_capacity(info.shape.iter().product());
        let mut chunk = vec![0; CHUNK_BYTES.min(end - start)];
        // A reader that panicked leaves no broken state behind: every read seeks first.
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(self.data_start + start as u64))?;
        let mut left = end - start;
        while left > 0 {
            let part = &mut chunk[..left.min(CHUNK_BYTES)];
            file.read_exact(part)?;
            widen(part, &mut data);
            left -= part.len();
        }
        Ok(data)
    }

    /// Reads every tensor.
    ///
    /// # Errors
    /// As [`WeightFile::tensor`].
    pub fn read_all(&self) -> Result<BTreeMap<String, HostTensor>, WeightError> {
        self.names().map(|name| Ok((name.to_owned(), self.tensor(name)?))).collect()
    }
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

/// Writes a text that belongs to weights. The file appears under its name only when it is complete.
///
/// # Errors
/// What the operating system says.
pub fn write_text(path: &Path, text: &str) -> std::io::Result<()> {
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    std::fs::write(&part, text)?;
    std::fs::rename(&part, path)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Header text and data behind the length prefix.
    fn raw_file(length: u64, header: &str, data: &[u8]) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        let bytes = [&length.to_le_bytes(), header.as_bytes(), data].concat();
        std::fs::write(file.path(), bytes).unwrap();
        file
    }

    fn open(header: &str, data: &[u8]) -> Result<WeightFile, WeightError> {
        WeightFile::open(raw_file(header.len() as u64, header, data).path())
    }

    fn header(dtype: &str, shape: &str, end: usize) -> String {
        format!(r#"{{"w":{{"dtype":"{dtype}","shape":{shape},"data_offsets":[0,{end}]}}}}"#)
    }

    #[test]
    fn writes_and_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.safetensors");
        // More than one chunk, and a scalar and an empty tensor beside it.
        let long: Vec<f32> = (0..CHUNK_BYTES / 2).map(|i| i as f32 * 0.5 - 7.0).collect();
        let tensors = vec![
            ("b.weight".to_owned(), HostTensor::new(&[2, CHUNK_BYTES / 4], long)),
            ("a".to_owned(), HostTensor::new(&[], vec![f32::MIN_POSITIVE])),
            ("none".to_owned(), HostTensor::new(&[0, 3], vec![])),
        ];
        let metadata = BTreeMap::from([("preprocessing".to_owned(), "caffe".to_owned())]);
        write_safetensors(&path, &tensors, &metadata).unwrap();

        let file = WeightFile::open(&path).unwrap();
        assert_eq!(file.metadata(), &metadata);
        assert_eq!(file.names().collect::<Vec<_>>(), ["a", "b.weight", "none"]);
        assert_eq!(file.shape("none"), Some([0, 3].as_slice()));
        assert_eq!(file.read_all().unwrap(), tensors.into_iter().collect());
        assert!(matches!(file.tensor("c"), Err(WeightError::MissingTensor { name, .. }) if name == "c"));
    }

    #[test]
    fn a_name_given_twice_is_refused() {
        let path = tempfile::tempdir().unwrap().path().join("a.safetensors");
        let twice = vec![("a".to_owned(), HostTensor::new(&[1], vec![0.0])); 2];
        assert!(matches!(write_safetensors(path, &twice, &BTreeMap::new()), Err(WeightError::Write { .. })));
    }

    #[test]
    fn half_precision_is_widened_exactly() {
        let values = [1.5_f32, -0.25, 6.103_515_6e-5];
        let bytes: Vec<u8> = values.iter().flat_map(|&v| f16::from_f32(v).to_le_bytes()).collect();
        assert_eq!(open(&header("F16", "[3]", 6), &bytes).unwrap().tensor("w").unwrap().data, values);
        let bytes: Vec<u8> = values.iter().flat_map(|&v| bf16::from_f32(v).to_le_bytes()).collect();
        assert_eq!(open(&header("BF16", "[3]", 6), &bytes).unwrap().tensor("w").unwrap().data, values);
        let integers = open(&header("U8", "[3]", 3), &[1, 2, 3]).unwrap();
        assert!(matches!(integers.tensor("w"), Err(WeightError::ElementType { dtype, .. }) if dtype == "U8"));
    }

    #[test]
    fn broken_files_give_typed_errors_that_end_in_the_path() {
        let sound = header("F32", "[2,2]", 16);
        assert_eq!(open(&sound, &[0; 16]).unwrap().tensor("w").unwrap(), HostTensor::new(&[2, 2], vec![0.0; 4]));

        assert!(matches!(open(&sound, &[0; 4]), Err(WeightError::Length { .. })), "data cut");
        assert!(matches!(open(&sound, &[0; 20]), Err(WeightError::Length { .. })), "data too long");
        let headers = [
            header("F32", "[3,3]", 16),
            header("F32", "[4294967296,4294967296,4294967296]", 16),
            header("F33", "[2,2]", 16),
            r#"{"w":{"dtype":"F32","shape":[2],"data_offsets":[8,16]}}"#.to_owned(),
            "not json".to_owned(),
        ];
        for text in headers {
            assert!(matches!(open(&text, &[0; 16]), Err(WeightError::Header { .. })), "{text}");
        }
        for length in [1 << 60, u64::MAX, 90_000_000, 3] {
            let file = raw_file(length, "{}", &[]);
            let error = WeightFile::open(file.path()).unwrap_err();
            assert!(matches!(error, WeightError::Header { .. }), "{error}");
            assert!(error.to_string().ends_with(&file.path().display().to_string()), "{error}");
        }
        assert!(matches!(WeightFile::open("no/such/file"), Err(WeightError::Io { .. })));
    }

    /// The shared set of broken files, when `RIGSCAPE_DATA` names the folder that holds it.
    #[test]
    fn shared_broken_files() {
        let Some(data) = std::env::var_os("RIGSCAPE_DATA") else {
            eprintln!("not run: RIGSCAPE_DATA is not set");
            return;
        };
        let folder = PathBuf::from(data).join("malformed/safetensors");
        let mut broken = 0;
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let result = WeightFile::open(&path);
            if path.file_stem().unwrap() == "base_ok" {
                result.unwrap().read_all().unwrap();
            } else {
                let error = result.unwrap_err();
                assert!(matches!(error, WeightError::Header { .. } | WeightError::Length { .. }), "{error}");
                assert!(error.to_string().ends_with(&path.display().to_string()), "{error}");
                broken += 1;
            }
        }
        assert!(broken >= 3, "{broken} broken files in {}", folder.display());
    }
}
