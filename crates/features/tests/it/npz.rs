//! Arrays of an `.npz` file, enough for the reference features.

use std::io::Read;
use std::path::Path;

/// Shape and values of one array of f32, f64 or u8.
pub fn array(path: &Path, name: &str) -> (Vec<usize>, Vec<f32>) {
    let mut archive = zip::ZipArchive::new(std::fs::File::open(path).unwrap()).unwrap();
    let mut bytes = Vec::new();
    archive.by_name(&format!("{name}.npy")).unwrap().read_to_end(&mut bytes).unwrap();
    let header_length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..10 + header_length]).unwrap();
    let between = |from: &str, to: &str| header.split_once(from).unwrap().1.split_once(to).unwrap().0;
    let lengths = between("'shape': (", ")").split(',').filter(|part| !part.trim().is_empty());
    let shape = lengths.map(|length| length.trim().parse().unwrap()).collect();
    let data = &bytes[10 + header_length..];
    let values = match between("'descr': '", "'") {
        "<f4" => data.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b)).collect(),
        "<f8" => data.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32).collect(),
        "|u1" => data.iter().map(|b| f32::from(*b)).collect(),
        other => panic!("{name} is {other}"),
    };
    (shape, values)
}
