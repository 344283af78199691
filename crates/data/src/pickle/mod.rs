//! Python pickles as data: lists of numbers, decoded without importing, calling or executing anything.
//!
//! The format is a small stack language (protocols 2 to 5, `pickletools` documents it). [`decode`] knows the opcodes that lists, tuples,
//! numbers, text and named list classes need; every other opcode, and every global that the caller did not name, is refused.

mod encode;
mod machine;

pub use encode::{encode_floats, encode_rows};

/// What a pickle may hold and how large it may be.
#[derive(Debug, Clone, Copy)]
pub struct Rules<'a> {
    /// Module and name of the classes that are lists by another name. An instance decodes to its items.
    pub list_classes: &'a [(&'a str, &'a str)],
    /// Longest input, bytes.
    pub max_bytes: usize,
    /// Deepest nesting of lists and tuples.
    pub max_depth: usize,
    /// Most values, counting lists, tuples, classes and texts, and counting a shared list as often as it is used.
    pub max_values: usize,
    /// Most entries of the memo.
    pub max_memo: usize,
}

impl<'a> Rules<'a> {
    /// Limits that fit a calibration: 64 kB, depth 8, 64 values, 256 memo entries.
    pub const fn new(list_classes: &'a [(&'a str, &'a str)]) -> Self {
        Self { list_classes, max_bytes: 64 * 1024, max_depth: 8, max_values: 64, max_memo: 256 }
    }
}

/// A decoded object. Lists that Python shared are copies here.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `None`.
    None,
    /// An integer of at most 64 bits.
    Int(i64),
    /// A float.
    Float(f64),
    /// A string.
    Text(String),
    /// A list, or an instance of an allowed list class.
    List(Vec<Self>),
    /// A tuple.
    Tuple(Vec<Self>),
}

impl Value {
    /// A float or an integer as f64.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Int(value) => Some(*value as f64),
            Self::Float(value) => Some(*value),
            _ => None,
        }
    }

    /// The items of a list or tuple.
    pub fn items(&self) -> Option<&[Self]> {
        match self {
            Self::List(items) | Self::Tuple(items) => Some(items),
            _ => None,
        }
    }

    /// A list or tuple of exactly `N` numbers.
    pub fn numbers<const N: usize>(&self) -> Option<[f64; N]> {
        let numbers: Option<Vec<f64>> = self.items()?.iter().map(Self::number).collect();
        numbers?.try_into().ok()
    }

    /// Exactly `R` rows of exactly `C` numbers.
    pub fn rows<const R: usize, const C: usize>(&self) -> Option<[[f64; C]; R]> {
        let rows: Option<Vec<[f64; C]>> = self.items()?.iter().map(Self::numbers).collect();
        rows?.try_into().ok()
    }

    /// Kind and length, for messages.
    pub fn describe(&self) -> String {
        match self {
            Self::None => "None".to_owned(),
            Self::Int(_) | Self::Float(_) => "one number".to_owned(),
            Self::Text(_) => "text".to_owned(),
            Self::List(items) => format!("a list of {}", items.len()),
            Self::Tuple(items) => format!("a tuple of {}", items.len()),
        }
    }
}

/// A pickle that is refused.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PickleError {
    /// The bytes end inside an opcode or before the end marker.
    #[error("the pickle ends early at byte {offset}")]
    Truncated {
        /// Where the missing part would begin.
        offset: usize,
    },
    /// An opcode that is not needed for data, or text opcodes of protocols 0 and 1.
    #[error("opcode 0x{opcode:02x} at byte {offset} is not allowed")]
    Opcode {
        /// The byte.
        opcode: u8,
        /// Its place.
        offset: usize,
    },
    /// A class or function that the caller did not name.
    #[error("global {module}.{name} is not allowed")]
    Global {
        /// Python module.
        module: String,
        /// Name inside it.
        name: String,
    },
    /// Opcodes in an order that makes no object.
    #[error("{what} at byte {offset}")]
    Malformed {
        /// Complaint.
        what: &'static str,
        /// The opcode's place.
        offset: usize,
    },
    /// More than the [`Rules`] allow.
    #[error("more than {limit} {what}")]
    Limit {
        /// Bytes, values, nested lists or memo entries.
        what: &'static str,
        /// The allowed number.
        limit: usize,
    },
}

/// Decodes one pickle that fills `bytes` exactly.
///
/// Memory stays below a small multiple of the input's length, whatever lengths the input announces.
///
/// # Errors
/// Everything but one allowed object: see [`PickleError`].
pub fn decode(bytes: &[u8], rules: &Rules<'_>) -> Result<Value, PickleError> {
    let mut machine = machine::Machine::new(bytes, rules);
    machine.run()?;
    machine.value()
}

#[cfg(test)]
mod tests;
