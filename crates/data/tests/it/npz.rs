//! NumPy files: every element type and order, the broken cases of the fixture folder, and damaged bytes.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use data::DataError;
use data::npz::{Dtype, Npz, Want, npy_bytes, npz_bytes, parse_npy, read_npy};
use data::occupancy::{read_occ3d, read_open_occupancy, read_surround_occ};
use data::store::StoredFile;
use geometry::Rigid;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The fixture folder, if the tests know it.
fn folder(inside: &str) -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_DATA") else {
        eprintln!("did not run: RIGSCAPE_DATA is not set");
        return None;
    };
    let path = Path::new(&root).join(inside);
    assert!(path.exists(), "RIGSCAPE_DATA is set, but {} does not exist", path.display());
    Some(path)
}

fn stored(folder: &Path, name: &str, bytes: &[u8]) -> StoredFile {
    let path = folder.join(name);
    std::fs::write(&path, bytes).unwrap();
    path.into()
}

#[test]
fn all_element_types_come_back() {
    let dir = tempfile::tempdir().unwrap();
    let bytes_of = |dtype: Dtype, value: i8| -> Vec<u8> {
        let value = i64::from(value);
        match dtype {
            Dtype::F16 => half::f16::from_f64(value as f64).to_le_bytes().to_vec(),
            Dtype::F32 => (value as f32).to_le_bytes().to_vec(),
            Dtype::F64 => (value as f64).to_le_bytes().to_vec(),
            _ => value.to_le_bytes()[..dtype.size()].to_vec(),
        }
    };
    for dtype in Dtype::ALL {
        let signed = !matches!(dtype, Dtype::Bool | Dtype::U8 | Dtype::U16 | Dtype::U32 | Dtype::U64);
        let values: [i8; 6] = if signed { [-128, -1, 0, 1, 77, 127] } else { [0, 1, 1, 0, 1, 1] };
        let bytes: Vec<u8> = values.iter().flat_map(|value| bytes_of(dtype, *value)).collect();
        let file = stored(dir.path(), "a.npy", &npy_bytes(dtype, &[2, 3], &bytes).unwrap());
        let array = read_npy(&file, &Want { dtypes: &[dtype], shape: &[None, Some(3)] }).unwrap();
        assert_eq!((array.dtype(), array.shape(), array.len()), (dtype, &[2, 3][..], 6));
        assert_eq!(array.to_i64().unwrap(), values.map(i64::from), "{dtype:?}");
        assert_eq!(array.to_f64(), values.map(f64::from), "{dtype:?}");
        assert_eq!(array.into_u8().is_ok(), dtype.size() == 1);
    }
    let large = npy_bytes(Dtype::U64, &[2], &[[5, 0, 0, 0, 0, 0, 0, 0], [255; 8]].concat()).unwrap();
    let want = Want { dtypes: &Dtype::ALL, shape: &[None] };
    assert_eq!(read_npy(&stored(dir.path(), "b.npy", &large), &want).unwrap().to_i64(), Err(1));
    let half = npy_bytes(Dtype::F32, &[2], &[3f32.to_le_bytes(), 0.5f32.to_le_bytes()].concat()).unwrap();
    assert_eq!(read_npy(&stored(dir.path(), "c.npy", &half), &want).unwrap().to_i64(), Err(1));
    assert!(npy_bytes(Dtype::U8, &[3], &[1, 2]).is_err());
}

#[test]
fn versions_and_orders_are_equal() {
    let usual = npy_bytes(Dtype::U8, &[2, 3, 2], &(0..12).collect::<Vec<u8>>()).unwrap();
    let want = Want { dtypes: &[Dtype::U8], shape: &[Some(2), Some(3), Some(2)] };
    let read = |bytes: &[u8]| parse_npy(bytes, Path::new("a.npy"), &want);
    let reference = read(&usual).unwrap();
    for version in [2, 3] {
        let mut wide = usual.clone();
        wide[6] = version;
        wide.splice(10..10, [0, 0]);
        assert_eq!(read(&wide).unwrap(), reference);
    }
    let mut wrong = usual.clone();
    wrong[6] = 4;
    assert!(matches!(read(&wrong), Err(DataError::Format { .. })));
    // The same elements with the first axis running fastest.
    let text = String::from_utf8_lossy(&usual[10..128]).replace("False", "True ");
    let place = |x: usize, y: usize, z: usize| ((x * 3 + y) * 2 + z) as u8;
    let mut fortran = [&usual[..10], text.as_bytes()].concat();
    for z in 0..2 {
        for y in 0..3 {
            (0..2).for_each(|x| fortran.push(place(x, y, z)));
        }
    }
    assert_eq!(read(&fortran).unwrap().into_u8().unwrap(), (0..12).collect::<Vec<u8>>());
    assert!(matches!(read(&[usual.as_slice(), &[0]].concat()), Err(DataError::Format { .. })));
    for length in 0..usual.len() {
        let error = read(&usual[..length]).unwrap_err();
        assert!(matches!(error, DataError::Truncated { .. }), "{length} bytes gave {error:?}");
    }
}

fn outcome(file: &StoredFile, name: &str) -> Result<(), DataError> {
    match name {
        name if name.starts_with("openoccupancy") => read_open_occupancy(file, Rigid::IDENTITY).map(drop),
        name if name.starts_with("surroundocc") => read_surround_occ(file, Rigid::IDENTITY).map(drop),
        _ => read_occ3d(file, true).map(drop),
    }
}

#[test]
fn the_cases_of_the_fixture_folder() {
    let Some(root) = folder("malformed/npz") else { return };
    let mut names: Vec<String> =
        std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!(names.len(), 10);
    for name in names {
        let file = StoredFile::from(root.join(&name));
        let start = Instant::now();
        let outcome = outcome(&file, &name);
        assert!(start.elapsed() < Duration::from_secs(2), "{name} took {:?}", start.elapsed());
        if name == "base_ok.npz" {
            outcome.unwrap();
            continue;
        }
        let error = outcome.expect_err(&name);
        let text = error.to_string();
        assert!(text.ends_with(&name), "{text}");
        let says = |words: &[&str]| words.iter().all(|word| text.contains(word));
        let right = match name.as_str() {
            "wrong_shape.npz" => {
                matches!(error, DataError::Array { .. }) && says(&["[100, 100, 16]", "[200, 200, 16]"])
            }
            "giant_shape.npz" => matches!(error, DataError::Array { .. }) && says(&["1000000", "[200, 200, 16]"]),
            "wrong_dtype.npz" => matches!(error, DataError::Array { .. }) && says(&["<f8", "|u1"]),
            "object_array.npz" => matches!(error, DataError::Array { .. }) && says(&["|O"]),
            "label_out_of_range.npz" => matches!(error, DataError::Format { .. }) && says(&["label 200"]),
            "missing_key.npz" => matches!(error, DataError::Missing { .. }) && says(&["mask_camera"]),
            "truncated.npz" => matches!(error, DataError::Format { format: "npz", .. }),
            "openoccupancy_index_out_of_range.npy" => {
                matches!(error, DataError::Format { .. }) && says(&["row", "45", "600", "outside"])
            }
            "surroundocc_3_columns.npy" => matches!(error, DataError::Array { .. }) && says(&["[1, 3]", "[any, 4]"]),
            _ => panic!("{name} is not listed"),
        };
        assert!(right, "{name} gave {error:?}: {text}");
    }
    let without_masks = read_occ3d(&root.join("missing_key.npz").into(), false).unwrap();
    assert!(without_masks.lidar_mask.is_none() && without_masks.camera_mask.is_none());
    assert!(!Path::new("rigscape_pwned").exists());
}

#[test]
fn the_sound_case_is_read_in_the_right_order() {
    let Some(root) = folder("malformed/npz") else { return };
    let grid = read_occ3d(&root.join("base_ok.npz").into(), true).unwrap();
    for z in 0..16 {
        for y in 0..200 {
            for x in 0..200 {
                assert_eq!(usize::from(grid.label([z, y, x]).unwrap()), (3 * x + 5 * y + 7 * z) % 18);
            }
        }
    }
}

/// Bytes changed in one to eight places, or cut, or prolonged.
fn damaged(bytes: &[u8], first: usize, random: &mut impl Rng) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    match random.random_range(0..6) {
        0 => bytes.truncate(random.random_range(0..bytes.len())),
        1 => bytes.extend((0..random.random_range(1..20)).map(|_| random.random::<u8>())),
        _ => {
            for _ in 0..random.random_range(1..=8) {
                let at = random.random_range(0..first.min(bytes.len()));
                bytes[at] = random.random();
            }
        }
    }
    bytes
}

#[test]
fn damaged_archives_are_errors_that_name_the_file_and_never_wrong_arrays() {
    let values: Vec<u8> = (0..1000u32).map(|at| (at * at % 251) as u8).collect();
    let arrays = [("a", Dtype::U8, &[10, 100][..], values.as_slice()), ("b", Dtype::Bool, &[4], &[1, 0, 0, 1])];
    let sound = npz_bytes(&arrays).unwrap();
    assert_eq!(sound, npz_bytes(&arrays).unwrap());
    let want = Want { dtypes: &[Dtype::U8], shape: &[Some(10), Some(100)] };
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let (mut refused, rounds) = (0, 40_000);
    for _ in 0..rounds {
        let bytes = damaged(&sound, sound.len(), &mut random);
        match Npz::parse(bytes, Path::new("x.npz")).and_then(|mut npz| npz.array("a", &want)) {
            // Checksums see to it that what is read is what was written.
            Ok(array) => assert_eq!(array.into_u8().unwrap(), values),
            Err(error) => {
                assert!(error.to_string().ends_with("x.npz"), "{error}");
                refused += 1;
            }
        }
    }
    assert!(refused > rounds / 4, "only {refused} of {rounds} refused");
}

#[test]
fn damaged_headers_are_refused_or_keep_the_wanted_shape() {
    let sound = npy_bytes(Dtype::U16, &[25, 4], &[7; 200]).unwrap();
    let want = Want { dtypes: &Dtype::ALL, shape: &[None, Some(4)] };
    let mut random = ChaCha8Rng::seed_from_u64(2);
    let mut refused = 0;
    for _ in 0..100_000 {
        match parse_npy(&damaged(&sound, 80, &mut random), Path::new("x.npy"), &want) {
            Ok(array) => assert!(array.shape().len() == 2 && array.shape()[1] == 4 && array.len() % 4 == 0),
            Err(error) => {
                assert!(error.to_string().ends_with("x.npy"), "{error}");
                refused += 1;
            }
        }
    }
    assert!(refused > 60_000, "only {refused} refused");
}
