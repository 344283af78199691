//! The stack machine.

use std::collections::BTreeMap;

use super::cursor::{Cursor, small_integer};
use super::node::Node;
use super::{Limits, PickleError, Rules, Value};

/// What a pickle may hold.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Dialect<'r> {
    /// Numbers, text, lists, tuples, and lists under these class names.
    Lists(&'r [(&'r str, &'r str)]),
    /// Any object, none of them made.
    Objects,
}

#[derive(Debug)]
pub(crate) struct Machine<'b, 'r> {
    pub cursor: Cursor<'b>,
    dialect: Dialect<'r>,
    limits: Limits,
    pub arena: Vec<Node<'b>>,
    stack: Vec<u32>,
    /// Heights of the stack at which marks stand.
    marks: Vec<usize>,
    memo: BTreeMap<u32, u32>,
}

impl<'b, 'r> Machine<'b, 'r> {
    /// For [`super::decode`].
    pub fn new(bytes: &'b [u8], rules: &Rules<'r>) -> Self {
        Self::speaking(bytes, Dialect::Lists(rules.list_classes), rules.limits)
    }

    pub fn speaking(bytes: &'b [u8], dialect: Dialect<'r>, limits: Limits) -> Self {
        let (arena, stack, marks) = (Vec::new(), Vec::new(), Vec::new());
        Self { cursor: Cursor::new(bytes), dialect, limits, arena, stack, marks, memo: BTreeMap::new() }
    }

    /// Runs to the end marker, which must be the last byte.
    pub fn run(&mut self) -> Result<(), PickleError> {
        if self.cursor.len() > self.limits.max_bytes {
            return Err(PickleError::Limit { what: "bytes", limit: self.limits.max_bytes });
        }
        self.run_to_end_marker()?;
        if self.cursor.at == self.cursor.len() {
            return Ok(());
        }
        Err(self.cursor.malformed("the end marker is not the last byte, but stands"))
    }

    /// Runs to the end marker, whatever follows it.
    pub fn run_to_end_marker(&mut self) -> Result<(), PickleError> {
        self.protocol()?;
        loop {
            self.cursor.opcode_at = self.cursor.at;
            if self.cursor.at > self.limits.max_bytes {
                return Err(PickleError::Limit { what: "bytes", limit: self.limits.max_bytes });
            }
            match self.cursor.byte()? {
                b'.' => break,
                opcode => self.step(opcode)?,
            }
        }
        match (self.stack.len(), self.marks.len()) {
            (1, 0) => Ok(()),
            _ => Err(self.cursor.malformed("not exactly one object is left")),
        }
    }

    /// Index of the object that is left.
    pub fn root(&self) -> Result<u32, PickleError> {
        self.stack.last().copied().ok_or_else(|| self.cursor.malformed("no object is left"))
    }

    /// The object, with shared lists copied.
    pub fn value(&self) -> Result<Value, PickleError> {
        self.resolve(self.root()?, 0, &mut 0)
    }

    fn resolve(&self, node: u32, depth: usize, count: &mut usize) -> Result<Value, PickleError> {
        *count += 1;
        if *count > self.limits.max_values {
            return Err(PickleError::Limit { what: "values", limit: self.limits.max_values });
        }
        let mut all = |items: &[u32]| {
            if depth >= self.limits.max_depth {
                return Err(PickleError::Limit { what: "nested lists", limit: self.limits.max_depth });
            }
            items.iter().map(|item| self.resolve(*item, depth + 1, count)).collect::<Result<Vec<_>, _>>()
        };
        Ok(match self.arena.get(node as usize) {
            Some(Node::None) => Value::None,
            Some(Node::Int(value)) => Value::Int(*value),
            Some(Node::Float(value)) => Value::Float(*value),
            Some(Node::Text(text)) => Value::Text((*text).to_owned()),
            Some(Node::List(items)) => Value::List(all(items)?),
            Some(Node::Tuple(items)) => Value::Tuple(all(items)?),
            Some(_) | None => return Err(self.cursor.malformed("a class stands for a value")),
        })
    }

    /// Protocols 0 and 1 have no marker at the front.
    fn protocol(&mut self) -> Result<(), PickleError> {
        let offset = self.cursor.at;
        match self.cursor.byte()? {
            0x80 => {}
            opcode => return Err(PickleError::Opcode { opcode, offset }),
        }
        match self.cursor.byte()? {
            2..=5 => Ok(()),
            _ => Err(self.cursor.malformed("not a protocol from 2 to 5")),
        }
    }

    fn step(&mut self, opcode: u8) -> Result<(), PickleError> {
        let read = &mut self.cursor;
        match opcode {
            0x95 => read.frame(),
            b'N' => self.push(Node::None),
            b'G' => read.array().and_then(|bytes| self.push(Node::Float(f64::from_be_bytes(bytes)))),
            b'J' => read.array().and_then(|bytes| self.push(Node::Int(i32::from_le_bytes(bytes).into()))),
            b'K' => read.byte().and_then(|byte| self.push(Node::Int(byte.into()))),
            b'M' => read.array().and_then(|bytes| self.push(Node::Int(u16::from_le_bytes(bytes).into()))),
            0x8A => read.byte().and_then(|length| self.long(length.into())),
            0x8C => read.byte().and_then(|length| self.text(length.into())),
            b'X' => read.length().and_then(|length| self.text(length)),
            0x94 => self.store(self.memo.len() as u32),
            b'q' => read.byte().and_then(|index| self.store(index.into())),
            b'r' => read.array().and_then(|bytes| self.store(u32::from_le_bytes(bytes))),
            b'h' => read.byte().and_then(|index| self.fetch(index.into())),
            b'j' => read.array().and_then(|bytes| self.fetch(u32::from_le_bytes(bytes))),
            b'(' => self.mark(),
            b']' => self.push(Node::List(Vec::new())),
            b'a' => self.pop().and_then(|item| self.append(vec![item])),
            b'e' => self.pop_to_mark().and_then(|items| self.append(items)),
            b')' => self.push(Node::Tuple(Vec::new())),
            b't' => self.pop_to_mark().and_then(|items| self.push(Node::Tuple(items))),
            0x85..=0x87 => self.short_tuple(usize::from(opcode - 0x84)),
            b'c' => self.global(),
            0x93 => self.stack_global(),
            // NEWOBJ and REDUCE call in Python; here they make an empty list of an allowed class, or a record of the call.
            0x81 | b'R' => match self.dialect {
                Dialect::Lists(_) => self.list_of_class(),
                Dialect::Objects => self.instance(),
            },
            b'b' => match self.dialect {
                Dialect::Lists(_) => self.build_list(),
                Dialect::Objects => self.build(),
            },
            opcode => match self.dialect {
                Dialect::Lists(_) => Err(PickleError::Opcode { opcode, offset: self.cursor.opcode_at }),
                Dialect::Objects => self.object_step(opcode),
            },
        }
    }

    pub fn long(&mut self, length: usize) -> Result<(), PickleError> {
        let digits = self.cursor.take(length)?;
        match (small_integer(digits), self.dialect) {
            (Some(value), _) => self.push(Node::Int(value)),
            (None, Dialect::Objects) => self.push(Node::Long(digits)),
            (None, Dialect::Lists(_)) => Err(self.cursor.malformed("an integer of more than 64 bits")),
        }
    }

    pub fn text(&mut self, length: usize) -> Result<(), PickleError> {
        let text = self.cursor.text(length)?;
        self.push(Node::Text(text))
    }

    pub fn push(&mut self, node: Node<'b>) -> Result<(), PickleError> {
        if self.arena.len() >= self.limits.max_values {
            return Err(PickleError::Limit { what: "values", limit: self.limits.max_values });
        }
        self.stack.push(self.arena.len() as u32);
        self.arena.push(node);
        Ok(())
    }

    /// Never takes what stands below a mark.
    pub fn pop(&mut self) -> Result<u32, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.pop() {
            Some(top) if self.stack.len() >= floor => Ok(top),
            _ => Err(self.no_operands()),
        }
    }

    fn no_operands(&self) -> PickleError {
        self.cursor.malformed("an opcode without its operands")
    }

    fn pop_node(&mut self) -> Result<&Node<'b>, PickleError> {
        let missing = self.no_operands();
        let top = self.pop()?;
        self.arena.get(top as usize).ok_or(missing)
    }

    /// The object that the next opcode would change.
    pub fn top(&mut self) -> Result<&mut Node<'b>, PickleError> {
        let (missing, top) = (self.no_operands(), self.top_index()?);
        self.arena.get_mut(top as usize).ok_or(missing)
    }

    fn top_index(&self) -> Result<u32, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let top = self.stack.last().filter(|_| self.stack.len() > floor);
        top.copied().ok_or_else(|| self.no_operands())
    }

    fn mark(&mut self) -> Result<(), PickleError> {
        if self.marks.len() >= self.limits.max_depth {
            return Err(PickleError::Limit { what: "nested lists", limit: self.limits.max_depth });
        }
        self.marks.push(self.stack.len());
        Ok(())
    }

    pub fn pop_to_mark(&mut self) -> Result<Vec<u32>, PickleError> {
        let mark = self.marks.pop().filter(|mark| *mark <= self.stack.len());
        let mark = mark.ok_or_else(|| self.cursor.malformed("no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    fn append(&mut self, items: Vec<u32>) -> Result<(), PickleError> {
        let wrong = self.cursor.malformed("an append to something that is no list");
        match self.top()? {
            Node::List(into) => into.extend(items),
            Node::Instance(instance) => instance.items.extend(items),
            _ => return Err(wrong),
        }
        Ok(())
    }

    fn short_tuple(&mut self, length: usize) -> Result<(), PickleError> {
        let mut items = Vec::with_capacity(3);
        for _ in 0..length {
            items.push(self.pop()?);
        }
        items.reverse();
        self.push(Node::Tuple(items))
    }

    fn store(&mut self, index: u32) -> Result<(), PickleError> {
        let top = self.top_index()?;
        if self.memo.len() >= self.limits.max_memo && !self.memo.contains_key(&index) {
            return Err(PickleError::Limit { what: "memo entries", limit: self.limits.max_memo });
        }
        self.memo.insert(index, top);
        Ok(())
    }

    fn fetch(&mut self, index: u32) -> Result<(), PickleError> {
        let node = self.memo.get(&index).copied();
        self.stack.push(node.ok_or_else(|| self.cursor.malformed("a memo entry that was never stored"))?);
        Ok(())
    }

    fn global(&mut self) -> Result<(), PickleError> {
        let (module, name) = (self.cursor.line()?, self.cursor.line()?);
        self.class(module, name)
    }

    fn stack_global(&mut self) -> Result<(), PickleError> {
        let wrong = self.cursor.malformed("a global whose names are no text");
        let Node::Text(name) = *self.pop_node()? else { return Err(wrong) };
        let Node::Text(module) = *self.pop_node()? else { return Err(wrong) };
        self.class(module, name)
    }

    fn class(&mut self, module: &'b str, name: &'b str) -> Result<(), PickleError> {
        match self.dialect {
            Dialect::Lists(classes) if !classes.contains(&(module, name)) => {
                Err(PickleError::Global { module: module.to_owned(), name: name.to_owned() })
            }
            _ => self.push(Node::Global { module, name }),
        }
    }

    /// Arguments are refused rather than dropped.
    fn list_of_class(&mut self) -> Result<(), PickleError> {
        let bare = matches!(self.pop_node()?, Node::Tuple(items) if items.is_empty());
        let class = matches!(self.pop_node()?, Node::Global { .. });
        match (class, bare) {
            (true, true) => self.push(Node::List(Vec::new())),
            (true, false) => Err(self.cursor.malformed("a class with arguments")),
            (false, _) => Err(self.cursor.malformed("a call of something that is no class")),
        }
    }

    /// Python would set attributes; the only state accepted is none.
    fn build_list(&mut self) -> Result<(), PickleError> {
        let stateless = matches!(self.pop_node()?, Node::None);
        let wrong = self.cursor.malformed("an object with a state");
        if stateless && matches!(self.top()?, Node::List(_)) { Ok(()) } else { Err(wrong) }
    }

    /// The end of the innermost mark, or the top object, goes.
    pub fn discard(&mut self) -> Result<(), PickleError> {
        match self.marks.last() {
            Some(mark) if *mark == self.stack.len() => _ = self.marks.pop(),
            _ => _ = self.pop()?,
        }
        Ok(())
    }

    /// Bytes reserved for everything but the decoded value.
    #[cfg(test)]
    pub fn reserved(&self) -> usize {
        let items = self.arena.iter().map(|node| match node {
            Node::List(items) | Node::Tuple(items) | Node::Set(items) | Node::Dict(items) => 4 * items.capacity(),
            Node::Instance(instance) => {
                size_of_val(instance.as_ref()) + 4 * (instance.items.capacity() + instance.entries.capacity())
            }
            _ => 0,
        });
        items.sum::<usize>()
            + 4 * self.stack.capacity()
            + 8 * self.marks.capacity()
            + self.arena.capacity() * size_of::<Node<'_>>()
            // A map of small integers takes less than four words an entry.
            + 32 * self.memo.len()
    }
}
