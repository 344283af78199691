//! An open weight file: which tensors it holds, and reading them on demand.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use safetensors::Dtype;

use super::element::{Widen, integers_of, widen, width};
use super::{HostTensor, WeightError, safetensors_file, torch};

/// Bytes converted at a time, so that a large tensor is not in memory twice. A multiple of every element size.
pub(super) const CHUNK_BYTES: usize = 1 << 20;

/// Where a tensor's values lie in the file.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Entry {
    pub dtype: Dtype,
    pub shape: Vec<usize>,
    /// Byte of the first value.
    pub start: u64,
    /// Elements from the first value to the last; the reader of the container has checked that the file holds them.
    pub span: usize,
    /// Steps in elements along every axis, when the values are not row-major and dense.
    pub strides: Option<Vec<usize>>,
}

/// What a reader of a container found.
#[derive(Debug, Default)]
pub(super) struct Contents {
    pub tensors: BTreeMap<String, Entry>,
    pub metadata: BTreeMap<String, String>,
    /// Names as they follow each other in the file.
    pub order: Vec<String>,
    pub others: Vec<String>,
}

/// An open weight file whose structure has been checked: safetensors, or what `torch.save` writes (`.pth`, `.pt`, `.ckpt`,
/// `.bin`; zip archives and the older sequence of pickles). The contents decide, not the name.
///
/// Nothing of a torch file is executed: its pickle is decoded as data, and only tensors are taken out of it.
#[derive(Debug)]
pub struct WeightFile {
    path: PathBuf,
    file: Mutex<File>,
    contents: Contents,
}

impl WeightFile {
    /// Opens a file and checks that its structure, shapes, byte ranges and length agree.
    ///
    /// The state dict of a torch file is its outermost dictionary if that holds tensors, else the entry `state_dict`, else the
    /// only entry that holds tensors. [`WeightFile::open_nested`] names another one.
    ///
    /// # Errors
    /// [`WeightError::Io`], [`WeightError::Header`], [`WeightError::Length`] or [`WeightError::Torch`].
    pub fn open(path: impl AsRef<Path>) -> Result<Self, WeightError> {
        Self::open_with(path.as_ref(), None)
    }

    /// Opens the dictionary or list that a torch file holds under these keys, outermost first: `&["model", "ema"]`. Items of a list
    /// are called by their position, `0`, `1` and so on.
    ///
    /// # Errors
    /// As [`WeightFile::open`], and [`WeightError::Layout`] for a safetensors file, which has no nesting.
    pub fn open_nested(path: impl AsRef<Path>, keys: &[&str]) -> Result<Self, WeightError> {
        Self::open_with(path.as_ref(), Some(keys))
    }

    fn open_with(path: &Path, keys: Option<&[&str]>) -> Result<Self, WeightError> {
        let io = |source| WeightError::Io { source, path: path.to_path_buf() };
        let mut file = File::open(path).map_err(io)?;
        let container = torch::container(&mut file).map_err(io)?;
        let contents = match (container, keys) {
            (Some(container), keys) => torch::read(&mut file, container, keys, path)?,
            (None, None) => safetensors_file::read(&mut file, path)?,
            (None, Some(keys)) => {
                let reason = format!("{} was asked for, but only torch files are nested", keys.join("/"));
                return Err(WeightError::Layout { reason, path: path.to_path_buf() });
            }
        };
        Ok(Self { path: path.to_path_buf(), file: Mutex::new(file), contents })
    }

    /// Takes a prefix off all names, if every name starts with it; else the names stay.
    #[must_use]
    pub fn without_prefix(mut self, prefix: &str) -> Self {
        let tensors = &mut self.contents.tensors;
        if !tensors.is_empty() && tensors.keys().all(|name| name.starts_with(prefix)) {
            let shorter = |(name, entry): (String, Entry)| (name[prefix.len()..].to_owned(), entry);
            *tensors = std::mem::take(tensors).into_iter().map(shorter).collect();
            self.contents.order.iter_mut().for_each(|name| *name = name.split_off(prefix.len()));
        }
        self
    }

    /// The file that was opened.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Free text entries of a safetensors header.
    #[must_use]
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.contents.metadata
    }

    /// Names of all tensors, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.contents.tensors.keys().map(String::as_str)
    }

    /// Names of all tensors as they follow each other in the file.
    pub fn names_in_order(&self) -> impl Iterator<Item = &str> {
        self.contents.order.iter().map(String::as_str)
    }

    /// Names in the state dict of a torch file that hold something else than a dense tensor.
    #[must_use]
    pub fn others(&self) -> &[String] {
        &self.contents.others
    }

    /// Shape of a tensor, if the file holds it.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.contents.tensors.get(name).map(|entry| entry.shape.as_slice())
    }

    /// Whether a tensor holds integers or truth values, which are no weights.
    #[must_use]
    pub fn is_integer(&self, name: &str) -> bool {
        self.contents.tensors.get(name).is_some_and(|entry| integers_of(entry.dtype).is_some())
    }

    fn entry(&self, name: &str) -> Result<&Entry, WeightError> {
        let missing = || WeightError::MissingTensor { name: name.to_owned(), path: self.path.clone() };
        self.contents.tensors.get(name).ok_or_else(missing)
    }

    fn wrong_type(&self, name: &str, dtype: Dtype) -> WeightError {
        WeightError::ElementType { name: name.to_owned(), dtype: dtype.to_string(), path: self.path.clone() }
    }

    /// Reads one tensor of floats, as f32.
    ///
    /// # Errors
    /// [`WeightError::MissingTensor`], [`WeightError::ElementType`], or [`WeightError::Io`] when the file shrank.
    pub fn tensor(&self, name: &str) -> Result<HostTensor, WeightError> {
        let entry = self.entry(name)?;
        let widen = widen(entry.dtype).ok_or_else(|| self.wrong_type(name, entry.dtype))?;
        Ok(HostTensor { shape: entry.shape.clone(), data: self.values(entry, widen)? })
    }

    /// Reads one tensor of integers or truth values: its shape and its values, row-major.
    ///
    /// # Errors
    /// As [`WeightFile::tensor`].
    pub fn integers(&self, name: &str) -> Result<(Vec<usize>, Vec<i64>), WeightError> {
        let entry = self.entry(name)?;
        let widen = integers_of(entry.dtype).ok_or_else(|| self.wrong_type(name, entry.dtype))?;
        Ok((entry.shape.clone(), self.values(entry, widen)?))
    }

    fn values<T: Copy>(&self, entry: &Entry, widen: Widen<T>) -> Result<Vec<T>, WeightError> {
        let read = self.read_span(entry, widen);
        let values = read.map_err(|source| WeightError::Io { source, path: self.path.clone() })?;
        Ok(match &entry.strides {
            None => values,
            Some(strides) => gather(&values, &entry.shape, strides),
        })
    }

    fn read_span<T>(&self, entry: &Entry, widen: Widen<T>) -> std::io::Result<Vec<T>> {
        let mut data = Vec::with_capacity(entry.span);
        let mut left = entry.span * width(entry.dtype);
        let mut chunk = vec![0; CHUNK_BYTES.min(left)];
        // A reader that panicked leaves no broken state behind: every read seeks first.
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(entry.start))?;
        while left > 0 {
            let part = &mut chunk[..left.min(CHUNK_BYTES)];
            file.read_exact(part)?;
            widen(part, &mut data);
            left -= part.len();
        }
        Ok(data)
    }

    /// Reads every tensor of floats; integers are left out.
    ///
    /// # Errors
    /// As [`WeightFile::tensor`].
    pub fn read_all(&self) -> Result<BTreeMap<String, HostTensor>, WeightError> {
        let floats = self.names().filter(|name| !self.is_integer(name));
        floats.map(|name| Ok((name.to_owned(), self.tensor(name)?))).collect()
    }
}

/// Row-major copy of strided values. Strides fit the values: the reader of the container has checked it.
fn gather<T: Copy>(values: &[T], shape: &[usize], strides: &[usize]) -> Vec<T> {
    let mut places = vec![0];
    for (&length, &stride) in shape.iter().zip(strides) {
        places = places.iter().flat_map(|&place| (0..length).map(move |step| place + step * stride)).collect();
    }
    places.into_iter().filter_map(|place| values.get(place).copied()).collect()
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
    use std::path::PathBuf;

    use half::{bf16, f16};

    use super::super::write_safetensors;
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
        assert_eq!(integers.integers("w").unwrap(), (vec![3], vec![1, 2, 3]));
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
