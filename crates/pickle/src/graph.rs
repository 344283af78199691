//! Whole object graphs as data: [`decode_objects`] takes any classes and functions and makes none of them.

use super::machine::{Dialect, Machine};
use super::node::Node;
use super::{Limits, PickleError};

/// A decoded object graph. Objects may be shared and may refer to each other in circles.
#[derive(Debug)]
pub struct Graph<'b> {
    arena: Vec<Node<'b>>,
    root: u32,
}

/// Decodes the pickle at the front of `bytes` into a graph; returns it with the number of bytes it took.
///
/// A global is its module and name, an instance the record of the call that Python would have made, a persistent id its
/// operand. Nothing is looked up, so every name is harmless.
///
/// # Errors
/// See [`PickleError`]; protocols 0 and 1, extension codes and out-of-band buffers are refused.
pub fn decode_objects(bytes: &[u8], limits: Limits) -> Result<(Graph<'_>, usize), PickleError> {
    let mut machine = Machine::speaking(bytes, Dialect::Objects, limits);
    machine.run_to_end_marker()?;
    let root = machine.root()?;
    Ok((Graph { root, arena: machine.arena }, machine.cursor.at))
}

impl<'b> Graph<'b> {
    /// The pickled object.
    #[must_use]
    pub fn root(&self) -> Object<'_> {
        Object { graph: self, index: self.root }
    }

    /// Operands of all persistent ids, in the order of the pickle.
    pub fn persistent_ids(&self) -> impl Iterator<Item = Object<'_>> {
        self.arena.iter().filter_map(|node| match node {
            Node::Persistent(name) => Some(Object { graph: self, index: *name }),
            _ => None,
        })
    }
}

/// One object of a [`Graph`].
#[derive(Debug, Clone, Copy)]
pub struct Object<'g> {
    graph: &'g Graph<'g>,
    index: u32,
}

impl<'g> Object<'g> {
    fn node(self) -> Option<&'g Node<'g>> {
        self.graph.arena.get(self.index as usize)
    }

    fn at(self, index: u32) -> Self {
        Self { index, ..self }
    }

    /// A string.
    #[must_use]
    pub fn text(self) -> Option<&'g str> {
        match self.node()? {
            Node::Text(text) => Some(text),
            _ => None,
        }
    }

    /// An integer of at most 64 bits.
    #[must_use]
    pub fn integer(self) -> Option<i64> {
        match self.node()? {
            Node::Int(value) => Some(*value),
            _ => None,
        }
    }

    /// Digits of an integer of more than 64 bits: two's complement, little endian.
    #[must_use]
    pub fn long_digits(self) -> Option<&'g [u8]> {
        match self.node()? {
            Node::Long(digits) => Some(digits),
            _ => None,
        }
    }

    /// A byte string.
    #[must_use]
    pub fn bytes(self) -> Option<&'g [u8]> {
        match self.node()? {
            Node::Bytes(bytes) => Some(bytes),
            _ => None,
        }
    }

    /// `True` or `False`.
    #[must_use]
    pub fn truth(self) -> Option<bool> {
        match self.node()? {
            Node::Bool(value) => Some(*value),
            _ => None,
        }
    }

    /// Whether this is `None`.
    #[must_use]
    pub fn is_none(self) -> bool {
        matches!(self.node(), Some(Node::None))
    }

    /// Module and name of a class or function.
    #[must_use]
    pub fn global(self) -> Option<(&'g str, &'g str)> {
        match self.node()? {
            Node::Global { module, name } => Some((module, name)),
            _ => None,
        }
    }

    /// The operand of a persistent id.
    #[must_use]
    pub fn persistent_id(self) -> Option<Self> {
        match self.node()? {
            Node::Persistent(name) => Some(self.at(*name)),
            _ => None,
        }
    }

    /// Of an instance: what Python would have called, if it is named, and with which arguments.
    #[must_use]
    pub fn call(self) -> Option<((&'g str, &'g str), Vec<Self>)> {
        let Node::Instance(instance) = self.node()? else { return None };
        Some((self.at(instance.called).global()?, self.at(instance.arguments).items()?))
    }

    /// The items of a list or tuple.
    #[must_use]
    pub fn items(self) -> Option<Vec<Self>> {
        match self.node()? {
            Node::List(items) | Node::Tuple(items) => Some(items.iter().map(|item| self.at(*item)).collect()),
            _ => None,
        }
    }

    /// Keys and values of a dictionary, or of an instance of a class called `OrderedDict` or `defaultdict`.
    #[must_use]
    pub fn entries(self) -> Option<Vec<(Self, Self)>> {
        let entries = match self.node()? {
            Node::Dict(entries) => entries,
            Node::Instance(instance) => match self.call()?.0 {
                ("collections", "OrderedDict" | "defaultdict") => &instance.entries,
                _ => return None,
            },
            _ => return None,
        };
        let (pairs, _) = entries.as_chunks::<2>();
        Some(pairs.iter().map(|[key, value]| (self.at(*key), self.at(*value))).collect())
    }

    /// The value that a dictionary holds last under a text key.
    #[must_use]
    pub fn get(self, key: &str) -> Option<Self> {
        self.entries()?.into_iter().rev().find(|(name, _)| name.text() == Some(key)).map(|(_, value)| value)
    }

    /// Kind and name, for messages.
    #[must_use]
    pub fn describe(self) -> String {
        match self.node() {
            None | Some(Node::None) => "None".to_owned(),
            Some(Node::Bool(_)) => "a truth value".to_owned(),
            Some(Node::Int(_) | Node::Long(_) | Node::Float(_)) => "a number".to_owned(),
            Some(Node::Text(_)) => "text".to_owned(),
            Some(Node::Bytes(_)) => "bytes".to_owned(),
            Some(Node::List(items)) => format!("a list of {}", items.len()),
            Some(Node::Tuple(items)) => format!("a tuple of {}", items.len()),
            Some(Node::Set(items)) => format!("a set of {}", items.len()),
            Some(Node::Dict(entries)) => format!("a dictionary of {}", entries.len() / 2),
            Some(Node::Global { module, name }) => format!("{module}.{name}"),
            Some(Node::Instance(_)) => {
                let name = self.call().map(|((module, name), _)| format!("{module}.{name}"));
                format!("an instance of {}", name.unwrap_or_else(|| "something".to_owned()))
            }
            Some(Node::Persistent(_)) => "an object outside the pickle".to_owned(),
        }
    }
}
