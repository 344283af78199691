use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// A file of these payloads.
pub(crate) fn encode(payloads: &[Vec<u8>]) -> Vec<u8> {
    let record = |payload: &Vec<u8>| {
        let length = (payload.len() as u64).to_le_bytes();
        [&length[..], &masked_crc32c(&length).to_le_bytes(), payload, &masked_crc32c(payload).to_le_bytes()].concat()
    };
    payloads.iter().flat_map(record).collect()
}

struct Scratch {
    _folder: tempfile::TempDir,
    path: PathBuf,
}

impl Scratch {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        Self { path: folder.path().join("x.tfrecord"), _folder: folder }
    }

    fn file(&self, bytes: &[u8]) -> StoredFile {
        std::fs::write(&self.path, bytes).unwrap();
        self.path.clone().into()
    }

    /// All payloads, or the first error.
    fn read(&self, bytes: &[u8], peek: u64) -> Result<Vec<Vec<u8>>, DataError> {
        let file = self.file(bytes);
        let mut spans = Vec::new();
        index(&file, peek, |span, head| {
            assert_eq!(head.len() as u64, span.length.min(peek));
            spans.push((span, head.to_vec()));
            Ok(())
        })?;
        let whole = |(span, head): (RecordSpan, Vec<u8>)| {
            let payload = payload(&file, span)?;
            assert!(payload.starts_with(&head));
            Ok(payload.to_vec())
        };
        spans.into_iter().map(whole).collect()
    }
}

fn payloads(rng: &mut ChaCha8Rng) -> Vec<Vec<u8>> {
    let count = rng.random_range(0..5);
    (0..count).map(|_| (0..rng.random_range(0..80)).map(|_| rng.random()).collect()).collect()
}

#[test]
fn the_checksum_is_the_published_one() {
    // "123456789" has the CRC-32C e3069283; the mask is applied by hand.
    assert_eq!(crc32c::crc32c(b"123456789"), 0xe306_9283);
    assert_eq!(masked_crc32c(b"123456789"), 0x2507_c60du32.wrapping_add(0xa282_ead8));
}

#[test]
fn records_come_back_whatever_they_hold() {
    let (mut rng, scratch) = (ChaCha8Rng::seed_from_u64(1), Scratch::new());
    for _ in 0..300 {
        let payloads = payloads(&mut rng);
        for peek in [0, 7, 1000] {
            assert_eq!(scratch.read(&encode(&payloads), peek).unwrap(), payloads);
        }
    }
}

#[test]
fn every_changed_bit_is_found() {
    let scratch = Scratch::new();
    let sound = encode(&[b"first record".to_vec(), Vec::new(), b"third".to_vec()]);
    for bit in 0..sound.len() * 8 {
        let mut broken = sound.clone();
        broken[bit / 8] ^= 1 << (bit % 8);
        let error = scratch.read(&broken, 5).unwrap_err();
        assert!(matches!(error, DataError::Checksum { .. }), "bit {bit}: {error:?}");
        assert!(error.to_string().ends_with("x.tfrecord"), "{error}");
    }
}

#[test]
fn every_cut_inside_a_record_is_found() {
    let scratch = Scratch::new();
    let payloads = [b"first record".to_vec(), Vec::new(), b"third".to_vec()];
    let sound = encode(&payloads);
    let borders: Vec<usize> = (0..=payloads.len()).map(|n| encode(&payloads[..n]).len()).collect();
    for length in 0..=sound.len() {
        let outcome = scratch.read(&sound[..length], 3);
        match borders.iter().position(|border| *border == length) {
            Some(whole) => assert_eq!(outcome.unwrap(), payloads[..whole]),
            None => match outcome.unwrap_err() {
                DataError::Truncated { offset, .. } => assert_eq!(offset, length as u64),
                other => panic!("{length}: {other:?}"),
            },
        }
    }
}

#[test]
fn random_and_mutated_bytes_give_an_error_or_the_records_that_are_there() {
    let (mut rng, scratch) = (ChaCha8Rng::seed_from_u64(2), Scratch::new());
    let mut refused = 0;
    for round in 0..1500 {
        let payloads = payloads(&mut rng);
        let mut bytes = if round % 3 == 0 { Vec::new() } else { encode(&payloads) };
        for _ in 0..rng.random_range(1..6) {
            let at = rng.random_range(0..=bytes.len());
            match rng.random_range(0..4) {
                0 => bytes.truncate(at),
                1 => drop(bytes.splice(at..at, (0..rng.random_range(1..40)).map(|_| rng.random::<u8>()))),
                2 => drop(bytes.splice(at.., encode(&[vec![7; at % 50]]))),
                _ => bytes.iter_mut().skip(at).take(3).for_each(|byte| *byte = rng.random()),
            }
        }
        match scratch.read(&bytes, 16) {
            // What is read whole is the file's own content, byte for byte.
            Ok(read) => assert_eq!(encode(&read), bytes),
            Err(DataError::Checksum { offset, .. } | DataError::Truncated { offset, .. }) => {
                assert!(offset <= bytes.len() as u64);
                refused += 1;
            }
            Err(other) => panic!("{other:?}"),
        }
    }
    assert!(refused > 700, "{refused}");
}

#[test]
fn lengths_with_a_right_checksum_reserve_nothing() {
    let scratch = Scratch::new();
    for length in [u64::MAX, u64::MAX - 15, u64::MAX - 16, 1 << 62, 1 << 40, 17] {
        let length = length.to_le_bytes();
        let bytes = [&length[..], &masked_crc32c(&length).to_le_bytes(), &[0; 20]].concat();
        assert!(matches!(scratch.read(&bytes, 8), Err(DataError::Truncated { offset: 32, .. })));
    }
}
