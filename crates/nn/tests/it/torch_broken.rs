//! Damaged and hostile torch files: typed errors that name the file, no memory beyond the file's size, nothing executed.

use std::io::Write;
use std::path::Path;

use nn::weights::{TorchFault, WeightError, WeightFile};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::torch::fixture;

/// An archive of these entries.
fn archive(entries: &[(&str, &[u8])], method: CompressionMethod) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut writer = ZipWriter::new(file.reopen().unwrap());
    for (name, bytes) in entries {
        writer.start_file(*name, SimpleFileOptions::default().compression_method(method)).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap();
    file
}

fn stored(pickle: &[u8], storage: &[u8]) -> tempfile::NamedTempFile {
    archive(&[("a/data.pkl", pickle), ("a/data/0", storage)], CompressionMethod::Stored)
}

fn fault_of(path: &Path) -> TorchFault {
    let error = WeightFile::open(path).unwrap_err();
    assert!(error.to_string().ends_with(&path.display().to_string()), "{error}");
    match error {
        WeightError::Torch { source, .. } => source,
        other => panic!("{other}"),
    }
}

/// `{"w": <tensor>}` with these numbers, as bytes of a pickle.
fn tensor_pickle(announced: u8, offset: u8, size: &[u8], strides: &[u8]) -> Vec<u8> {
    let numbers = |values: &[u8]| -> Vec<u8> {
        [b"(".to_vec(), values.iter().flat_map(|value| [b'K', *value]).collect(), b"t".to_vec()].concat()
    };
    [
        &b"\x80\x02}X\x01\0\0\0wctorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\n"[..],
        b"X\x01\0\0\x000X\x03\0\0\0cpuK",
        &[announced],
        b"tQK",
        &[offset],
        &numbers(size),
        &numbers(strides),
        b"\x89ccollections\nOrderedDict\n)RtRs.",
    ]
    .concat()
}

#[test]
fn sizes_are_compared_with_the_storage_that_is_there() {
    let values: Vec<u8> = [1.0_f32, 2.0, 3.0, 4.0].iter().flat_map(|value| value.to_le_bytes()).collect();
    let sound = stored(&tensor_pickle(4, 1, &[3], &[1]), &values);
    assert_eq!(WeightFile::open(sound.path()).unwrap().tensor("w").unwrap().data, [2.0, 3.0, 4.0]);
    for (pickle, what) in [
        (tensor_pickle(4, 2, &[3], &[1]), "leave the 16 bytes"),
        (tensor_pickle(4, 0, &[2, 2], &[3, 1]), "leave the 16 bytes"),
        (tensor_pickle(5, 0, &[1], &[1]), "5 elements announced"),
        (tensor_pickle(4, 0, &[2, 2], &[1]), "2 sizes and 1 strides"),
        (tensor_pickle(4, 0, &[200, 200], &[0, 0]), "holds more than"),
        (tensor_pickle(4, 0, &[255; 9], &[0; 9]), "overflows"),
    ] {
        let file = stored(&pickle, &values);
        let fault = fault_of(file.path());
        assert!(matches!(&fault, TorchFault::Tensor { name, .. } if name == "w"), "{fault}");
        assert!(fault.to_string().contains(what), "{fault} instead of {what}");
    }
    let absent = archive(&[("a/data.pkl", &tensor_pickle(4, 0, &[1], &[1]))], CompressionMethod::Stored);
    assert!(fault_of(absent.path()).to_string().contains("no storage 0"));
}

#[test]
fn many_names_for_the_same_bytes_are_refused() {
    let one = tensor_pickle(4, 0, &[4], &[1]);
    let body = |index: u8| [&b"X\x01\0\0\0"[..], &[b'A' + index], &one[9..one.len() - 1]].concat();
    let many = [b"\x80\x02}".to_vec(), (0..17).flat_map(body).collect(), b".".to_vec()].concat();
    let fault = fault_of(stored(&many, &[0; 16]).path());
    assert!(fault.to_string().contains("more than 16 times"), "{fault}");
    let few = [b"\x80\x02}".to_vec(), (0..16).flat_map(body).collect(), b".".to_vec()].concat();
    assert_eq!(WeightFile::open(stored(&few, &[0; 16]).path()).unwrap().names().count(), 16);
    let twice = [b"\x80\x02}".to_vec(), body(0), body(0), b".".to_vec()].concat();
    assert!(fault_of(stored(&twice, &[0; 16]).path()).to_string().contains("given twice"));
}

#[test]
fn archives_that_unfold_overlap_or_are_incomplete_are_refused() {
    let pickle = tensor_pickle(4, 0, &[4], &[1]);
    let bomb = archive(&[("a/data.pkl", &pickle), ("a/data/0", &vec![0; 1 << 24])], CompressionMethod::Deflated);
    assert!(bomb.as_file().metadata().unwrap().len() < 1 << 16);
    assert!(fault_of(bomb.path()).to_string().contains("compressed"));
    for (entries, what) in [
        (vec![("a/other", &b""[..])], "without data.pkl"),
        (vec![("a/data.pkl", &pickle[..]), ("b/data.pkl", &pickle)], "more than one data.pkl"),
        (vec![("a/data.pkl", &pickle[..]), ("a/byteorder", b"big"), ("a/data/0", &[0; 16])], "big-endian"),
    ] {
        let fault = fault_of(archive(&entries, CompressionMethod::Stored).path());
        assert!(fault.to_string().contains(what), "{fault} instead of {what}");
    }
    // Two entries under one name: the second one's name is patched in its local header and in the directory.
    let twin =
        archive(&[("a/data.pkl", &pickle), ("a/data/0", &[0; 16]), ("a/data/1", &[1; 16])], CompressionMethod::Stored);
    let mut bytes = std::fs::read(twin.path()).unwrap();
    let places: Vec<usize> = (0..bytes.len() - 8).filter(|at| &bytes[*at..*at + 8] == b"a/data/1").collect();
    assert_eq!(places.len(), 2);
    places.iter().for_each(|at| bytes[at + 7] = b'0');
    std::fs::write(twin.path(), &bytes).unwrap();
    assert!(fault_of(twin.path()).to_string().contains("one name"));
}

#[test]
fn pickles_that_would_run_code_only_fail_to_be_state_dicts() {
    let folder = tempfile::tempdir().unwrap();
    let mark = folder.path().join("executed");
    let command = format!("touch {}", mark.display());
    let call = |module: &str, name: &str| {
        let length = (command.len() as u32).to_le_bytes();
        [format!("c{module}\n{name}\nX").as_bytes(), &length, command.as_bytes(), b"\x85R"].concat()
    };
    for (module, name) in [("os", "system"), ("posix", "system"), ("subprocess", "call"), ("builtins", "eval")] {
        let alone = [b"\x80\x02".to_vec(), call(module, name), b".".to_vec()].concat();
        let file = stored(&alone, &[]);
        let fault = fault_of(file.path());
        assert!(fault.to_string().contains(&format!("an instance of {module}.{name}")), "{fault}");
        // Beside a sound tensor the call is an entry that is no tensor.
        let tensor = tensor_pickle(4, 0, &[4], &[1]);
        let beside = [&tensor[..tensor.len() - 1], b"X\x01\0\0\0x", &call(module, name), b"s."].concat();
        let file = WeightFile::open(stored(&beside, &[0; 16]).path()).unwrap();
        assert_eq!((file.names().collect::<Vec<_>>(), file.others()), (vec!["w"], &["x".to_owned()][..]));
    }
    assert!(!mark.exists());
    for (bytes, what) in [(&b"\x80\x02N"[..], "ends early"), (b"(lp0\n.", "opcode"), (b"\x80\x02N.x", "end marker")] {
        let fault = fault_of(stored(bytes, &[]).path());
        assert!(fault.to_string().contains(what), "{fault} instead of {what}");
    }
}

#[test]
fn older_files_are_checked_as_closely() {
    let sound = std::fs::read(fixture("types_legacy.pth")).unwrap();
    let file = tempfile::NamedTempFile::new().unwrap();
    let fault = |bytes: &[u8]| {
        std::fs::write(file.path(), bytes).unwrap();
        fault_of(file.path()).to_string()
    };
    assert!(fault(&sound[..sound.len() - 1]).contains("ends behind the file"));
    assert!(fault(&[sound.as_slice(), b"x"].concat()).contains("1 bytes behind the last storage"));
    assert!(fault(&sound[..20]).contains("ends early"));
    let mut other_version = sound.clone();
    assert_eq!(&other_version[15..19], [0x80, 2, b'M', 0xE9].as_slice());
    other_version[18] = 0;
    assert!(fault(&other_version).contains("version"));
    let big = [b"little_endian".as_slice(), b"q"].concat();
    let at = sound.windows(big.len()).position(|part| part == big).unwrap() + big.len() + 1;
    let mut big_endian = sound.clone();
    assert_eq!(big_endian[at], 0x88);
    big_endian[at] = 0x89;
    assert!(fault(&big_endian).contains("big-endian"));
}

/// Every fixture with single bytes changed and cut anywhere: an error or a file, never a panic, and tensors that read.
#[test]
fn damage_anywhere_never_panics() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let mut opened = 0;
    for name in ["types.pth", "layouts_legacy.pth", "lightning.ckpt"] {
        let sound = std::fs::read(fixture(name)).unwrap();
        let mut attempt = |bytes: &[u8]| {
            std::fs::write(file.path(), bytes).unwrap();
            if let Ok(weights) = WeightFile::open(file.path()) {
                opened += usize::from(weights.read_all().is_ok());
            }
        };
        for at in (0..sound.len()).step_by(19) {
            attempt(&sound[..at]);
            let mut changed = sound.clone();
            changed[at] ^= 1 << (at % 8);
            attempt(&changed);
            changed[at] = 0xFF;
            attempt(&changed);
        }
    }
    assert!(opened > 50, "only {opened} files opened: the damage is too coarse to test anything");
}
