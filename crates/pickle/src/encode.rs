//! Lists of floats as Python's own pickler writes them in protocol 4, byte for byte.

/// Python frames only contents of at least this many bytes.
const SHORTEST_FRAME: usize = 4;

/// The pickle of a list of floats.
pub fn encode_floats(values: &[f64]) -> Vec<u8> {
    framed(&list(values.iter().map(|value| float(*value)).collect()))
}

/// The pickle of a list of lists of floats.
pub fn encode_rows(rows: &[&[f64]]) -> Vec<u8> {
    let inner = |row: &&[f64]| list(row.iter().map(|value| float(*value)).collect());
    framed(&list(rows.iter().map(inner).collect()))
}

fn float(value: f64) -> Vec<u8> {
    [&b"G"[..], &value.to_be_bytes()].concat()
}

/// Empty list, its memo entry, then the items: one by APPEND, more between MARK and APPENDS in batches of a thousand.
fn list(items: Vec<Vec<u8>>) -> Vec<u8> {
    let mut bytes = b"]\x94".to_vec();
    for batch in items.chunks(1000) {
        match batch {
            [single] => bytes.extend([single.as_slice(), b"a"].concat()),
            many => bytes.extend([b"(", many.concat().as_slice(), b"e"].concat()),
        }
    }
    bytes
}

fn framed(object: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x80\x04".to_vec();
    let length = object.len() + 1;
    if length >= SHORTEST_FRAME {
        bytes.push(0x95);
        bytes.extend((length as u64).to_le_bytes());
    }
    bytes.extend(object);
    bytes.push(b'.');
    bytes
}
