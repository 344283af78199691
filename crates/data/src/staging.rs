//! Writing with the file's name in every error, and a folder that appears whole or not at all.

use std::path::{Path, PathBuf};

use tempfile::TempDir;

use crate::DataError;

/// Present in every folder this crate wrote; only such a folder, or an empty one, may be replaced.
pub(crate) const MANIFEST: &str = "manifest.json";

/// An error of the operating system with its file.
pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> DataError {
    move |source| DataError::Io { action, source, path: path.to_owned() }
}

/// Writes a whole file.
pub(crate) fn write(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    std::fs::write(path, bytes).map_err(io("write", path))
}

/// Writes a whole file under a temporary name beside its own, then renames it, so that no reader meets half a file.
pub(crate) fn write_renamed(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    if let Some(parent) = path.parent().filter(|parent| !parent.as_os_str().is_empty()) {
        create_dir(parent)?;
    }
    let mut name = path.file_name().unwrap_or_default().to_owned();
    name.push(".part");
    let part = path.with_file_name(name);
    write(&part, bytes)?;
    std::fs::rename(&part, path).map_err(io("write", path))
}

/// Makes a folder and those above it.
pub(crate) fn create_dir(path: &Path) -> Result<(), DataError> {
    std::fs::create_dir_all(path).map_err(io("make the folder", path))
}

/// A folder under construction next to its final place; removed when dropped before [`Staging::publish`].
#[derive(Debug)]
pub(crate) struct Staging {
    shell: TempDir,
    target: PathBuf,
}

impl Staging {
    /// # Errors
    /// The target exists and may not be replaced: `force` is missing, or it is not empty and no [`MANIFEST`] lies in it.
    pub(crate) fn new(target: &Path, force: bool) -> Result<Self, DataError> {
        check_target(target, force)?;
        let parent = match target.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
        create_dir(parent)?;
        let shell = tempfile::Builder::new()
            .prefix(".rigscape-partial-")
            .tempdir_in(parent)
            .map_err(io("make a temporary folder in", parent))?;
        let staging = Self { shell, target: target.to_owned() };
        // The data lies one level deeper because the temporary folder itself is readable by its owner only.
        create_dir(&staging.folder())?;
        Ok(staging)
    }

    /// Where to write.
    pub(crate) fn folder(&self) -> PathBuf {
        self.shell.path().join("data")
    }

    /// Moves the finished folder to its place; what was there is removed.
    pub(crate) fn publish(self) -> Result<(), DataError> {
        let old = self.shell.path().join("old");
        if self.target.exists() {
            std::fs::rename(&self.target, &old).map_err(io("move away", &self.target))?;
        }
        if let Err(source) = std::fs::rename(self.folder(), &self.target) {
            // Put the former folder back, so that a failed replacement costs nothing; the first error is the one to report.
            if old.exists() {
                std::fs::rename(&old, &self.target).map_err(io("restore", &self.target))?;
            }
            return Err(DataError::Io { action: "move the finished data to", source, path: self.target });
        }
        let shell = self.shell.path().to_owned();
        self.shell.close().map_err(io("remove", &shell))
    }
}

pub(crate) fn check_target(target: &Path, force: bool) -> Result<(), DataError> {
    if std::fs::symlink_metadata(target).is_err() {
        return Ok(());
    }
    let shown = target.display();
    if !target.is_dir() {
        return Err(DataError::Config(format!("the output must be a folder, but something else is there: {shown}")));
    }
    let is_empty = std::fs::read_dir(target).map_err(io("list", target))?.next().is_none();
    if !force && !is_empty {
        return Err(DataError::Config(format!(
            "the output exists already; choose another folder or force it: {shown}"
        )));
    }
    if !is_empty && !target.join(MANIFEST).is_file() {
        return Err(DataError::Config(format!(
            "refusing to replace a folder without a {MANIFEST}, it was not written by rigscape: {shown}"
        )));
    }
    Ok(())
}

/// Names become parts of paths and keys: plain and different from each other.
pub(crate) fn check_names(what: &str, names: &[String]) -> Result<(), DataError> {
    let mut sorted: Vec<&String> = names.iter().collect();
    sorted.sort();
    if let Some(twice) = sorted.windows(2).find(|pair| pair[0] == pair[1]) {
        return Err(DataError::Config(format!("{what} {:?} occurs twice", twice[0])));
    }
    let plain = |name: &str| {
        !name.is_empty()
            && !name.starts_with('.')
            && name.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.'))
    };
    match names.iter().find(|name| !plain(name)) {
        Some(name) => {
            Err(DataError::Config(format!("{what} {name:?} may hold letters, digits, '-', '_' and '.' only")))
        }
        None => Ok(()),
    }
}

/// Lower-case hexadecimal digits.
pub(crate) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dropped_staging_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("out");
        let staging = Staging::new(&target, false).unwrap();
        write(&staging.folder().join("a"), b"x").unwrap();
        drop(staging);
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
    }

    #[test]
    fn only_our_own_folders_are_replaced_and_only_when_forced() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("deep/out");
        let publish = |force: bool, text: &[u8]| {
            let staging = Staging::new(&target, force)?;
            write(&staging.folder().join(MANIFEST), text)?;
            staging.publish()
        };
        publish(false, b"one").unwrap();
        let error = publish(false, b"two").unwrap_err().to_string();
        assert!(error.contains("exists already") && error.contains("out"), "{error}");
        publish(true, b"two").unwrap();
        assert_eq!(std::fs::read(target.join(MANIFEST)).unwrap(), b"two");
        std::fs::rename(target.join(MANIFEST), target.join("holiday.txt")).unwrap();
        let error = publish(true, b"three").unwrap_err().to_string();
        assert!(error.contains("not written by rigscape"), "{error}");
        assert_eq!(std::fs::read_dir(dir.path().join("deep")).unwrap().count(), 1);
    }
}
