//! Archives that are not sound: typed errors that name the archive, whatever the bytes.

use std::io::Read;
use std::path::Path;
use std::time::{Duration, Instant};

use data::DataError;
use data::store::Store;
use rand::{Rng, RngExt, SeedableRng};

use super::super::nuscenes::folder;
use super::{all_files, deflated, stored, tar_bytes, variant, write, zip_bytes};

/// Opens an archive and reads every file in it, in all ways.
fn read_everything(path: &Path) -> Result<Vec<(String, Vec<u8>)>, DataError> {
    let store = Store::open(path)?;
    let mut files = Vec::new();
    for (name, file) in all_files(&store) {
        let bytes = file.bytes()?;
        let mut streamed = Vec::new();
        file.reader()?.read_to_end(&mut streamed).map_err(|error| file.read_failure(error))?;
        assert!(bytes == streamed, "{file}");
        file.ends(7)?;
        files.push((name, bytes));
    }
    Ok(files)
}

#[test]
fn the_cases_of_the_fixture_folder() {
    let Some(root) = folder("RIGSCAPE_DATA", "malformed") else { return };
    let readme = std::fs::read_to_string(root.join("README.md")).unwrap();
    let listed = readme.lines().filter(|line| line.starts_with("| `archive/")).count();
    let cases = [
        ("base_ok.zip", ""),
        ("entry_traversal.zip", "UnsafePath"),
        ("entry_absolute.zip", "UnsafePath"),
        ("encrypted_flag.zip", "Format"),
        ("declared_size_4g.zip", "Format"),
        ("base_ok.tar", ""),
        ("symlink_out.tar", "Format"),
        ("bad_checksum.tar", "Format"),
    ];
    assert_eq!(listed, cases.len());
    assert_eq!(std::fs::read_dir(root.join("archive")).unwrap().count(), cases.len());
    for (name, want) in cases {
        let start = Instant::now();
        let outcome = read_everything(&root.join("archive").join(name));
        assert!(start.elapsed() < Duration::from_secs(2));
        if want.is_empty() {
            assert_eq!(outcome.unwrap()[0].1.len(), 350, "{name}");
            continue;
        }
        let error = outcome.unwrap_err();
        assert_eq!(variant(&error), want, "{name}: {error:?}");
        assert!(error.to_string().ends_with(name), "{error}");
    }
    assert!(!Path::new("evil.jpg").exists() && !Path::new("../../evil.jpg").exists());
}

/// The first place of these bytes.
fn place(bytes: &[u8], what: &[u8]) -> usize {
    bytes.windows(what.len()).position(|window| window == what).unwrap()
}

fn refused(name: &str, bytes: &[u8], want: &str) {
    let folder = tempfile::tempdir().unwrap();
    let error = read_everything(&write(folder.path(), name, bytes)).unwrap_err();
    assert_eq!(variant(&error), want, "{error:?}");
    assert!(error.to_string().contains(name), "{error}");
}

#[test]
fn zips_that_lie_are_refused() {
    let sound = zip_bytes(&[("a.txt", b"hello hello hello hello"), ("b.txt", b"world")], stored());
    let packed = zip_bytes(&[("a.txt", &[7; 5000])], deflated());
    let patched = |bytes: &[u8], signature: &[u8], offset: usize, new: &[u8]| {
        let mut bytes = bytes.to_vec();
        let at = place(&bytes, signature) + offset;
        bytes[at..at + new.len()].copy_from_slice(new);
        bytes
    };
    const DIRECTORY: &[u8] = b"PK\x01\x02";
    const LOCAL: &[u8] = b"PK\x03\x04";
    const END: &[u8] = b"PK\x05\x06";
    let twin: Vec<u8> = {
        let mut bytes = sound.clone();
        while let Some(at) = bytes.windows(5).position(|window| window == b"b.txt") {
            bytes[at] = b'a';
        }
        bytes
    };
    refused("twin.zip", &twin, "Format");
    refused("method.zip", &patched(&sound, DIRECTORY, 10, &[12, 0]), "Format");
    refused("local_method.zip", &patched(&sound, LOCAL, 8, &[8, 0]), "Format");
    refused("local_encrypted.zip", &patched(&sound, LOCAL, 6, &[1, 0]), "Format");
    refused("local_gone.zip", &patched(&sound, LOCAL, 0, b"QK"), "Format");
    refused("local_name.zip", &patched(&sound, LOCAL, 26, &[0xFF, 0xFF]), "Truncated");
    refused("wrong_crc.zip", &patched(&sound, DIRECTORY, 16, &[1, 2, 3, 4]), "Checksum");
    refused("flipped_data.zip", &patched(&sound, b"hello", 1, b"E"), "Checksum");
    refused("disk.zip", &patched(&sound, END, 4, &[1, 0]), "Format");
    refused("too_few.zip", &patched(&sound, END, 8, &[1, 0, 1, 0]), "Format");
    refused("too_many.zip", &patched(&sound, END, 8, &[3, 0, 3, 0]), "Format");
    refused("directory_at.zip", &patched(&sound, END, 16, &[0xF0; 4]), "Format");
    refused("directory_size.zip", &patched(&sound, END, 12, &[5, 0, 0, 0]), "Format");
    refused("name_len.zip", &patched(&sound, DIRECTORY, 28, &[0xFF, 0xFF]), "Format");
    refused("name_no_text.zip", &patched(&sound, DIRECTORY, 46, &[0xFF]), "Format");
    refused("offset.zip", &patched(&sound, DIRECTORY, 42, &[0xEE, 0xEE, 0xEE, 0]), "Format");
    // A Unix symbolic link.
    let link = patched(&sound, DIRECTORY, 4, &[20, 3]);
    refused("link.zip", &patched(&link, DIRECTORY, 40, &0o120_777u16.to_le_bytes()), "Format");
    // Inflates to more, and to less, than announced; a bomb's announcement; damaged deflate data.
    refused("longer.zip", &patched(&packed, DIRECTORY, 24, &4000u32.to_le_bytes()), "Format");
    refused("shorter.zip", &patched(&packed, DIRECTORY, 24, &6000u32.to_le_bytes()), "Truncated");
    refused("bomb.zip", &patched(&packed, DIRECTORY, 24, &0xFFFF_FFF0u32.to_le_bytes()), "Format");
    refused("damaged.zip", &patched(&packed, b"a.txt", 6, &[0xFF; 6]), "Format");
    refused("empty.zip", &zip_bytes(&[], stored()), "Empty");
    refused("text.zip", b"this is no archive at all", "Format");
    refused("nothing.zip", b"", "Format");
}

#[test]
fn tars_that_lie_are_refused() {
    let entry = |kind: tar::EntryType, name: &str, link: &str| {
        let mut header = tar::Header::new_ustar();
        header.as_old_mut().name[..name.len()].copy_from_slice(name.as_bytes());
        header.set_entry_type(kind);
        header.set_size(0);
        if !link.is_empty() {
            header.set_link_name(link).unwrap();
        }
        header.set_cksum();
        let mut bytes = header.as_bytes().to_vec();
        bytes.resize(512 * 3, 0);
        bytes
    };
    use tar::EntryType::*;
    for kind in [Symlink, Link, Char, Block, Fifo, Continuous, GNUSparse] {
        refused("kind.tar", &entry(kind, "a", "b"), "Format");
    }
    for name in ["../a", "/a", "a/../../b", "C:/a", "a\\b"] {
        refused("name.tar", &entry(Regular, name, ""), "UnsafePath");
    }
    refused("folder.tar", &entry(Directory, "../a/", ""), "UnsafePath");
    refused("twin.tar", &tar_bytes(&[("a", b"1"), ("b", b"2"), ("a", b"3")]), "Format");
    let sound = tar_bytes(&[("a", &[1; 700])]);
    refused("cut.tar", &sound[..1000], "Truncated");
    refused("cut_header.tar", &sound[..300], "Format");
    refused("text.tar", &[b'x'; 2048], "Format");
    refused("nothing.tar", b"", "Empty");
    refused("zeros.tar", &[0; 4096], "Empty");
    // A long-name header that announces 2^60 bytes.
    let mut header = tar::Header::new_gnu();
    header.set_path("././@LongLink").unwrap();
    header.set_entry_type(GNULongName);
    header.as_old_mut().size = [0x80, 0, 0, 0, 0x10, 0, 0, 0, 0, 0, 0, 0];
    header.set_cksum();
    refused("long.tar", &[header.as_bytes().as_slice(), &[b'n'; 4096]].concat(), "Format");
    // One that really is two megabytes long.
    header.set_size(2 << 20);
    header.set_cksum();
    refused("long_name.tar", &[header.as_bytes().as_slice(), &vec![b'n'; (2 << 20) + 4096]].concat(), "Format");
}

#[test]
fn no_truncation_and_no_flipped_byte_does_harm() {
    let text: Vec<u8> = (0..3000u32).map(|i| ((i * i) >> 5) as u8).collect();
    let files: [(&str, &[u8]); 3] = [("a/one", &text), ("a/two", b"22"), ("b", &text[..700])];
    let want: Vec<(String, Vec<u8>)> = files.map(|(name, bytes)| (name.to_owned(), bytes.to_vec())).into();
    let folder = tempfile::tempdir().unwrap();
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(5);
    for (name, bytes, has_checksums) in [
        ("stored.zip", zip_bytes(&files, stored()), true),
        ("large.zip", zip_bytes(&files, stored().large_file(true)), true),
        ("deflated.zip", zip_bytes(&files, deflated()), true),
        ("plain.tar", tar_bytes(&files), false),
    ] {
        assert_eq!(read_everything(&write(folder.path(), name, &bytes)).unwrap(), want);
        for length in (0..bytes.len()).step_by(13) {
            let outcome = read_everything(&write(folder.path(), name, &bytes[..length]));
            match outcome {
                // A tar that is cut between two files, or in the zeros behind the last, cannot be told from a whole one.
                Ok(files) => assert!(!has_checksums && files.iter().all(|file| want.contains(file)), "{name} {length}"),
                Err(error) => assert!(error.to_string().contains(name), "{error}"),
            }
        }
        for _ in 0..1500 {
            let mut bytes = bytes.clone();
            for _ in 0..rng.random_range(1..4) {
                let at = rng.random_range(0..bytes.len());
                bytes[at] = rng.next_u32() as u8;
            }
            match read_everything(&write(folder.path(), name, &bytes)) {
                // Names and dates carry no checksum in a zip; contents do.
                Ok(files) if has_checksums => {
                    assert!(files.iter().all(|file| want.iter().any(|want| want.1 == file.1)), "{name}");
                }
                Ok(_) => {}
                Err(error) => assert!(error.to_string().contains(name), "{error}"),
            }
        }
    }
}
