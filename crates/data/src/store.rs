//! A dataset's root, read-only. Readers name files by relative paths and never learn what lies under the root.

use std::fmt;
use std::io::{ErrorKind, Read, Seek, SeekFrom};
use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

use crate::DataError;

/// The root of a dataset. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Store {
    folder: Arc<Path>,
}

/// A file below a [`Store`]; holds no bytes and no open handle. Ordered and compared by its name.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StoredFile {
    path: PathBuf,
}

/// A direct child of a folder below a [`Store`].
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct StoredName {
    /// Last component.
    pub name: String,
    /// True for a folder.
    pub is_folder: bool,
}

impl Store {
    /// Opens a root.
    ///
    /// # Errors
    /// [`DataError::Missing`] where there is none.
    pub fn open(root: impl AsRef<Path>) -> Result<Self, DataError> {
        let root = root.as_ref();
        if root.is_dir() {
            return Ok(Self { folder: root.into() });
        }
        Err(DataError::Missing { what: "dataset folder".to_owned(), path: root.to_owned() })
    }

    /// Where a name would lie, for messages only.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// A file, if it exists.
    pub fn find(&self, name: &str) -> Option<StoredFile> {
        let path = self.folder.join(name);
        path.is_file().then_some(StoredFile { path })
    }

    /// A file that must exist.
    ///
    /// # Errors
    /// [`DataError::Missing`], naming it and what it is for.
    pub fn file(&self, name: &str, what: &str) -> Result<StoredFile, DataError> {
        self.find(name).ok_or_else(|| DataError::Missing { what: what.to_owned(), path: self.path(name) })
    }

    /// A file that is expected, not looked for: pictures, whose absence shows when they are read.
    pub fn expected(&self, name: &str) -> StoredFile {
        StoredFile { path: self.folder.join(name) }
    }

    /// All bytes of a file that must exist.
    ///
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`].
    pub fn read(&self, name: &str, what: &str) -> Result<Vec<u8>, DataError> {
        self.file(name, what)?.bytes()
    }

    /// Direct children of a folder, sorted by name; none where there is no such folder. `""` is the root.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn list(&self, folder: &str) -> Result<Vec<StoredName>, DataError> {
        let path = self.folder.join(folder);
        if !path.is_dir() {
            return Ok(Vec::new());
        }
        let io = |source| DataError::Io { action: "list", source, path: path.clone() };
        let mut names = Vec::new();
        for entry in std::fs::read_dir(&path).map_err(io)? {
            let entry = entry.map_err(io)?;
            // Names that are no text cannot be named by any table.
            if let Ok(name) = entry.file_name().into_string() {
                names.push(StoredName { name, is_folder: entry.path().is_dir() });
            }
        }
        names.sort();
        Ok(names)
    }
}

/// A name found inside a table, database or archive, checked to stay below the root.
///
/// # Errors
/// [`DataError::UnsafePath`] for absolute names, `..`, drive letters, backslashes and NUL, naming the file it stands in.
pub fn checked_name<'a>(text: &'a str, found_in: &Path) -> Result<&'a str, DataError> {
    let plain = !text.is_empty()
        && !text.contains(['\\', '\0', ':'])
        && Path::new(text).components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir));
    if plain { Ok(text) } else { Err(DataError::UnsafePath { text: text.to_owned(), path: found_in.to_owned() }) }
}

impl StoredFile {
    /// Its path, for messages only.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its path when it is an ordinary file, for libraries that open files themselves (SQLite, memory maps).
    pub fn on_disk(&self) -> Option<&Path> {
        Some(&self.path)
    }

    /// All bytes.
    ///
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`].
    pub fn bytes(&self) -> Result<Vec<u8>, DataError> {
        std::fs::read(&self.path).map_err(|source| self.failure("read", source))
    }

    /// Number of bytes.
    ///
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`].
    pub fn size(&self) -> Result<u64, DataError> {
        Ok(std::fs::metadata(&self.path).map_err(|source| self.failure("look at", source))?.len())
    }

    /// Exactly `length` bytes from `offset`. Memory is reserved for bytes that exist only.
    ///
    /// # Errors
    /// [`DataError::Truncated`] where the file ends before, else as [`StoredFile::bytes`].
    pub fn read_at(&self, offset: u64, length: u64) -> Result<Vec<u8>, DataError> {
        let mut file = std::fs::File::open(&self.path).map_err(|source| self.failure("open", source))?;
        let size = file.metadata().map_err(|source| self.failure("look at", source))?.len();
        let inside = offset.checked_add(length).is_some_and(|end| end <= size);
        let truncated = || DataError::Truncated { offset: size, path: self.path.clone() };
        let mut bytes = vec![0; usize::try_from(length).ok().filter(|_| inside).ok_or_else(truncated)?];
        file.seek(SeekFrom::Start(offset)).map_err(|source| self.failure("read", source))?;
        file.read_exact(&mut bytes).map_err(|source| self.failure("read", source))?;
        Ok(bytes)
    }

    /// The first bytes, at most `head`, and the last two, for a look at a picture without reading it.
    ///
    /// # Errors
    /// As [`StoredFile::bytes`].
    pub fn ends(&self, head: usize) -> Result<(Vec<u8>, [u8; 2]), DataError> {
        let io = |source| DataError::Io { action: "read", source, path: self.path.clone() };
        let mut file = std::fs::File::open(&self.path).map_err(|source| self.failure("open", source))?;
        let mut first = Vec::new();
        file.by_ref().take(head as u64).read_to_end(&mut first).map_err(io)?;
        let mut tail = [0u8; 2];
        if file.seek(SeekFrom::End(0)).map_err(io)? >= 2 {
            file.seek(SeekFrom::End(-2)).map_err(io)?;
            file.read_exact(&mut tail).map_err(io)?;
        }
        Ok((first, tail))
    }

    fn failure(&self, action: &'static str, source: std::io::Error) -> DataError {
        let path = self.path.clone();
        match source.kind() {
            ErrorKind::NotFound | ErrorKind::NotADirectory => DataError::Missing { what: "file".to_owned(), path },
            _ => DataError::Io { action, source, path },
        }
    }
}

impl From<PathBuf> for StoredFile {
    fn from(path: PathBuf) -> Self {
        Self { path }
    }
}

impl fmt::Display for StoredFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.path.display().fmt(f)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_below_the_root() {
        for name in ["a/b.jpg", "./a", "n015+0800__CAM.jpg", "a b"] {
            assert_eq!(checked_name(name, Path::new("t.json")).unwrap(), name);
        }
        for name in ["", "/a", "../a", "a/../../b", "C:/a", "a\\b", "a\0b"] {
            let error = checked_name(name, Path::new("t.json")).unwrap_err();
            assert!(error.to_string().ends_with("t.json"), "{error}");
        }
    }

    #[test]
    fn folders_are_listed_in_order_and_absent_files_are_named() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["b", "a", "c/d"] {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, name).unwrap();
        }
        let store = Store::open(folder.path()).unwrap();
        let names: Vec<_> = store.list("").unwrap().into_iter().map(|n| (n.name, n.is_folder)).collect();
        assert_eq!(names, [("a".into(), false), ("b".into(), false), ("c".into(), true)]);
        assert_eq!(store.read("c/d", "d").unwrap(), b"c/d");
        let file = store.file("c/d", "d").unwrap();
        assert_eq!((file.size().unwrap(), file.read_at(1, 2).unwrap()), (3, b"/d".to_vec()));
        for (offset, length) in [(2, 2), (4, 0), (u64::MAX, 2), (0, u64::MAX)] {
            assert!(matches!(file.read_at(offset, length), Err(DataError::Truncated { offset: 3, .. })));
        }
        assert!(store.list("x").unwrap().is_empty());
        let error = store.file("c/e", "calibration").unwrap_err().to_string();
        assert!(error.starts_with("missing calibration") && error.ends_with("c/e"), "{error}");
        assert!(Store::open(folder.path().join("x")).is_err());
    }
}
