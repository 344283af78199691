//! A look at the beginning of a record: writers put a frame's context and stamp before its megabytes of sensor data.

use std::ops::ControlFlow;

/// Bytes to look at. The context of a published frame takes 2.7 kB.
pub(super) const PEEK: u64 = 8192;

/// What stands at the beginning of a frame.
#[derive(Debug, PartialEq)]
pub(super) struct Head<'a> {
    /// Encoded `Context`.
    pub context: &'a [u8],
    pub micros: i64,
}

/// Both parts, if they are there and whole. `None` says nothing about the record: it must be read.
pub(super) fn look(mut bytes: &[u8]) -> Option<Head<'_>> {
    let (mut context, mut micros) = (None, None);
    loop {
        let key = varint(&mut bytes)?;
        match (key >> 3, key & 7) {
            (1, 2) => context = Some(chunk(&mut bytes)?),
            (2, 0) => micros = Some(varint(&mut bytes)? as i64),
            (_, 0) => drop(varint(&mut bytes)?),
            (_, 1) => bytes = bytes.get(8..)?,
            (_, 2) => drop(chunk(&mut bytes)?),
            (_, 5) => bytes = bytes.get(4..)?,
            _ => return None,
        }
        if let (Some(context), Some(micros)) = (context, micros) {
            return Some(Head { context, micros });
        }
    }
}

fn chunk<'a>(bytes: &mut &'a [u8]) -> Option<&'a [u8]> {
    let length = usize::try_from(varint(bytes)?).ok()?;
    let (chunk, rest) = bytes.split_at_checked(length)?;
    *bytes = rest;
    Some(chunk)
}

/// Seven bits a byte, low ones first, at most ten bytes.
fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    let read = bytes.iter().take(10).enumerate().try_for_each(|(at, byte)| {
        value |= u64::from(byte & 0x7F) << (7 * at);
        if byte & 0x80 == 0 { ControlFlow::Break(at + 1) } else { ControlFlow::Continue(()) }
    });
    let ControlFlow::Break(length) = read else { return None };
    *bytes = bytes.get(length..)?;
    Some(value)
}

#[cfg(test)]
mod tests {
    use prost::Message;
    use rand::{RngExt, SeedableRng};

    use super::super::proto;
    use super::*;

    #[test]
    fn context_and_stamp_are_found_in_any_order_and_only_when_whole() {
        let frame = proto::Frame {
            context: Some(proto::Context::default()),
            timestamp_micros: Some(1_553_735_853_462_203),
            ..proto::Frame::default()
        };
        let bytes = frame.encode_to_vec();
        let head = Head { context: &[], micros: 1_553_735_853_462_203 };
        assert_eq!(look(&bytes), Some(head));
        for length in 0..bytes.len() {
            assert_eq!(look(&bytes[..length]), None);
        }
        // Stamp, a 32-bit and a 64-bit field, something of known length, context.
        let mixed =
            [&[0x10, 5, 0x1D, 0, 0, 0, 0, 0x19, 0, 0, 0, 0, 0, 0, 0, 0, 0x22, 2, 9, 9][..], &[0x0A, 1, 7]].concat();
        assert_eq!(look(&mixed), Some(Head { context: &[7], micros: 5 }));
        assert_eq!(look(&[0x0A, 0, 0x13]), None, "groups are not understood");
        assert_eq!(look(&[0xFF; 30]), None);
    }

    #[test]
    fn random_bytes_end() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        for _ in 0..20_000 {
            let bytes: Vec<u8> = (0..rng.random_range(0..40)).map(|_| rng.random_range(0..40)).collect();
            if let Some(head) = look(&bytes) {
                assert!(head.context.len() < bytes.len());
            }
        }
    }
}
