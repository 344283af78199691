//! Small file helpers: writes that survive a power cut, checksums.

use std::fs::{self, File};
use std::io::{Read, Write};
use std::path::Path;

use sha2::{Digest, Sha256};

use crate::TrainError;

/// Makes sure that the file's content is on the disk.
pub(crate) fn sync_file(path: &Path) -> Result<(), TrainError> {
    let file = File::open(path).map_err(TrainError::io("open", path))?;
    file.sync_all().map_err(TrainError::io("sync", path))
}

/// Makes sure that the names inside the folder are on the disk. Only Unix lets a folder be opened for that.
pub(crate) fn sync_folder(path: &Path) -> Result<(), TrainError> {
    if cfg!(unix) { sync_file(path) } else { Ok(()) }
}

/// Writes a new file and syncs it.
pub(crate) fn write_synced(path: &Path, content: &[u8]) -> Result<(), TrainError> {
    let mut file = File::create(path).map_err(TrainError::io("create", path))?;
    file.write_all(content).map_err(TrainError::io("write", path))?;
    file.sync_all().map_err(TrainError::io("sync", path))
}

/// Replaces a file so that at every moment either the old or the new content is there.
///
/// # Errors
/// [`TrainError`] naming the file.
pub fn replace_file(path: &Path, content: &[u8]) -> Result<(), TrainError> {
    let mut name = std::ffi::OsString::from(".tmp-");
    name.push(path.file_name().unwrap_or_default());
    let beside = path.with_file_name(name);
    write_synced(&beside, content)?;
    fs::rename(&beside, path).map_err(TrainError::io("rename", path))?;
    path.parent().map_or(Ok(()), sync_folder)
}

/// Length in bytes and SHA-256 of a file, in hexadecimal.
///
/// # Errors
/// [`TrainError`] naming the file.
pub fn fingerprint(path: &Path) -> Result<(u64, String), TrainError> {
    let mut file = File::open(path).map_err(TrainError::io("open", path))?;
    let mut hash = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    let mut length = 0;
    loop {
        let count = file.read(&mut buffer).map_err(TrainError::io("read", path))?;
        if count == 0 {
            return Ok((length, hex(&hash.finalize())));
        }
        hash.update(&buffer[..count]);
        length += count as u64;
    }
}

/// SHA-256 of bytes in memory.
pub(crate) fn sha256(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}
