//! The stack machine. Objects live in an arena and are named by index, because Python fills a list after it has stored it in the memo.

use std::collections::BTreeMap;

use super::{PickleError, Rules, Value};

/// Lists and tuples hold indices of the arena.
#[derive(Debug)]
enum Node<'b> {
    None,
    Int(i64),
    Float(f64),
    Text(&'b str),
    List(Vec<u32>),
    Tuple(Vec<u32>),
    /// An allowed list class itself.
    Class,
}

#[derive(Debug)]
pub(super) struct Machine<'b, 'r> {
    bytes: &'b [u8],
    rules: &'r Rules<'r>,
    /// Next byte.
    at: usize,
    /// Place of the current opcode.
    opcode_at: usize,
    arena: Vec<Node<'b>>,
    stack: Vec<u32>,
    /// Heights of the stack at which marks stand.
    marks: Vec<usize>,
    memo: BTreeMap<u32, u32>,
}

impl<'b, 'r> Machine<'b, 'r> {
    pub fn new(bytes: &'b [u8], rules: &'r Rules<'r>) -> Self {
        let (arena, stack, marks) = (Vec::new(), Vec::new(), Vec::new());
        Self { bytes, rules, at: 0, opcode_at: 0, arena, stack, marks, memo: BTreeMap::new() }
    }

    /// Runs to the end marker.
    pub fn run(&mut self) -> Result<(), PickleError> {
        if self.bytes.len() > self.rules.max_bytes {
            return Err(PickleError::Limit { what: "bytes", limit: self.rules.max_bytes });
        }
        self.protocol()?;
        loop {
            self.opcode_at = self.at;
            match self.byte()? {
                b'.' => break,
                opcode => self.step(opcode)?,
            }
        }
        match (self.stack.len(), self.marks.len(), self.at == self.bytes.len()) {
            (1, 0, true) => Ok(()),
            (1, 0, false) => Err(self.malformed("the end marker is not the last byte, but stands")),
            _ => Err(self.malformed("not exactly one object is left")),
        }
    }

    /// The object, with shared lists copied.
    pub fn value(&self) -> Result<Value, PickleError> {
        let top = self.stack.last().copied().ok_or_else(|| self.malformed("no object is left"))?;
        self.resolve(top, 0, &mut 0)
    }

    fn resolve(&self, node: u32, depth: usize, count: &mut usize) -> Result<Value, PickleError> {
        *count += 1;
        if *count > self.rules.max_values {
            return Err(PickleError::Limit { what: "values", limit: self.rules.max_values });
        }
        let mut all = |items: &[u32]| {
            if depth >= self.rules.max_depth {
                return Err(PickleError::Limit { what: "nested lists", limit: self.rules.max_depth });
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
            Some(Node::Class) | None => return Err(self.malformed("a class stands for a value")),
        })
    }

    /// Protocols 0 and 1 have no marker at the front.
    fn protocol(&mut self) -> Result<(), PickleError> {
        match self.byte()? {
            0x80 => {}
            opcode => return Err(PickleError::Opcode { opcode, offset: 0 }),
        }
        match self.byte()? {
            2..=5 => Ok(()),
            _ => Err(self.malformed("not a protocol from 2 to 5")),
        }
    }

    fn step(&mut self, opcode: u8) -> Result<(), PickleError> {
        match opcode {
            0x95 => self.frame(),
            b'N' => self.push(Node::None),
            b'G' => self.array().and_then(|bytes| self.push(Node::Float(f64::from_be_bytes(bytes)))),
            b'J' => self.array().and_then(|bytes| self.push(Node::Int(i32::from_le_bytes(bytes).into()))),
            b'K' => self.byte().and_then(|byte| self.push(Node::Int(byte.into()))),
            b'M' => self.array().and_then(|bytes| self.push(Node::Int(u16::from_le_bytes(bytes).into()))),
            0x8A => self.long(),
            0x8C => self.byte().and_then(|length| self.text(length.into())),
            b'X' => self.array().and_then(|bytes| self.text(u32::from_le_bytes(bytes) as usize)),
            0x94 => self.store(self.memo.len() as u32),
            b'q' => self.byte().and_then(|index| self.store(index.into())),
            b'r' => self.array().and_then(|bytes| self.store(u32::from_le_bytes(bytes))),
            b'h' => self.byte().and_then(|index| self.fetch(index.into())),
            b'j' => self.array().and_then(|bytes| self.fetch(u32::from_le_bytes(bytes))),
            b'(' => self.mark(),
            b']' => self.push(Node::List(Vec::new())),
            b'a' => self.pop().and_then(|item| self.append(vec![item])),
            b'e' => self.pop_to_mark().and_then(|items| self.append(items)),
            b')' => self.push(Node::Tuple(Vec::new())),
            b't' => self.pop_to_mark().and_then(|items| self.push(Node::Tuple(items))),
            0x85..=0x87 => self.short_tuple(usize::from(opcode - 0x84)),
            b'c' => self.global(),
            0x93 => self.stack_global(),
            // NEWOBJ and REDUCE call in Python; here both only make an empty list of an allowed class.
            0x81 | b'R' => self.instance(),
            b'b' => self.build(),
            opcode => Err(PickleError::Opcode { opcode, offset: self.opcode_at }),
        }
    }

    fn malformed(&self, what: &'static str) -> PickleError {
        PickleError::Malformed { what, offset: self.opcode_at }
    }

    fn take(&mut self, length: usize) -> Result<&'b [u8], PickleError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let taken = rest.get(..length).ok_or(PickleError::Truncated { offset: self.bytes.len() })?;
        self.at += length;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let offset = self.at;
        self.take(N)?.try_into().map_err(|_| PickleError::Truncated { offset })
    }

    fn byte(&mut self) -> Result<u8, PickleError> {
        self.array::<1>().map(|[byte]| byte)
    }

    /// Only checked: frames help a reader of streams and mean nothing here.
    fn frame(&mut self) -> Result<(), PickleError> {
        let length = u64::from_le_bytes(self.array()?);
        let left = self.bytes.len().saturating_sub(self.at) as u64;
        if length > left { Err(self.malformed("a frame longer than the rest of the pickle")) } else { Ok(()) }
    }

    fn long(&mut self) -> Result<(), PickleError> {
        let length = self.byte()?;
        let digits = self.take(length.into())?;
        if digits.len() > 8 {
            return Err(self.malformed("an integer of more than 64 bits"));
        }
        // Two's complement, little endian: the missing upper bytes repeat the sign.
        let negative = digits.last().is_some_and(|byte| byte & 0x80 != 0);
        let mut full = if negative { [0xFF; 8] } else { [0; 8] };
        full.iter_mut().zip(digits).for_each(|(to, from)| *to = *from);
        self.push(Node::Int(i64::from_le_bytes(full)))
    }

    fn text(&mut self, length: usize) -> Result<(), PickleError> {
        let bytes = self.take(length)?;
        let text = std::str::from_utf8(bytes).map_err(|_| self.malformed("text that is not UTF-8"))?;
        self.push(Node::Text(text))
    }

    fn push(&mut self, node: Node<'b>) -> Result<(), PickleError> {
        if self.arena.len() >= self.rules.max_values {
            return Err(PickleError::Limit { what: "values", limit: self.rules.max_values });
        }
        self.stack.push(self.arena.len() as u32);
        self.arena.push(node);
        Ok(())
    }

    /// Never takes what stands below a mark.
    fn pop(&mut self) -> Result<u32, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.pop() {
            Some(top) if self.stack.len() >= floor => Ok(top),
            _ => Err(self.malformed("an opcode without its operands")),
        }
    }

    fn pop_node(&mut self) -> Result<&Node<'b>, PickleError> {
        let missing = self.malformed("an opcode without its operands");
        let top = self.pop()?;
        self.arena.get(top as usize).ok_or(missing)
    }

    fn top(&self) -> Result<u32, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        let top = self.stack.last().filter(|_| self.stack.len() > floor);
        top.copied().ok_or_else(|| self.malformed("an opcode without its operands"))
    }

    fn mark(&mut self) -> Result<(), PickleError> {
        if self.marks.len() >= self.rules.max_depth {
            return Err(PickleError::Limit { what: "nested lists", limit: self.rules.max_depth });
        }
        self.marks.push(self.stack.len());
        Ok(())
    }

    fn pop_to_mark(&mut self) -> Result<Vec<u32>, PickleError> {
        let mark = self.marks.pop().filter(|mark| *mark <= self.stack.len());
        let mark = mark.ok_or_else(|| self.malformed("no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    fn append(&mut self, items: Vec<u32>) -> Result<(), PickleError> {
        let (list, wrong) = (self.top()?, self.malformed("an append to something that is no list"));
        match self.arena.get_mut(list as usize) {
            Some(Node::List(into)) => {
                into.extend(items);
                Ok(())
            }
            _ => Err(wrong),
        }
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
        let top = self.top()?;
        if self.memo.len() >= self.rules.max_memo && !self.memo.contains_key(&index) {
            return Err(PickleError::Limit { what: "memo entries", limit: self.rules.max_memo });
        }
        self.memo.insert(index, top);
        Ok(())
    }

    fn fetch(&mut self, index: u32) -> Result<(), PickleError> {
        let node = self.memo.get(&index).copied();
        self.stack.push(node.ok_or_else(|| self.malformed("a memo entry that was never stored"))?);
        Ok(())
    }

    fn line(&mut self) -> Result<&'b str, PickleError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|byte| *byte == b'\n');
        let line = self.take(length.ok_or(PickleError::Truncated { offset: self.bytes.len() })?)?;
        self.at += 1;
        std::str::from_utf8(line).map_err(|_| self.malformed("a name that is not UTF-8"))
    }

    fn global(&mut self) -> Result<(), PickleError> {
        let (module, name) = (self.line()?, self.line()?);
        self.class(module, name)
    }

    fn stack_global(&mut self) -> Result<(), PickleError> {
        let wrong = self.malformed("a global whose names are no text");
        let Node::Text(name) = *self.pop_node()? else { return Err(wrong) };
        let Node::Text(module) = *self.pop_node()? else { return Err(wrong) };
        self.class(module, name)
    }

    fn class(&mut self, module: &str, name: &str) -> Result<(), PickleError> {
        if self.rules.list_classes.contains(&(module, name)) {
            return self.push(Node::Class);
        }
        Err(PickleError::Global { module: module.to_owned(), name: name.to_owned() })
    }

    /// Arguments are refused rather than dropped.
    fn instance(&mut self) -> Result<(), PickleError> {
        let bare = matches!(self.pop_node()?, Node::Tuple(items) if items.is_empty());
        let class = matches!(self.pop_node()?, Node::Class);
        match (class, bare) {
            (true, true) => self.push(Node::List(Vec::new())),
            (true, false) => Err(self.malformed("a class with arguments")),
            (false, _) => Err(self.malformed("a call of something that is no class")),
        }
    }

    /// Python would set attributes; the only state accepted is none.
    fn build(&mut self) -> Result<(), PickleError> {
        let stateless = matches!(self.pop_node()?, Node::None);
        let object = self.top()?;
        let is_list = matches!(self.arena.get(object as usize), Some(Node::List(_)));
        if stateless && is_list { Ok(()) } else { Err(self.malformed("an object with a state")) }
    }

    /// Bytes reserved for everything but the decoded value.
    #[cfg(test)]
    pub fn reserved(&self) -> usize {
        let items = self.arena.iter().map(|node| match node {
            Node::List(items) | Node::Tuple(items) => items.capacity(),
            _ => 0,
        });
        let words = items.sum::<usize>() + self.stack.capacity();
        4 * words
            + 8 * self.marks.capacity()
            + self.arena.capacity() * size_of::<Node<'_>>()
            // A map of small integers takes less than four words an entry.
            + 32 * self.memo.len()
    }
}
