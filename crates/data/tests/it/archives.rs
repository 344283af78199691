//! Datasets inside archives: the same frames and bytes as from folders, and nothing from archives that are not sound.

mod broken;
mod fixture;
mod forms;
mod pieces;

use std::io::{Cursor, Write};
use std::path::{Path, PathBuf};

use data::DataError;
use data::store::{Root, Roots, Store, StoredFile};
use zip::CompressionMethod;
use zip::write::SimpleFileOptions;

/// A zip archive of these files.
fn zip_bytes(files: &[(&str, &[u8])], options: SimpleFileOptions) -> Vec<u8> {
    let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        writer.start_file(*name, options).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

fn stored() -> SimpleFileOptions {
    SimpleFileOptions::default().compression_method(CompressionMethod::Stored)
}

fn deflated() -> SimpleFileOptions {
    SimpleFileOptions::default().compression_method(CompressionMethod::Deflated)
}

/// A tar archive of these files; long names in the GNU form.
fn tar_bytes(files: &[(&str, &[u8])]) -> Vec<u8> {
    let mut builder = tar::Builder::new(Vec::new());
    for (name, bytes) in files {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        builder.append_data(&mut header, name, *bytes).unwrap();
    }
    builder.into_inner().unwrap()
}

/// All files below a folder, with names relative to it.
fn files_below(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let store = Store::open(folder).unwrap();
    let mut open = vec![String::new()];
    let mut files = Vec::new();
    while let Some(folder) = open.pop() {
        for child in store.list(&folder).unwrap() {
            let name = if folder.is_empty() { child.name } else { format!("{folder}/{}", child.name) };
            if child.is_folder {
                open.push(name);
            } else {
                let bytes = store.read(&name, "file").unwrap();
                files.push((name, bytes));
            }
        }
    }
    files.sort();
    files
}

fn all_files(store: &Store) -> Vec<(String, StoredFile)> {
    let mut open = vec![String::new()];
    let mut files = Vec::new();
    while let Some(folder) = open.pop() {
        for child in store.list(&folder).unwrap() {
            let name = if folder.is_empty() { child.name } else { format!("{folder}/{}", child.name) };
            if child.is_folder {
                open.push(name);
            } else {
                files.push((name.clone(), store.file(&name, "file").unwrap()));
            }
        }
    }
    files.sort();
    files
}

fn borrowed(files: &[(String, Vec<u8>)]) -> Vec<(&str, &[u8])> {
    files.iter().map(|(name, bytes)| (name.as_str(), bytes.as_slice())).collect()
}

fn write(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path
}

fn roots<const N: usize>(paths: [PathBuf; N]) -> Roots {
    Roots::new(paths.map(Root::from))
}

fn variant(error: &DataError) -> &'static str {
    match error {
        DataError::Missing { .. } => "Missing",
        DataError::Format { .. } => "Format",
        DataError::Checksum { .. } => "Checksum",
        DataError::Truncated { .. } => "Truncated",
        DataError::UnsafePath { .. } => "UnsafePath",
        DataError::Empty { .. } => "Empty",
        DataError::Config(_) => "Config",
        _ => "another",
    }
}
