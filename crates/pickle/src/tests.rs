//! Every opcode, every refusal, and bytes that nobody wrote on purpose.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::machine::Machine;
use super::*;

const CLASSES: [(&str, &str); 2] = [("some.module", "Numbers"), ("builtins", "list")];

fn rules() -> Rules<'static> {
    Rules::new(&CLASSES)
}

fn run(body: &[u8]) -> Result<Value, PickleError> {
    decode(&[b"\x80\x04", body].concat(), &rules())
}

fn ints(values: &[i64]) -> Value {
    Value::List(values.iter().map(|value| Value::Int(*value)).collect())
}

#[test]
fn every_kind_of_number_decodes() {
    let value =
        run(b"](G\x3f\xf8\0\0\0\0\0\0J\xfe\xff\xff\xffK\xffM\x01\x02\x8a\x01\x80\x8a\x00\x8a\x02\xff\x00e.").unwrap();
    let want = [-2, 255, 513, -128, 0, 255].map(Value::Int);
    assert_eq!(value, Value::List([vec![Value::Float(1.5)], want.to_vec()].concat()));
    assert_eq!(value.numbers::<7>().unwrap()[..3], [1.5, -2.0, 255.0]);
    assert_eq!(value.numbers::<6>(), None);
    let longest = run(b"\x8a\x08\xff\xff\xff\xff\xff\xff\xff\x7f.").unwrap();
    assert_eq!(longest, Value::Int(i64::MAX));
}

#[test]
fn tuples_none_and_text_decode() {
    assert_eq!(run(b"K\x01\x85.").unwrap(), Value::Tuple(vec![Value::Int(1)]));
    assert_eq!(run(b"K\x01K\x02\x86.").unwrap().numbers::<2>().unwrap(), [1.0, 2.0]);
    assert_eq!(run(b"K\x01K\x02K\x03\x87.").unwrap().numbers::<3>().unwrap(), [1.0, 2.0, 3.0]);
    assert_eq!(run(b"(K\x01K\x02t.").unwrap().describe(), "a tuple of 2");
    assert_eq!(run(b").").unwrap(), Value::Tuple(vec![]));
    assert_eq!(run(b"N.").unwrap(), Value::None);
    assert_eq!(run(b"\x8c\x03abc.").unwrap(), Value::Text("abc".into()));
    assert_eq!(run(b"X\x02\0\0\0ab.").unwrap(), Value::Text("ab".into()));
    let rows = run(b"](](K\x01K\x02e](K\x03K\x04ee.").unwrap();
    assert_eq!(rows.rows::<2, 2>().unwrap(), [[1.0, 2.0], [3.0, 4.0]]);
    assert_eq!(rows.rows::<2, 3>(), None);
}

#[test]
fn allowed_classes_decode_to_their_items_in_every_form() {
    let want = ints(&[7, 8]);
    // GLOBAL and NEWOBJ, STACK_GLOBAL and NEWOBJ, REDUCE, BUILD without a state.
    assert_eq!(run(b"csome.module\nNumbers\nq\0)\x81q\x01(K\x07K\x08e.").unwrap(), want);
    assert_eq!(run(b"\x8c\x0bsome.module\x94\x8c\x07Numbers\x94\x93\x94)\x81\x94(K\x07K\x08e.").unwrap(), want);
    assert_eq!(run(b"cbuiltins\nlist\n)R(K\x07K\x08e.").unwrap(), want);
    assert_eq!(run(b"csome.module\nNumbers\n)\x81(K\x07K\x08eNb.").unwrap(), want);
}

#[test]
fn a_shared_list_is_filled_after_it_was_stored_and_copied_by_value() {
    // a = [1]; [a, a]: the second is a fetch of the memo.
    assert_eq!(run(b"]\x94(]\x94K\x01ah\x01e.").unwrap(), Value::List(vec![ints(&[1]), ints(&[1])]));
    assert_eq!(run(b"]r\x05\0\0\0K\x01aj\x05\0\0\0\x86.").unwrap(), Value::Tuple(vec![ints(&[1]), ints(&[1])]));
}

#[test]
fn lists_that_hold_themselves_and_lists_that_explode_are_refused() {
    assert_eq!(run(b"]\x94h\0a.").unwrap_err(), PickleError::Limit { what: "nested lists", limit: 8 });
    // Each list holds the one before it four times: 4^7 values from a few bytes.
    let mut body = b"]\x94".to_vec();
    for index in 0..7u8 {
        body.extend([b"]\x94(".as_slice(), &[b'h', index].repeat(4), b"e"].concat());
    }
    let mut alone = b"(".to_vec();
    alone.extend(body);
    alone.extend(b"t.");
    assert_eq!(run(&alone).unwrap_err(), PickleError::Limit { what: "values", limit: 64 });
}

#[test]
fn limits_hold() {
    let floats = |count: usize| encode_floats(&vec![0.5; count]);
    assert_eq!(decode(&floats(63), &rules()).unwrap().items().unwrap().len(), 63);
    assert_eq!(decode(&floats(64), &rules()).unwrap_err(), PickleError::Limit { what: "values", limit: 64 });
    let long = vec![b'N'; 64 * 1024 + 1];
    assert_eq!(decode(&long, &rules()).unwrap_err(), PickleError::Limit { what: "bytes", limit: 64 * 1024 });
    let nested = |depth: usize| [&b"]".repeat(depth), b"a".repeat(depth - 1).as_slice(), b"."].concat();
    assert!(run(&nested(8)).is_ok());
    assert_eq!(run(&nested(9)).unwrap_err(), PickleError::Limit { what: "nested lists", limit: 8 });
    assert_eq!(run(&b"(".repeat(9)).unwrap_err(), PickleError::Limit { what: "nested lists", limit: 8 });
    let memo: Vec<u8> = (0..300u32).flat_map(|index| [b"r".as_slice(), &index.to_le_bytes()].concat()).collect();
    let memo = [b"N".as_slice(), &memo, b"."].concat();
    assert_eq!(run(&memo).unwrap_err(), PickleError::Limit { what: "memo entries", limit: 256 });
    let roomy = Rules { limits: Limits { max_memo: 300, ..rules().limits }, ..rules() };
    assert_eq!(decode(&[b"\x80\x04", memo.as_slice()].concat(), &roomy).unwrap(), Value::None);
}

#[test]
fn everything_else_is_refused_by_name() {
    let global = |module: &str, name: &str| PickleError::Global { module: module.into(), name: name.into() };
    assert_eq!(run(b"cos\nsystem\n(X\x02\0\0\0lstR.").unwrap_err(), global("os", "system"));
    assert_eq!(run(b"\x8c\x08builtins\x8c\x04eval\x93.").unwrap_err(), global("builtins", "eval"));
    assert_eq!(run(b"csome.module\nOther\n.").unwrap_err(), global("some.module", "Other"));
    // Text protocols, dictionaries, sets, bytes, persistent ids, extension codes, INST, OBJ, POP, DUP, LONG4, BINBYTES.
    assert_eq!(decode(b"(lp0\n.", &rules()).unwrap_err(), PickleError::Opcode { opcode: b'(', offset: 0 });
    for opcode in [
        b'}', b'd', b's', b'u', 0x8F, 0x90, 0x91, b'C', b'B', 0x8E, b'P', b'Q', 0x82, b'i', b'o', b'0', b'1', b'2',
        0x8B, 0x92, 0x96, 0x97,
    ] {
        assert_eq!(run(&[opcode]).unwrap_err(), PickleError::Opcode { opcode, offset: 2 }, "{opcode:#x}");
    }
    for (body, what) in [
        (&b"\x80\x04N."[..], "opcode"),
        (b"NN.", "one object"),
        (b".", "one object"),
        (b"(.", "one object"),
        (b"N.N", "last byte"),
        (b"csome.module\nNumbers\n.", "class stands"),
        (b"csome.module\nNumbers\nK\x01\x85\x81.", "arguments"),
        (b"N)R.", "no class"),
        (b"])b.", "state"),
        (b"K\x01Nb.", "state"),
        (b"K\x01K\x02a.", "no list"),
        (b"](K\x01a.", "operands"),
        (b"\x85.", "operands"),
        (b"(\x94.", "operands"),
        (b"e.", "no mark"),
        (b"h\x07.", "never stored"),
        (b"\x8a\x09123456789.", "64 bits"),
        (b"\x8c\x01\xff.", "UTF-8"),
        (b"\x95\0\0\0\0\0\0\0\x40].", "frame"),
        (b"\x8a\xff\x01.", "ends early"),
        (b"X\xff\xff\xff\xff", "ends early"),
        (b"cos", "ends early"),
        (b"NN\x93.", "no text"),
    ] {
        let error = run(body).unwrap_err().to_string();
        assert!(error.contains(what), "{body:x?} gave {error:?} instead of {what:?}");
    }
    assert!(decode(b"\x80\x01N.", &rules()).unwrap_err().to_string().contains("protocol"));
    assert_eq!(decode(b"", &rules()).unwrap_err(), PickleError::Truncated { offset: 0 });
}

#[test]
fn the_encoder_writes_what_python_writes() {
    // pickle.dumps of [], [1.5], [1.5, -2.0] and [[1.5], []] with protocol 4.
    assert_eq!(encode_floats(&[]), b"\x80\x04]\x94.");
    assert_eq!(encode_floats(&[1.5]), b"\x80\x04\x95\x0d\0\0\0\0\0\0\0]\x94G\x3f\xf8\0\0\0\0\0\0a.");
    let two = b"\x80\x04\x95\x17\0\0\0\0\0\0\0]\x94(G\x3f\xf8\0\0\0\0\0\0G\xc0\0\0\0\0\0\0\0e.";
    assert_eq!(encode_floats(&[1.5, -2.0]), two);
    let nested = b"\x80\x04\x95\x13\0\0\0\0\0\0\0]\x94(]\x94G\x3f\xf8\0\0\0\0\0\0a]\x94e.";
    assert_eq!(encode_rows(&[&[1.5], &[]]), nested);
    let rows = [[1545.0, 0.0, 960.0], [0.0, 1545.0, 560.0], [0.0, 0.0, 1.0]];
    let bytes = encode_rows(&rows.each_ref().map(|row| row.as_slice()));
    assert_eq!(decode(&bytes, &rules()).unwrap().rows::<3, 3>().unwrap(), rows);
}

/// Decodes without panicking, within memory that the input's length bounds; the value, if there is one, obeys the limits too.
fn survives(bytes: &[u8]) {
    let rules = rules();
    let mut machine = Machine::new(bytes, &rules);
    let outcome = machine.run();
    let bound = 16 * bytes.len() + 8 * 1024;
    assert!(machine.reserved() <= bound, "{} bytes for an input of {}", machine.reserved(), bytes.len());
    if let Ok(value) = outcome.and_then(|()| machine.value()) {
        assert!(format!("{value:?}").len() < 4096 + 64 * bytes.len(), "{value:?}");
    }
}

#[test]
fn random_and_mutated_bytes_never_panic_and_stay_small() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let sound = [
        encode_floats(&[0.1, -2.0, 3e9]),
        encode_rows(&[&[1.0, 2.0], &[3.0, 4.0]]),
        b"\x80\x02csome.module\nNumbers\nq\0)\x81q\x01(K\x07K\x08e.".to_vec(),
        b"\x80\x04\x8c\x0bsome.module\x94\x8c\x07Numbers\x94\x93\x94)\x81\x94(K\x07\x8a\x01\x02e.".to_vec(),
        b"\x80\x05](K\x01\x85h\0t\x86X\x01\0\0\0ae.".to_vec(),
    ];
    let opcodes = b"\x80\x95NGJKM\x8a\x8cX\x94qrhj(]ae)t\x85\x86\x87c\x93\x81Rb.";
    for round in 0..60_000 {
        let mut bytes = vec![0u8; rng.random_range(0..200)];
        rng.fill_bytes(&mut bytes);
        match round % 3 {
            0 => {}
            1 => bytes.iter_mut().for_each(|byte| *byte = opcodes[usize::from(*byte) % opcodes.len()]),
            _ => {
                bytes = sound[rng.random_range(0..sound.len())].clone();
                for _ in 0..rng.random_range(1..5) {
                    let at = rng.random_range(0..bytes.len());
                    match rng.random_range(0..4) {
                        0 => bytes[at] = rng.random(),
                        1 => bytes[at] ^= 1 << rng.random_range(0..8),
                        2 => bytes.insert(at, opcodes[rng.random_range(0..opcodes.len())]),
                        _ if bytes.len() > 1 => _ = bytes.remove(at),
                        _ => {}
                    }
                }
            }
        }
        survives(&bytes);
        survives(&[b"\x80\x04", bytes.as_slice()].concat());
    }
    for whole in &sound {
        (0..whole.len()).for_each(|length| survives(&whole[..length]));
    }
    // Long inputs of fetches, marks and appends, the cheapest ways to grow.
    for unit in [&b"h\0"[..], b"h\0h\0a", b"(e", b"](h\0h\0e", b")", b"r\0\0\0\0"] {
        survives(&[b"\x80\x04]\x94".as_slice(), &unit.repeat(60_000 / unit.len()), b"."].concat());
    }
}
