//! Files made to hurt: the cases of the fixture folder, and random damage under a limit of memory.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use data::DataError;
use data::colmap::{Detail, Model};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{data_folder, made, read, without_tracks};

/// Set in the process that runs under a limit of memory.
const CHILD: &str = "RIGSCAPE_UNDER_LIMIT";
/// Address space of that process, kB: the fixtures' limit of 256 MB and as much again for the test program itself.
const LIMIT_KB: u32 = 512 * 1024;

/// Runs a test of this binary by its name in a process of limited memory, where an allocation by an announced length dies.
/// True in that process itself.
fn is_limited(test: &str) -> bool {
    if std::env::var_os(CHILD).is_some() {
        return true;
    }
    let limited = format!("ulimit -v {LIMIT_KB} && exec \"$0\" --exact {test} --test-threads 1");
    let output = Command::new("sh")
        .args(["-c", &limited])
        .arg(std::env::current_exe().unwrap())
        .env(CHILD, "1")
        .env("MALLOC_ARENA_MAX", "1")
        .output()
        .unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && out.contains("1 passed"), "{out}\n{err}");
    false
}

/// Case, variant of the error (`None`: it loads), a word of the message.
const CASES: [(&str, Option<&str>, &str); 8] = [
    ("base_ok", None, ""),
    ("camera_count_2p63", Some("Format"), "9223372036854775808 cameras"),
    ("point_count_2p60", Some("Format"), "1152921504606846976 features"),
    ("unknown_model", Some("Format"), "model 99"),
    ("nan_quaternion", Some("Calibration"), "rotation"),
    ("missing_camera", Some("Dangling"), "camera_id"),
    ("name_traversal", Some("UnsafePath"), "../../../../etc/passwd"),
    ("zero_focal", Some("Calibration"), "focal length"),
];

#[test]
fn the_cases_of_the_fixture_folder() {
    let Some(root) = data_folder("malformed/colmap") else { return };
    if !is_limited("colmap::hostile::the_cases_of_the_fixture_folder") {
        return;
    }
    let mut folders: Vec<String> =
        std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    folders.sort();
    let mut known: Vec<&str> = CASES.iter().map(|case| case.0).collect();
    known.sort_unstable();
    assert_eq!(folders, known);
    for (case, want, word) in CASES {
        for detail in [Detail::Whole, Detail::WithoutTracks] {
            let start = Instant::now();
            let outcome = read(&root.join(case), detail);
            assert!(start.elapsed() < Duration::from_secs(2), "{case} took {:?}", start.elapsed());
            match (want, outcome) {
                (None, outcome) => {
                    let model = outcome.unwrap();
                    assert_eq!((model.cameras.len(), model.images.len(), model.points.len()), (1, 1, 0));
                }
                (Some(want), outcome) => {
                    let error = outcome.err().unwrap_or_else(|| panic!("{case} loads"));
                    assert_eq!(variant(&error), want, "{case} gave {error:?}");
                    let text = error.to_string();
                    assert!(text.contains(word) && text.ends_with(".bin"), "{case}: {text}");
                    assert!(text.contains(root.join(case).to_str().unwrap()), "{case}: {text}");
                }
            }
        }
    }
}

fn variant(error: &DataError) -> &'static str {
    match error {
        DataError::Format { .. } => "Format",
        DataError::Truncated { .. } => "Truncated",
        DataError::Calibration { .. } => "Calibration",
        DataError::Dangling { .. } => "Dangling",
        DataError::DuplicateToken { .. } => "DuplicateToken",
        DataError::UnsafePath { .. } => "UnsafePath",
        _ => "another",
    }
}

/// Whatever is read from damaged bytes must be typed, and what loads must be a model that writes and reads again.
fn read_damaged(folder: &Path, what: &dyn std::fmt::Debug) -> Result<Model, DataError> {
    let whole = read(folder, Detail::Whole);
    let light = read(folder, Detail::WithoutTracks);
    match &whole {
        Ok(model) => {
            assert_eq!(light.unwrap().cameras.len(), model.cameras.len(), "{what:?}");
            let again = tempfile::tempdir().unwrap();
            model.write(again.path()).unwrap();
            // Bytes, not values: a damaged number may be no number.
            assert_eq!(read(again.path(), Detail::Whole).unwrap().to_bytes(), model.to_bytes(), "{what:?}");
        }
        Err(error) => {
            assert_ne!(variant(error), "another", "{what:?} gave {error:?}");
            assert!(error.to_string().ends_with(".bin"), "{what:?}: {error}");
        }
    }
    whole
}

#[test]
fn every_truncation_is_an_error() {
    if !is_limited("colmap::hostile::every_truncation_is_an_error") {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    made().write(folder.path()).unwrap();
    for (name, bytes) in made().to_bytes() {
        for length in 0..bytes.len() {
            std::fs::write(folder.path().join(name), &bytes[..length]).unwrap();
            let error = read_damaged(folder.path(), &(name, length)).unwrap_err();
            assert!(matches!(variant(&error), "Format" | "Truncated"), "{name} cut at {length}: {error:?}");
            assert!(error.to_string().ends_with(name), "{error}");
        }
        std::fs::write(folder.path().join(name), &bytes).unwrap();
    }
    assert_eq!(read(folder.path(), Detail::WithoutTracks).unwrap(), without_tracks(made()));
}

#[test]
fn random_damage_never_panics_and_stays_small() {
    if !is_limited("colmap::hostile::random_damage_never_panics_and_stays_small") {
        return;
    }
    let mut models = vec![made()];
    if let Some(root) = data_folder("wayve101") {
        models.push(read(&root.join("scene_902/colmap_sparse/rig"), Detail::Whole).unwrap());
    }
    let mut rng = ChaCha8Rng::seed_from_u64(20);
    let (mut sound, mut refused) = (0, 0);
    for (model, rounds) in models.iter().zip([6000, 300]) {
        let files = model.to_bytes();
        let folder = tempfile::tempdir().unwrap();
        model.write(folder.path()).unwrap();
        for round in 0..rounds {
            let (name, bytes) = &files[rng.random_range(0..3)];
            let mut damaged = bytes.clone();
            let damage = hurt(&mut damaged, &mut rng);
            std::fs::write(folder.path().join(name), &damaged).unwrap();
            match read_damaged(folder.path(), &(round, name, damage)) {
                Ok(_) => sound += 1,
                Err(_) => refused += 1,
            }
            std::fs::write(folder.path().join(name), bytes).unwrap();
        }
    }
    // Damage in coordinates and colours cannot be seen; damage in lengths, ids and names is.
    assert!(sound > 500 && refused > 500, "{sound} loaded, {refused} were refused");
}

/// One of: a cut, changed bytes, a length or number of the worst kind, bytes taken out, bytes put in.
fn hurt(bytes: &mut Vec<u8>, rng: &mut ChaCha8Rng) -> String {
    let at = rng.random_range(0..bytes.len());
    match rng.random_range(0..5) {
        0 => bytes.truncate(at),
        1 => (0..rng.random_range(1..4)).for_each(|_| {
            let at = rng.random_range(0..bytes.len());
            bytes[at] = rng.random();
        }),
        2 => {
            let worst = [u64::MAX, 1 << 63, 1 << 60, 1 << 32, 1 << 20, 0, f64::NAN.to_bits(), f64::MAX.to_bits(), 1];
            let number = worst[rng.random_range(0..worst.len())].to_le_bytes();
            let end = (at + 8).min(bytes.len());
            bytes[at..end].copy_from_slice(&number[..end - at]);
        }
        3 => drop(bytes.drain(at..(at + rng.random_range(1..20)).min(bytes.len()))),
        _ => drop(bytes.splice(at..at, std::iter::repeat_n(rng.random(), rng.random_range(1..20)))),
    }
    format!("at {at} of {}", bytes.len())
}
