//! One root of a store.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::archive::Archive;
use super::file::Place;
use super::{Root, StoredFile, StoredName, checked_name, index};
use crate::DataError;

/// A folder or an archive that is searched for names.
#[derive(Debug)]
pub(super) enum Mount {
    Folder(PathBuf),
    Archive {
        archive: Arc<Archive>,
        /// Folder inside it that is the root, with a slash behind; or nothing.
        prefix: String,
    },
}

impl Mount {
    pub fn open(root: &Root) -> Result<Self, DataError> {
        let path = std::path::absolute(&root.path).map_err(|source| DataError::Io {
            action: "resolve",
            source,
            path: root.path.clone(),
        })?;
        let root = Root { path, ..root.clone() };
        if !root.inside.is_empty() {
            checked_name(&root.inside, &root.path)?;
        }
        let inside = index::normal(&root.inside);
        let missing = |what: &str| DataError::Missing { what: what.to_owned(), path: root.shown() };
        if root.path.is_dir() {
            let folder = if inside.is_empty() { root.path.clone() } else { root.path.join(&inside) };
            return if folder.is_dir() { Ok(Self::Folder(folder)) } else { Err(missing("dataset folder")) };
        }
        if !root.path.is_file() {
            return Err(missing("dataset folder or archive"));
        }
        let archive = Arc::new(Archive::open(&root.path, root.index_cache.as_deref())?);
        if archive.index().list(&inside).is_empty() {
            return Err(missing("folder inside the archive"));
        }
        let prefix = if inside.is_empty() { inside } else { inside + "/" };
        Ok(Self::Archive { archive, prefix })
    }

    pub fn path(&self, name: &str) -> PathBuf {
        match self {
            Self::Folder(folder) => folder.join(name),
            Self::Archive { archive, prefix } => archive.path().join(prefix).join(name),
        }
    }

    pub fn find(&self, name: &str) -> Option<StoredFile> {
        match self {
            Self::Folder(folder) => {
                let path = folder.join(name);
                path.is_file().then_some(StoredFile { path, place: Place::Disk })
            }
            Self::Archive { archive, prefix } => {
                let (row, path) = archive.find(&format!("{prefix}{}", index::normal(name)))?;
                Some(StoredFile { path, place: Place::Entry { archive: archive.clone(), row } })
            }
        }
    }

    pub fn list(&self, folder: &str) -> Result<Vec<StoredName>, DataError> {
        match self {
            Self::Folder(root) => list_folder(&root.join(folder)),
            Self::Archive { archive, prefix } => {
                let folder = format!("{prefix}{}", index::normal(folder));
                Ok(archive.index().list(folder.trim_end_matches('/')))
            }
        }
    }
}

fn list_folder(path: &Path) -> Result<Vec<StoredName>, DataError> {
    if !path.is_dir() {
        return Ok(Vec::new());
    }
    let io = |source| DataError::Io { action: "list", source, path: path.to_owned() };
    let mut names = Vec::new();
    for entry in std::fs::read_dir(path).map_err(io)? {
        let entry = entry.map_err(io)?;
        // Names that are no text cannot be named by any table.
        if let Ok(name) = entry.file_name().into_string() {
            names.push(StoredName { name, is_folder: entry.path().is_dir() });
        }
    }
    Ok(names)
}
