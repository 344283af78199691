//! Opcodes that only object graphs need. What Python would call becomes a record of the call.

use super::PickleError;
use super::machine::Machine;
use super::node::{Instance, Node};

impl Machine<'_, '_> {
    pub(crate) fn object_step(&mut self, opcode: u8) -> Result<(), PickleError> {
        let read = &mut self.cursor;
        match opcode {
            0x88 => self.push(Node::Bool(true)),
            0x89 => self.push(Node::Bool(false)),
            0x8B => read.length().and_then(|length| self.long(length)),
            0x8D => read.long_length().and_then(|length| self.text(length)),
            b'C' => read.byte().and_then(|length| self.bytes(length.into())),
            b'B' => read.length().and_then(|length| self.bytes(length)),
            0x8E | 0x96 => read.long_length().and_then(|length| self.bytes(length)),
            b'U' => read.byte().and_then(|length| self.old_text(length.into())),
            b'T' => read.length().and_then(|length| self.old_text(length)),
            b'}' => self.push(Node::Dict(Vec::new())),
            b's' => self.set_item(),
            b'u' => self.pop_to_mark().and_then(|entries| self.set_items(&entries)),
            0x8F => self.push(Node::Set(Vec::new())),
            0x90 => self.pop_to_mark().and_then(|items| self.add_items(&items)),
            0x91 => self.pop_to_mark().and_then(|items| self.push(Node::Set(items))),
            0x92 => self.pop().and_then(|_keywords| self.instance()),
            b'Q' => self.pop().and_then(|name| self.push(Node::Persistent(name))),
            b'0' => self.discard(),
            b'1' => self.pop_to_mark().map(drop),
            opcode => Err(PickleError::Opcode { opcode, offset: self.cursor.opcode_at }),
        }
    }

    fn bytes(&mut self, length: usize) -> Result<(), PickleError> {
        let bytes = self.cursor.take(length)?;
        self.push(Node::Bytes(bytes))
    }

    /// Strings of Python 2, which did not tell text from bytes.
    fn old_text(&mut self, length: usize) -> Result<(), PickleError> {
        let bytes = self.cursor.take(length)?;
        self.push(std::str::from_utf8(bytes).map_or(Node::Bytes(bytes), Node::Text))
    }

    fn set_item(&mut self) -> Result<(), PickleError> {
        let value = self.pop()?;
        let key = self.pop()?;
        self.set_items(&[key, value])
    }

    fn set_items(&mut self, entries: &[u32]) -> Result<(), PickleError> {
        if !entries.len().is_multiple_of(2) {
            return Err(self.cursor.malformed("a key without a value"));
        }
        let wrong = self.cursor.malformed("a key set in something that is no dictionary");
        match self.top()? {
            Node::Dict(into) => into.extend(entries),
            Node::Instance(instance) => instance.entries.extend(entries),
            _ => return Err(wrong),
        }
        Ok(())
    }

    fn add_items(&mut self, items: &[u32]) -> Result<(), PickleError> {
        let wrong = self.cursor.malformed("an item added to something that is no set");
        match self.top()? {
            Node::Set(into) => into.extend(items),
            Node::Instance(instance) => instance.items.extend(items),
            _ => return Err(wrong),
        }
        Ok(())
    }

    pub(crate) fn instance(&mut self) -> Result<(), PickleError> {
        let arguments = self.pop()?;
        let called = self.pop()?;
        if !matches!(self.arena.get(arguments as usize), Some(Node::Tuple(_))) {
            return Err(self.cursor.malformed("a call whose arguments are no tuple"));
        }
        self.push(Node::Instance(Box::new(Instance::new(called, arguments))))
    }

    pub(crate) fn build(&mut self) -> Result<(), PickleError> {
        let state = self.pop()?;
        let wrong = self.cursor.malformed("a state for something that is no instance");
        match self.top()? {
            Node::Instance(instance) => instance.state = Some(state),
            _ => return Err(wrong),
        }
        Ok(())
    }
}
