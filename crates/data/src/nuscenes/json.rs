//! Streams a table: one JSON array of objects, up to gigabytes, in constant memory and on all cores.
//!
//! [`Blocks`] cuts the file between rows; blocks are parsed in parallel while the next ones are read. No row outlives its block.

use std::path::Path;

use rayon::prelude::*;
use serde::Deserialize;
use serde::de::{DeserializeSeed, SeqAccess, Visitor};

use super::blocks::{BLOCK, Block, Blocks};
use super::rows::{Text, Token};
use crate::DataError;
use crate::store::StoredFile;

/// A table's row as it stands in the file, borrowing from the block.
pub(super) trait TableRow {
    /// The row.
    type Row<'a>: Deserialize<'a>;
}

/// Parses every row, keeps what `keep` returns and hands it to `sink` in file order.
///
/// # Errors
/// [`DataError::Missing`], [`DataError::Io`], [`DataError::Json`] with byte and token of the bad row, and whatever `keep` or `sink` return.
pub(super) fn read_table<T, R, K, S>(file: &StoredFile, keep: K, mut sink: S) -> Result<(), DataError>
where
    T: TableRow,
    R: Send,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError> + Sync,
    S: FnMut(Vec<R>) -> Result<(), DataError> + Send,
{
    let path = file.path();
    let mut blocks = Blocks::open(file, BLOCK)?;
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
pub(super) fn read_all<T, R, K>(file: &StoredFile, keep: K) -> Result<Vec<R>, DataError>
where
    T: TableRow,
    R: Send,
    K: Fn(T::Row<'_>) -> Result<Option<R>, DataError> + Sync,
{
    let mut rows = Vec::new();
    read_table::<T, R, K, _>(file, keep, |part| {
        rows.extend(part);
        Ok(())
    })?;
    Ok(rows)
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
        let mut blocks = Blocks::open(&path.into(), block)?;
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
