//! Reading operands from the bytes of a pickle.

use super::PickleError;

#[derive(Debug)]
pub(crate) struct Cursor<'b> {
    bytes: &'b [u8],
    /// Next byte.
    pub at: usize,
    /// Place of the current opcode.
    pub opcode_at: usize,
}

impl<'b> Cursor<'b> {
    pub fn new(bytes: &'b [u8]) -> Self {
        Self { bytes, at: 0, opcode_at: 0 }
    }

    pub fn len(&self) -> usize {
        self.bytes.len()
    }

    pub fn malformed(&self, what: &'static str) -> PickleError {
        PickleError::Malformed { what, offset: self.opcode_at }
    }

    pub fn take(&mut self, length: usize) -> Result<&'b [u8], PickleError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let taken = rest.get(..length).ok_or(PickleError::Truncated { offset: self.bytes.len() })?;
        self.at += length;
        Ok(taken)
    }

    pub fn array<const N: usize>(&mut self) -> Result<[u8; N], PickleError> {
        let offset = self.at;
        self.take(N)?.try_into().map_err(|_| PickleError::Truncated { offset })
    }

    pub fn byte(&mut self) -> Result<u8, PickleError> {
        self.array::<1>().map(|[byte]| byte)
    }

    /// A length of four bytes.
    pub fn length(&mut self) -> Result<usize, PickleError> {
        self.array().map(|bytes| u32::from_le_bytes(bytes) as usize)
    }

    /// A length of eight bytes; one that no memory holds is longer than the input.
    pub fn long_length(&mut self) -> Result<usize, PickleError> {
        let length = u64::from_le_bytes(self.array()?);
        usize::try_from(length).map_err(|_| PickleError::Truncated { offset: self.bytes.len() })
    }

    pub fn text(&mut self, length: usize) -> Result<&'b str, PickleError> {
        std::str::from_utf8(self.take(length)?).map_err(|_| self.malformed("text that is not UTF-8"))
    }

    pub fn line(&mut self) -> Result<&'b str, PickleError> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|byte| *byte == b'\n');
        let line = self.take(length.ok_or(PickleError::Truncated { offset: self.bytes.len() })?)?;
        self.at += 1;
        std::str::from_utf8(line).map_err(|_| self.malformed("a name that is not UTF-8"))
    }

    /// Only checked: frames help a reader of streams and mean nothing here.
    pub fn frame(&mut self) -> Result<(), PickleError> {
        let length = u64::from_le_bytes(self.array()?);
        let left = self.bytes.len().saturating_sub(self.at) as u64;
        if length > left { Err(self.malformed("a frame longer than the rest of the pickle")) } else { Ok(()) }
    }
}

/// An integer of at most eight bytes, two's complement and little endian: the missing upper bytes repeat the sign.
pub(crate) fn small_integer(digits: &[u8]) -> Option<i64> {
    if digits.len() > 8 {
        return None;
    }
    let negative = digits.last().is_some_and(|byte| byte & 0x80 != 0);
    let mut full = if negative { [0xFF; 8] } else { [0; 8] };
    full.iter_mut().zip(digits).for_each(|(to, from)| *to = *from);
    Some(i64::from_le_bytes(full))
}
