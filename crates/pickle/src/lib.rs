//! Python pickles as data, decoded without importing, calling or executing anything.
//!
//! The format is a small stack language (protocols 2 to 5, `pickletools` documents it). There are two ways to read it:
//! [`decode`] for lists of numbers knows the opcodes that lists, tuples, numbers, text and named list classes need and refuses
//! every other opcode and every global that the caller did not name. [`decode_objects`] takes any object graph, but a global
//! stays a name and a call stays its record.

mod cursor;
mod encode;
mod graph;
mod machine;
mod node;
mod objects;
mod value;

pub use encode::{encode_floats, encode_rows};
pub use graph::{Graph, Object, decode_objects};
pub use value::Value;

/// How large a pickle may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Longest input, bytes.
    pub max_bytes: usize,
    /// Deepest nesting of lists and tuples; in object graphs, of open marks.
    pub max_depth: usize,
    /// Most values, counting lists, tuples, classes and texts; [`decode`] counts a shared list as often as it is used.
    pub max_values: usize,
    /// Most entries of the memo.
    pub max_memo: usize,
}

/// What [`decode`] allows.
#[derive(Debug, Clone, Copy)]
pub struct Rules<'a> {
    /// Module and name of the classes that are lists by another name. An instance decodes to its items.
    pub list_classes: &'a [(&'a str, &'a str)],
    /// How much of it.
    pub limits: Limits,
}

impl<'a> Rules<'a> {
    /// Limits that fit a calibration: 64 kB, depth 8, 64 values, 256 memo entries.
    pub const fn new(list_classes: &'a [(&'a str, &'a str)]) -> Self {
        let limits = Limits { max_bytes: 64 * 1024, max_depth: 8, max_values: 64, max_memo: 256 };
        Self { list_classes, limits }
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
mod object_tests;
#[cfg(test)]
mod tests;
