//! The table of contents of an archive: names in order, found by bisection.

use std::path::{Component, Path};

use serde::{Deserialize, Serialize};

use super::{StoredName, checked_name};
use crate::DataError;

/// How an entry's bytes lie in the archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Coding {
    /// As they are, at the entry's position (tar).
    Raw,
    /// As they are, behind a local header at the entry's position (zip).
    Stored {
        /// CRC-32 of the contents.
        crc: u32,
    },
    /// Deflated, behind a local header at the entry's position (zip).
    Deflated {
        /// CRC-32 of the contents.
        crc: u32,
    },
}

/// A file of an archive.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Entry {
    /// Without `.` components.
    pub name: Box<str>,
    /// First byte of the data, or of the header before it.
    pub at: u64,
    /// Bytes in the archive.
    pub packed: u64,
    /// Bytes of the contents.
    pub size: u64,
    pub coding: Coding,
}

/// All files of an archive, sorted by name.
#[derive(Debug)]
pub(super) struct Index {
    entries: Vec<Entry>,
}

/// A name as it is looked up: without `.` components and double slashes.
pub(super) fn normal(name: &str) -> String {
    let mut plain = String::with_capacity(name.len());
    for part in Path::new(name).components().filter(|part| *part != Component::CurDir) {
        if !plain.is_empty() {
            plain.push('/');
        }
        plain.push_str(&part.as_os_str().to_string_lossy());
    }
    plain
}

/// The name of an entry, for the index. `None` for the root folder itself.
///
/// # Errors
/// [`DataError::Format`] for a name that is no UTF-8, [`DataError::UnsafePath`] for one that leaves the archive.
pub(super) fn entry_name(format: &'static str, name: &[u8], archive: &Path) -> Result<Option<Box<str>>, DataError> {
    let text = std::str::from_utf8(name).map_err(|_| {
        let why = format!("the entry name {:?} is not UTF-8", String::from_utf8_lossy(name));
        DataError::Format { format, why, path: archive.to_owned() }
    })?;
    let plain = normal(checked_name(text, archive)?);
    Ok((!plain.is_empty()).then(|| plain.into()))
}

impl Index {
    /// # Errors
    /// [`DataError::Format`] for a name that occurs twice, [`DataError::Truncated`] for an entry that reaches beyond the archive's `len`
    /// bytes, [`DataError::Empty`] for an archive without files.
    pub fn new(format: &'static str, mut entries: Vec<Entry>, len: u64, archive: &Path) -> Result<Self, DataError> {
        entries.sort_by(|a, b| a.name.cmp(&b.name));
        if let Some(pair) = entries.windows(2).find(|pair| pair[0].name == pair[1].name) {
            let why = format!("the entry {:?} occurs twice", pair[0].name);
            return Err(DataError::Format { format, why, path: archive.to_owned() });
        }
        if entries.iter().any(|entry| entry.at.checked_add(entry.packed).is_none_or(|end| end > len)) {
            return Err(DataError::Truncated { offset: len, path: archive.to_owned() });
        }
        if entries.is_empty() {
            return Err(DataError::Empty { what: format!("the {format} archive"), path: archive.to_owned() });
        }
        Ok(Self { entries })
    }

    pub fn entries(&self) -> &[Entry] {
        &self.entries
    }

    /// Row of a file.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.entries.binary_search_by(|entry| (*entry.name).cmp(name)).ok()
    }

    fn first_from(&self, name: &str) -> usize {
        self.entries.partition_point(|entry| *entry.name < *name)
    }

    /// Direct children of a folder, sorted by name. `""` is the root.
    pub fn list(&self, folder: &str) -> Vec<StoredName> {
        let prefix = if folder.is_empty() { String::new() } else { format!("{folder}/") };
        let mut names = Vec::new();
        let mut row = self.first_from(&prefix);
        while let Some(rest) = self.entries.get(row).and_then(|entry| entry.name.strip_prefix(&*prefix)) {
            match rest.split_once('/') {
                Some((child, _)) => {
                    names.push(StoredName { name: child.to_owned(), is_folder: true });
                    // '0' follows '/': the first name behind everything in that folder.
                    row = self.first_from(&format!("{prefix}{child}0"));
                }
                None => {
                    names.push(StoredName { name: rest.to_owned(), is_folder: false });
                    row += 1;
                }
            }
        }
        names.sort();
        names
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(names: &[&str]) -> Result<Index, DataError> {
        let entry = |name: &&str| Entry { name: (**name).into(), at: 0, packed: 1, size: 1, coding: Coding::Raw };
        Index::new("tar", names.iter().map(entry).collect(), 1, Path::new("a.tar"))
    }

    #[test]
    fn folders_are_listed_as_the_file_system_would() {
        let index = index(&["a/c/1", "a-b/x", "a/b", "a.txt", "a/c/2", "a0"]).unwrap();
        let names = |folder| index.list(folder).into_iter().map(|n| (n.name, n.is_folder)).collect::<Vec<_>>();
        let want = [("a", true), ("a-b", true), ("a.txt", false), ("a0", false)];
        assert_eq!(names(""), want.map(|(name, folder)| (name.to_owned(), folder)));
        assert_eq!(names("a"), [("b".to_owned(), false), ("c".to_owned(), true)]);
        assert_eq!(names("a/c").len(), 2);
        assert!(names("a/b").is_empty() && names("x").is_empty());
        assert_eq!(index.find("a/b").map(|row| &*index.entries()[row].name), Some("a/b"));
        assert!(index.find("a/").is_none() && index.find("a").is_none());
    }

    #[test]
    fn twins_and_ranges_outside_are_refused() {
        assert!(matches!(index(&["b", "a", "b"]), Err(DataError::Format { .. })));
        assert!(matches!(index(&[]), Err(DataError::Empty { .. })));
        let huge = Entry { name: "a".into(), at: u64::MAX, packed: 2, size: 2, coding: Coding::Raw };
        assert!(matches!(Index::new("zip", vec![huge], 9, Path::new("a")), Err(DataError::Truncated { .. })));
    }

    #[test]
    fn names_lose_their_dots() {
        let name = |text: &str| entry_name("zip", text.as_bytes(), Path::new("a.zip"));
        assert_eq!(name("./a//b/./c.jpg").unwrap().as_deref(), Some("a/b/c.jpg"));
        assert_eq!(name("./").unwrap(), None);
        assert!(matches!(name("a/../b"), Err(DataError::UnsafePath { .. })));
        assert!(matches!(entry_name("zip", b"a\xff", Path::new("a")), Err(DataError::Format { .. })));
    }
}
