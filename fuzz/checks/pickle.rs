//! Any bytes are refused or decode to a value within the limits, and lists of floats survive being written again.

use pickle::{Limits, Rules, Value, decode, decode_objects, encode_floats, encode_rows};

/// Classes of the test pickles and one that Python would rather call.
const CLASSES: [(&str, &str); 3] = [("some.module", "Numbers"), ("builtins", "list"), ("m", "c")];

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    // The graph of a weight file's pickle is refused or stands; it is never executed.
    drop(decode_objects(bytes, Limits { max_bytes: 1 << 16, max_depth: 64, max_values: 4096, max_memo: 1024 }));
    let rules = Rules::new(&CLASSES);
    let Ok(value) = decode(bytes, &rules) else { return };
    let (values, depth) = measure(&value);
    assert!(values <= rules.limits.max_values, "{values} values");
    assert!(depth <= rules.limits.max_depth, "{depth} lists in one another");
    if let Some(floats) = floats(&value) {
        let again = decode(&encode_floats(&floats), &rules).expect("what is written is read");
        assert!(same(&again, &floats));
    }
    let rows: Option<Vec<Vec<f64>>> = value.items().and_then(|rows| rows.iter().map(floats).collect());
    if let Some(rows) = rows {
        let borrowed: Vec<&[f64]> = rows.iter().map(Vec::as_slice).collect();
        let again = decode(&encode_rows(&borrowed), &rules).expect("what is written is read");
        assert!(again.items().expect("a list").iter().zip(&rows).all(|(again, row)| same(again, row)));
    }
    drop((value.describe(), value.numbers::<3>(), value.rows::<3, 3>()));
}

/// Number of values and depth of the nesting.
fn measure(value: &Value) -> (usize, usize) {
    let Some(items) = value.items() else { return (1, 0) };
    items.iter().map(measure).fold((1, 1), |(values, depth), inner| (values + inner.0, depth.max(inner.1 + 1)))
}

/// The numbers of a list that holds nothing else.
fn floats(value: &Value) -> Option<Vec<f64>> {
    match value {
        Value::List(items) => items.iter().map(Value::number).collect(),
        _ => None,
    }
}

/// Bit by bit: NaN is a float like any other to a pickle.
fn same(value: &Value, floats: &[f64]) -> bool {
    let bits = |value: &Value| value.number().map(f64::to_bits);
    value.items().is_some_and(|items| items.iter().map(bits).eq(floats.iter().map(|float| Some(float.to_bits()))))
}
