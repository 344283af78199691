//! What the machine builds: objects in an arena, named by index, because Python fills a list after it has stored it in the memo.

/// One object. Containers hold indices of the arena.
#[derive(Debug)]
pub(crate) enum Node<'b> {
    None,
    Bool(bool),
    Int(i64),
    /// An integer of more than 64 bits: two's complement, little endian.
    Long(&'b [u8]),
    Float(f64),
    Text(&'b str),
    Bytes(&'b [u8]),
    List(Vec<u32>),
    Tuple(Vec<u32>),
    Set(Vec<u32>),
    /// Keys and values by turns.
    Dict(Vec<u32>),
    /// A class or function, by name only.
    Global {
        module: &'b str,
        name: &'b str,
    },
    /// What Python would have made by a call.
    Instance(Box<Instance>),
    /// A name under which the writer keeps an object outside the pickle.
    Persistent(u32),
}

/// The record of a call that is not made.
#[derive(Debug)]
pub(crate) struct Instance {
    pub called: u32,
    pub arguments: u32,
    /// What was appended, for subclasses of list.
    pub items: Vec<u32>,
    /// What was set by key, for subclasses of dict: keys and values by turns.
    pub entries: Vec<u32>,
    /// What would have been the attributes.
    pub state: Option<u32>,
}

impl Instance {
    pub fn new(called: u32, arguments: u32) -> Self {
        Self { called, arguments, items: Vec::new(), entries: Vec::new(), state: None }
    }
}
