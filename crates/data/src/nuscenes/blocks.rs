//! Cuts a table into blocks of whole rows, about a megabyte each, with a scanner that only follows quotes and brackets.

use std::io::Read;

use memchr::memchr2;

use crate::DataError;
use crate::store::StoredFile;

/// Bytes read at once. A block ends at the last border between rows among them.
pub(super) const BLOCK: usize = 1 << 20;

/// What means something outside of strings.
const IS_SIGN: [bool; 256] = {
    let mut is_sign = [false; 256];
    let signs = b"\"{}[],";
    let mut at = 0;
    while at < signs.len() {
        is_sign[signs[at] as usize] = true;
        at += 1;
    }
    is_sign
};

/// Some rows, rewritten as a JSON array of their own.
pub(super) struct Block {
    pub bytes: Vec<u8>,
    /// Position of the first byte in the file.
    pub offset: u64,
    /// An array without rows is allowed only where it is the whole table.
    pub whole_table: bool,
}

/// Cuts a file into blocks.
pub(super) struct Blocks {
    file: StoredFile,
    stream: Box<dyn Read + Send>,
    block: usize,
    /// Read but not yet handed out; begins with `[` or the comma before the next row.
    buffer: Vec<u8>,
    offset: u64,
    scanned: usize,
    /// The last comma between rows.
    cut: Option<usize>,
    depth: u32,
    in_string: bool,
    escaped: bool,
    started: bool,
    finished: bool,
}

impl Blocks {
    pub fn open(file: &StoredFile, block: usize) -> Result<Self, DataError> {
        let stream = file.reader().map_err(|error| match error {
            DataError::Missing { path, .. } => DataError::Missing { what: "table".to_owned(), path },
            other => other,
        })?;
        Ok(Self {
            file: file.clone(),
            stream,
            block,
            buffer: Vec::new(),
            offset: 0,
            scanned: 0,
            cut: None,
            depth: 0,
            in_string: false,
            escaped: false,
            started: false,
            finished: false,
        })
    }

    pub fn take(&mut self, count: usize) -> Result<Vec<Block>, DataError> {
        let mut blocks = Vec::new();
        while blocks.len() < count && !self.finished {
            blocks.push(self.next_block()?);
        }
        Ok(blocks)
    }

    fn bad(&self, why: String) -> DataError {
        DataError::Json { why, path: self.file.path().to_owned() }
    }

    fn next_block(&mut self) -> Result<Block, DataError> {
        loop {
            if let Some(end) = self.scan() {
                self.finished = true;
                self.only_blanks_behind(end)?;
                let whole_table = self.offset == 0;
                let mut bytes = std::mem::take(&mut self.buffer);
                bytes.truncate(end);
                bytes[0] = b'[';
                return Ok(Block { bytes, offset: self.offset, whole_table });
            }
            if let Some(cut) = self.cut.take() {
                return Ok(self.split(cut));
            }
            if self.refill()? == 0 {
                let at = self.offset + self.buffer.len() as u64;
                return Err(self.bad(format!("the file ends at byte {at}, before the end of its array")));
            }
            self.start()?;
        }
    }

    /// Hands out what stands before a comma between rows.
    fn split(&mut self, cut: usize) -> Block {
        // Room for what is read next, so that nothing is moved again.
        let mut rest = Vec::with_capacity(self.buffer.len() - cut + self.block);
        rest.extend_from_slice(&self.buffer[cut..]);
        let mut bytes = std::mem::replace(&mut self.buffer, rest);
        bytes.truncate(cut);
        bytes[0] = b'[';
        bytes.push(b']');
        let block = Block { bytes, offset: self.offset, whole_table: false };
        self.offset += cut as u64;
        self.scanned -= cut;
        block
    }

    fn refill(&mut self) -> Result<usize, DataError> {
        let wanted = self.block as u64;
        let read = self.stream.by_ref().take(wanted).read_to_end(&mut self.buffer);
        read.map_err(|source| self.file.read_failure(source))
    }

    /// Drops blanks before the array and insists on its bracket.
    fn start(&mut self) -> Result<(), DataError> {
        if self.started {
            return Ok(());
        }
        let blanks = self.buffer.iter().take_while(|byte| byte.is_ascii_whitespace()).count();
        match self.buffer.get(blanks) {
            None => {}
            Some(b'[') => {
                // Blanks are kept in front of the bracket: positions stay those of the file.
                self.buffer[..blanks].fill(b' ');
                self.buffer.swap(0, blanks);
                self.started = true;
            }
            Some(_) => return Err(self.bad(format!("the table is not an array of rows, at byte {blanks}"))),
        }
        Ok(())
    }

    /// Follows quotes and brackets through new bytes; the position behind the array's closing bracket once it is there.
    fn scan(&mut self) -> Option<usize> {
        if !self.started {
            return None;
        }
        let mut at = self.scanned;
        self.scanned = self.buffer.len();
        while let Some(rest) = self.buffer.get(at..).filter(|rest| !rest.is_empty()) {
            if self.escaped {
                self.escaped = false;
                at += 1;
                continue;
            }
            let step = match self.in_string {
                true => memchr2(b'"', b'\\', rest),
                false => rest.iter().position(|byte| IS_SIGN[usize::from(*byte)]),
            };
            let step = step?;
            at += step + 1;
            match rest[step] {
                b'"' => self.in_string = !self.in_string,
                b'\\' => self.escaped = true,
                b'{' | b'[' => self.depth += 1,
                b',' if self.depth == 1 => self.cut = Some(at - 1),
                b',' => {}
                _ => {
                    self.depth = self.depth.saturating_sub(1);
                    if self.depth == 0 {
                        self.scanned = at;
                        return Some(at);
                    }
                }
            }
        }
        None
    }

    fn only_blanks_behind(&mut self, end: usize) -> Result<(), DataError> {
        let mut at = self.offset + end as u64;
        let mut rest = self.buffer[end..].to_vec();
        loop {
            if let Some(bad) = rest.iter().position(|byte| !byte.is_ascii_whitespace()) {
                return Err(self.bad(format!("there is more behind the array, at byte {}", at + bad as u64)));
            }
            at += rest.len() as u64;
            rest.clear();
            let more = self.stream.by_ref().take(BLOCK as u64).read_to_end(&mut rest);
            let more = more.map_err(|source| self.file.read_failure(source))?;
            if more == 0 {
                return Ok(());
            }
        }
    }
}
