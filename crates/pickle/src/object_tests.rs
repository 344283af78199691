//! Object graphs: every opcode that only they have, circles, and that nothing in them is ever called.

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

const LIMITS: Limits = Limits { max_bytes: 64 * 1024, max_depth: 64, max_values: 4096, max_memo: 4096 };

fn with_root<R>(body: &[u8], check: impl FnOnce(Object<'_>) -> R) -> R {
    let bytes = [b"\x80\x02", body].concat();
    let (graph, taken) = decode_objects(&bytes, LIMITS).unwrap();
    assert_eq!(taken, bytes.len());
    check(graph.root())
}

fn refusal(body: &[u8]) -> PickleError {
    decode_objects(&[b"\x80\x02", body].concat(), LIMITS).unwrap_err()
}

#[test]
fn calls_stay_records() {
    with_root(b"cos\nsystem\nX\x0c\0\0\0touch /tmp/x\x85R.", |root| {
        let ((module, name), arguments) = root.call().unwrap();
        assert_eq!((module, name, arguments[0].text()), ("os", "system", Some("touch /tmp/x")));
        assert_eq!(root.describe(), "an instance of os.system");
        assert!(root.entries().is_none() && root.items().is_none());
    });
    // A class made with keywords, then given a state: a Lightning checkpoint's hyper parameters look like this.
    with_root(b"csome.module\nConfig\n)}\x92}X\x01\0\0\0aK\x01sb.", |root| {
        assert_eq!(root.call().unwrap().0, ("some.module", "Config"));
    });
    // What is called may itself be the result of a call.
    with_root(b"coperator\nattrgetter\nX\x06\0\0\0system\x85Rcos\npath\n\x85R.", |root| {
        assert!(root.call().is_none());
        assert_eq!(root.describe(), "an instance of something");
    });
}

#[test]
fn dictionaries_and_their_subclasses_have_entries() {
    with_root(b"}(X\x01\0\0\0aK\x01X\x01\0\0\0bNu.", |root| {
        assert_eq!(root.get("a").unwrap().integer(), Some(1));
        assert!(root.get("b").unwrap().is_none() && root.get("c").is_none());
        assert_eq!(root.describe(), "a dictionary of 2");
    });
    with_root(b"ccollections\nOrderedDict\n)Rq\0X\x01\0\0\0aK\x07s}X\x09\0\0\0_metadataNsb.", |root| {
        assert_eq!(root.entries().unwrap().len(), 1);
        assert_eq!(root.get("a").unwrap().integer(), Some(7));
    });
    with_root(b"csome.module\nDict\n)RX\x01\0\0\0aK\x07s.", |root| assert!(root.entries().is_none()));
}

#[test]
fn every_other_kind_decodes() {
    let body: &[u8] = b"(\x88\x89\x8b\x01\0\0\0\xff\x8a\x0a123456789\x01\x8d\x02\0\0\0\0\0\0\0abC\x01xB\x01\0\0\0x\
        \x8e\x01\0\0\0\0\0\0\0x\x96\x01\0\0\0\0\0\0\0xU\x02hiU\x01\xffT\x02\0\0\0hi\x8f(K\x01\x90(K\x01\x91\
        K\x05QNN0(NN1t.";
    with_root(body, |root| {
        let items = root.items().unwrap();
        let kinds: Vec<String> = items.iter().map(|item| item.describe()).collect();
        let expected = ["a truth value"; 2].iter().chain(&["a number"; 2]).chain(&["text"]).chain(&["bytes"; 4]);
        let expected = expected.chain(&["text", "bytes", "text", "a set of 1", "a set of 1"]);
        let expected: Vec<&str> = expected.chain(&["an object outside the pickle", "None"]).copied().collect();
        assert_eq!(kinds, expected);
        assert_eq!((items[0].truth(), items[1].truth(), items[2].truth()), (Some(true), Some(false), None));
        assert_eq!((items[5].bytes(), items[10].bytes()), (Some(&b"x"[..]), Some(&b"\xff"[..])));
        assert_eq!(items[2].integer(), Some(-1));
        assert_eq!(items[3].long_digits(), Some(&b"123456789\x01"[..]));
        assert_eq!(items[14].persistent_id().unwrap().integer(), Some(5));
    });
    let bytes = [b"\x80\x02", body].concat();
    let (graph, _) = decode_objects(&bytes, LIMITS).unwrap();
    assert_eq!(graph.persistent_ids().map(|id| id.integer()).collect::<Vec<_>>(), [Some(5)]);
}

#[test]
fn circles_are_no_danger_and_the_rest_of_the_input_is_left() {
    with_root(b"}q\0X\x04\0\0\0selfh\0s.", |root| {
        let inner = root.get("self").unwrap().get("self").unwrap();
        assert_eq!(inner.describe(), "a dictionary of 1");
    });
    let (_, taken) = decode_objects(b"\x80\x02N.\x80\x02K\x01.", LIMITS).unwrap();
    assert_eq!(taken, 4);
    let (graph, _) = decode_objects(&b"\x80\x02N.\x80\x02K\x01."[taken..], LIMITS).unwrap();
    assert_eq!(graph.root().integer(), Some(1));
}

#[test]
fn damage_and_excess_are_refused() {
    for (body, what) in [
        (&b"}K\x01s."[..], "operands"),
        (b"}(K\x01u.", "without a value"),
        (b"]K\x01K\x02s.", "no dictionary"),
        (b"](K\x01\x90.", "no set"),
        (b"cos\nsystem\nNR.", "no tuple"),
        (b"]Nb.", "no instance"),
        (b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff.", "ends early"),
        (b"B\xff\xff\xff\xff.", "ends early"),
        (b"1.", "no mark"),
        (b"NN.", "one object"),
        (b"N", "ends early"),
    ] {
        let error = refusal(body).to_string();
        assert!(error.contains(what), "{body:x?} gave {error:?} instead of {what:?}");
    }
    for opcode in [b'P', b'i', b'o', b'2', 0x82, 0x97, 0x98] {
        assert_eq!(refusal(&[opcode]), PickleError::Opcode { opcode, offset: 2 });
    }
    assert_eq!(refusal(&[b'N'; 5000]), PickleError::Limit { what: "values", limit: 4096 });
    assert_eq!(refusal(&[b'('; 65]), PickleError::Limit { what: "nested lists", limit: 64 });
    let long = [b")0".repeat(10), b")0".repeat(40_000)].concat();
    assert!(matches!(refusal(&long), PickleError::Limit { .. }));
}

#[test]
fn random_and_mutated_graphs_never_panic_and_stay_small() {
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let sound: [&[u8]; 2] = [
        b"\x80\x02ccollections\nOrderedDict\nq\0)Rq\x01X\x01\0\0\0actorch._utils\n_rebuild_tensor_v2\n((X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\x000X\x03\0\0\0cpuK\x04tQK\0K\x02K\x02\x86K\x02K\x01\x86\x89h\0)RtRs.",
        b"\x80\x04}(\x8c\x05epochK\x01\x8c\x05stateccallbacks\nA\n)\x81}\x8c\x01xC\x02abs.",
    ];
    let opcodes =
        b"NGJKM\x8a\x8cX\x94qrhj(]ae)t\x85\x86\x87c\x93\x81Rb\x88\x89\x8b\x8dCB\x8e\x96UT}su\x8f\x90\x91\x92Q01.";
    for round in 0..60_000 {
        let mut bytes = vec![0u8; rng.random_range(0..200)];
        rng.fill_bytes(&mut bytes);
        if round % 2 == 0 {
            bytes.iter_mut().for_each(|byte| *byte = opcodes[usize::from(*byte) % opcodes.len()]);
            bytes = [b"\x80\x02", bytes.as_slice()].concat();
        } else {
            bytes = sound[round % 4 / 2].to_vec();
            for _ in 0..rng.random_range(1..5) {
                let at = rng.random_range(2..bytes.len());
                bytes[at] = opcodes[rng.random_range(0..opcodes.len())];
            }
        }
        let mut machine = machine::Machine::speaking(&bytes, machine::Dialect::Objects, LIMITS);
        let outcome = machine.run_to_end_marker();
        let bound = 128 * bytes.len() + 8 * 1024;
        assert!(machine.reserved() <= bound, "{} bytes for an input of {}", machine.reserved(), bytes.len());
        if outcome.is_ok() {
            let (graph, _) = decode_objects(&bytes, LIMITS).unwrap();
            assert!(!graph.root().describe().is_empty());
        }
    }
}
