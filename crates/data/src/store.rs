//! A dataset's root, read-only. Readers name files by relative paths and never learn what lies under the root: a folder, a zip or tar
//! archive, or several of them laid over one another.

mod archive;
mod convert;
mod file;
mod index;
mod index_cache;
mod mount;
mod positional;
mod roots;
mod tar;
mod zip;

use std::path::{Component, Path, PathBuf};
use std::sync::Arc;

pub use convert::index_archive;
pub use file::StoredFile;
pub use roots::{Root, Roots};

use file::{Place, missing};
use mount::Mount;
pub(crate) use positional::PositionFile;

use crate::DataError;

/// The root of a dataset: folders and archives, searched in order. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Store {
    mounts: Arc<[Mount]>,
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
    /// Opens one root: a folder, a zip archive or an uncompressed tar archive.
    ///
    /// # Errors
    /// As [`Store::open_all`].
    pub fn open(root: impl AsRef<Path>) -> Result<Self, DataError> {
        Self::open_all(&Roots::from(root.as_ref()))
    }

    /// Opens several roots that are laid over one another: of two files with one name, that of the earlier root is read.
    ///
    /// # Errors
    /// [`DataError::Missing`] where there is none; [`DataError::Config`] for an empty list; for archives [`DataError::Format`] (damage,
    /// gzip, encryption, links, unknown methods, names that occur twice), [`DataError::UnsafePath`], [`DataError::Truncated`] and
    /// [`DataError::Empty`]. An archive with one entry that is refused is refused as a whole.
    pub fn open_all(roots: &Roots) -> Result<Self, DataError> {
        if roots.as_slice().is_empty() {
            return Err(DataError::Config("`root` is an empty list".to_owned()));
        }
        let mounts: Result<Vec<Mount>, DataError> = roots.as_slice().iter().map(Mount::open).collect();
        Ok(Self { mounts: mounts?.into() })
    }

    /// Where a name would lie, for messages only: in the first root.
    pub fn path(&self, name: &str) -> PathBuf {
        self.mounts.first().map(|mount| mount.path(name)).unwrap_or_default()
    }

    /// A file, if it exists.
    pub fn find(&self, name: &str) -> Option<StoredFile> {
        self.mounts.iter().find_map(|mount| mount.find(name))
    }

    /// A file that must exist.
    ///
    /// # Errors
    /// [`DataError::Missing`], naming it and what it is for.
    pub fn file(&self, name: &str, what: &str) -> Result<StoredFile, DataError> {
        self.find(name).ok_or_else(|| missing(what, self.mounts.len(), self.path(name)))
    }

    /// A file that is expected, not looked for: pictures, whose absence shows when they are read.
    pub fn expected(&self, name: &str) -> StoredFile {
        // A lone folder is not asked: that would be one system call per picture of every frame.
        if let [Mount::Folder(folder)] = &*self.mounts {
            return StoredFile { path: folder.join(name), place: Place::Disk };
        }
        let nowhere = || StoredFile { path: self.path(name), place: Place::Nowhere(self.mounts.len()) };
        self.find(name).unwrap_or_else(nowhere)
    }

    /// All bytes of a file that must exist.
    ///
    /// # Errors
    /// [`DataError::Missing`] or as [`StoredFile::bytes`].
    pub fn read(&self, name: &str, what: &str) -> Result<Vec<u8>, DataError> {
        self.file(name, what)?.bytes()
    }

    /// Direct children of a folder, sorted by name; none where there is no such folder. `""` is the root.
    ///
    /// # Errors
    /// [`DataError::Io`].
    pub fn list(&self, folder: &str) -> Result<Vec<StoredName>, DataError> {
        let mut names = Vec::new();
        for mount in &*self.mounts {
            names.append(&mut mount.list(folder)?);
        }
        // Stable: of two with one name, that of the earlier root stays.
        names.sort_by(|a, b| a.name.cmp(&b.name));
        names.dedup_by(|later, earlier| later.name == earlier.name);
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
