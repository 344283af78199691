//! Streams a table: one JSON array of objects, up to gigabytes, in constant memory and on all cores.
//!
//! A scanner that only follows quotes and brackets cuts the file between rows into blocks of about a megabyte; blocks are parsed in
//! parallel while the next ones are read. No row outlives its block.

use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Deserialize;
use serde::de::{DeserializeSeed, SeqAccess, Visitor};

use super::rows::{Text, Token};
use crate::DataError;

/// Bytes after which a block is closed at the next border between rows.
const BLOCK: usize = 1 << 20;

/// A table's row as it stands in the file, borrowing from the block.
pub(super) trait TableRow {
    /// The row.
    type Row<'a>: Deserialize<'a>;
}

/// Parses every row, keeps what `keep` returns and hands it to `sink` in file order.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Io`], [`DataError::Json`] with byte and token of the bad row, and whatever `keep` or `sink` return.
pub(super) fn read_table<T, R, K, S>(path: &Path, keep: K, mut sink: S) -> Result<(), DataError>
where
    T: TableRow,
    R: Send,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError> + Sync,
    S: FnMut(Vec<R>) -> Result<(), DataError> + Send,
{
    let mut blocks = Blocks::open(path, BLOCK)?;
    let at_once = rayon::current_num_threads().max(1) * 2;
    let mut batch = blocks.take(at_once)?;
    while !batch.is_empty() {
        let (parsed, next) = rayon::join(
            || batch.par_iter().map(|block| block.parse::<T, R, K>(&keep, path)).collect::<Result<Vec<_>, _>>(),
            || blocks.take(at_once),
        );
        parsed?.into_iter().try_for_each(&mut sink)?;
        batch = next?;
    }
    Ok(())
}

/// [`read_table`] for small tables: all rows at once.
pub(super) fn read_all<T, R, K>(path: &Path, keep: K) -> Result<Vec<R>, DataError>
where
    T: TableRow,
    R: Send,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError> + Sync,
{
    let mut rows = Vec::new();
    read_table::<T, R, K, _>(path, keep, |part| {
        rows.extend(part);
        Ok(())
    })?;
    Ok(rows)
}

/// Some rows, rewritten as a JSON array of their own.
struct Block {
    bytes: Vec<u8>,
    /// Position of the first byte in the file.
    offset: u64,
    /// An array without rows is allowed only where it is the whole table.
    whole_table: bool,
}

impl Block {
    fn parse<T, R, K>(&self, keep: &K, path: &Path) -> Result<Vec<R>, DataError>
    where
        T: TableRow,
        K: Fn(T::Row<'_>) -> Result<Option<R>, DataError>,
    {
        let mut rows =
            Rows::<T, R, K> { keep, kept: Vec::new(), seen: 0, refused: None, row: std::marker::PhantomData };
        let mut json = serde_json::Deserializer::from_slice(&self.bytes);
        let outcome = rows.deserialize(&mut json).and_then(|()| json.end());
        if let Some(refused) = rows.refused {
            return Err(refused);
        }
        if let Err(error) = outcome {
            return Err(self.complaint(&error, rows.seen, path));
        }
        if rows.seen == 0 && !self.whole_table {
            let why = format!("a comma without a row at byte {}", self.offset);
            return Err(DataError::Json { why, path: path.to_owned() });
        }
        Ok(rows.kept)
    }

    /// The position in the whole file, and the token of the bad row where it can still be read.
    fn complaint(&self, error: &serde_json::Error, row: usize, path: &Path) -> DataError {
        let lines = self.bytes.split_inclusive(|byte| *byte == b'\n');
        let before: usize = lines.take(error.line().saturating_sub(1)).map(<[u8]>::len).sum();
        let byte = self.offset + (before + error.column().saturating_sub(1)) as u64;
        let tokens = serde_json::from_slice::<Vec<Token<'_>>>(&self.bytes).unwrap_or_default();
        let token = tokens.get(row).map_or_else(String::new, |row| format!(", row {}", row.token.as_str()));
        let text = error.to_string();
        // serde_json appends the position inside the block, which means nothing to the reader of the message.
        let text = text.split(" at line ").next().unwrap_or(&text);
        DataError::Json { why: format!("{text} at byte {byte}{token}"), path: path.to_owned() }
    }
}

/// Feeds rows one by one into `keep`.
struct Rows<'k, T, R, K> {
    keep: &'k K,
    kept: Vec<R>,
    seen: usize,
    refused: Option<DataError>,
    row: std::marker::PhantomData<T>,
}

impl<'de, T, R, K> DeserializeSeed<'de> for &mut Rows<'_, T, R, K>
where
    T: TableRow,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError>,
{
    type Value = ();

    fn deserialize<D: serde::Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, T, R, K> Visitor<'de> for &mut Rows<'_, T, R, K>
where
    T: TableRow,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError>,
{
    type Value = ();

    fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.write_str("an array of table rows")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<(), A::Error> {
        while let Some(row) = seq.next_element::<T::Row<'de>>()? {
            match (self.keep)(row) {
                Ok(kept) => self.kept.extend(kept),
                Err(error) => {
                    self.refused = Some(error);
                    return Err(serde::de::Error::custom("row refused"));
                }
            }
            self.seen += 1;
        }
        Ok(())
    }
}

/// Cuts a file into blocks.
struct Blocks {
    file: File,
    path: PathBuf,
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
    fn open(path: &Path, block: usize) -> Result<Self, DataError> {
        let file = File::open(path).map_err(|source| match source.kind() {
            std::io::ErrorKind::NotFound => DataError::Missing { what: "table".to_owned(), path: path.to_owned() },
            _ => DataError::Io { action: "open", source, path: path.to_owned() },
        })?;
        Ok(Self {
            file,
            path: path.to_owned(),
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

    fn take(&mut self, count: usize) -> Result<Vec<Block>, DataError> {
        let mut blocks = Vec::new();
        while blocks.len() < count && !self.finished {
            blocks.push(self.next_block()?);
        }
        Ok(blocks)
    }

    fn bad(&self, why: String) -> DataError {
        DataError::Json { why, path: self.path.clone() }
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
            if let Some(cut) = self.cut.filter(|cut| *cut >= self.block) {
                let rest = self.buffer.split_off(cut);
                let mut bytes = std::mem::replace(&mut self.buffer, rest);
                bytes[0] = b'[';
                bytes.push(b']');
                let block = Block { bytes, offset: self.offset, whole_table: false };
                self.offset += cut as u64;
                self.scanned -= cut;
                self.cut = None;
                return Ok(block);
            }
            if self.refill()? == 0 {
                let at = self.offset + self.buffer.len() as u64;
                return Err(self.bad(format!("the file ends at byte {at}, before the end of its array")));
            }
            self.start()?;
        }
    }

    fn refill(&mut self) -> Result<usize, DataError> {
        let wanted = self.block as u64;
        self.file.by_ref().take(wanted).read_to_end(&mut self.buffer).map_err(|source| DataError::Io {
            action: "read",
            source,
            path: self.path.clone(),
        })
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
        while let Some(byte) = self.buffer.get(self.scanned) {
            let at = self.scanned;
            self.scanned += 1;
            if self.in_string {
                match byte {
                    _ if self.escaped => self.escaped = false,
                    b'\\' => self.escaped = true,
                    b'"' => self.in_string = false,
                    _ => {}
                }
                continue;
            }
            match byte {
                b'"' => self.in_string = true,
                b'{' | b'[' => self.depth += 1,
                b'}' | b']' => {
                    self.depth = self.depth.saturating_sub(1);
                    if self.depth == 0 {
                        return Some(self.scanned);
                    }
                }
                b',' if self.depth == 1 => {
                    self.cut = Some(at);
                    if at >= self.block {
                        return None;
                    }
                }
                _ => {}
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
            let more = self.file.by_ref().take(BLOCK as u64).read_to_end(&mut rest);
            let more = more.map_err(|source| DataError::Io { action: "read", source, path: self.path.clone() })?;
            if more == 0 {
                return Ok(());
            }
        }
    }
}

/// A string of a small table, owned.
pub(super) fn owned(text: &Text<'_>) -> Box<str> {
    text.as_str().into()
}

#[cfg(test)]
mod tests {
    use super::super::rows::{LogTable, Stamp};
    use super::*;

    fn blocks_of(text: &str, block: usize) -> Result<Vec<Block>, DataError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.json");
        std::fs::write(&path, text).unwrap();
        let mut blocks = Blocks::open(&path, block)?;
        blocks.take(usize::MAX)
    }

    fn logfiles(text: &str, block: usize) -> Result<Vec<String>, DataError> {
        let keep = |row: super::super::rows::LogRow<'_>| Ok(Some(row.logfile.as_str().to_owned()));
        let parse = |block: &Block| block.parse::<LogTable, _, _>(&keep, Path::new("log.json"));
        Ok(blocks_of(text, block)?.iter().map(parse).collect::<Result<Vec<_>, _>>()?.concat())
    }

    fn row(name: &str) -> String {
        format!(r#"{{"token": "t", "location": "[,]{{", "x": [[1, {{"y": "\"]"}}], 2], "logfile": "{name}"}}"#)
    }

    #[test]
    fn blocks_of_any_size_give_the_same_rows() {
        let names = ["a", "b]", "c\\\\", "d,\\\"}", "e \u{fc}"];
        let rows: Vec<String> = names.iter().map(|name| row(name)).collect();
        let text = format!(" \n[\n{}\n]\n ", rows.join(",\n "));
        let whole = logfiles(&text, 1 << 20).unwrap();
        assert_eq!(whole, ["a", "b]", "c\\", "d,\"}", "e \u{fc}"]);
        for block in 1..text.len() {
            assert_eq!(logfiles(&text, block).unwrap(), whole, "blocks of {block} bytes");
        }
        assert!(logfiles("[]", 1).unwrap().is_empty());
        assert!(logfiles("  [ ] ", 1).unwrap().is_empty());
    }

    #[test]
    fn broken_arrays_are_refused_for_every_block_size() {
        let (a, b) = (row("a"), row("b"));
        let broken = [
            String::new(),
            "   ".to_owned(),
            "{}".to_owned(),
            format!("[{a},{b}"),
            format!("[{a},{b},]"),
            format!("[,{a},{b}]"),
            format!("[{a},,{b}]"),
            format!("[{a},{b}] x"),
            format!("[{a},{b}]]"),
            format!("[{a} {b}]"),
            format!("[{a},7]"),
            format!("[{a},{{]}}]"),
        ];
        for text in &broken {
            for block in [1, 3, 50, 100, 1 << 20] {
                let error = logfiles(text, block).unwrap_err();
                assert!(matches!(error, DataError::Json { .. }), "{text} in blocks of {block} gave {error:?}");
            }
        }
    }

    #[test]
    fn a_bad_row_is_named_with_its_byte() {
        let text = format!(r#"[{}, {{"token": "bad-one", "logfile": 7, "location": ""}}]"#, row("a"));
        for block in [1, 1 << 20] {
            let error = logfiles(&text, block).unwrap_err().to_string();
            assert!(error.contains("row bad-one") && error.contains("logfile") || error.contains("integer"), "{error}");
            let byte: usize = error.split("byte ").nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
            let want = text.find("7,").unwrap();
            assert!(byte.abs_diff(want) <= 1, "byte {byte} instead of {want}: {error}");
        }
    }

    #[test]
    fn stamps_keep_their_nanoseconds() {
        let parse = |text: &str| serde_json::from_str::<Stamp>(text).map(|stamp| stamp.0);
        assert_eq!(parse("1894671007547863").unwrap(), 1_894_671_007_547_863_000);
        assert_eq!(parse("1894671007595189.25").unwrap(), 1_894_671_007_595_189_250);
        assert_eq!(parse("-5").unwrap(), -5000);
        for bad in ["1e300", "9223372036854775807", "18446744073709551615", "\"1\"", "null"] {
            assert!(parse(bad).is_err(), "{bad}");
        }
    }
}
