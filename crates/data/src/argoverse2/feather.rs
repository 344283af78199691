//! Feather tables by column: any width of numbers, any encoding of text, any number of record batches.

use std::collections::HashMap;
use std::path::PathBuf;

use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type,
    UInt32Type, UInt64Type,
};
use arrow_array::{Array, ArrayRef, Int64Array, RecordBatch};
use arrow_buffer::Buffer;
use arrow_schema::{ArrowError, DataType, Schema};

use super::ipc;
use crate::DataError;
use crate::store::StoredFile;

/// The wanted columns of a table, all record batches.
#[derive(Debug)]
pub(super) struct Table {
    path: PathBuf,
    schema: Schema,
    batches: Vec<RecordBatch>,
}

/// A text column: every distinct value once, and for each row the index of its value.
#[derive(Debug, Default)]
pub(super) struct Texts {
    pub values: Vec<String>,
    pub rows: Vec<u32>,
}

impl Texts {
    /// The text of a row.
    pub fn get(&self, row: usize) -> &str {
        self.rows.get(row).and_then(|value| self.values.get(*value as usize)).map_or("", String::as_str)
    }
}

impl Table {
    /// Reads these columns of a file; others are not decoded.
    ///
    /// # Errors
    /// [`DataError::Format`] for anything but a sound file, [`DataError::Column`] for an absent column.
    pub fn read(file: &StoredFile, columns: &[&str]) -> Result<Self, DataError> {
        Self::decode(file.bytes()?, file.path().to_owned(), columns)
    }

    fn decode(bytes: Vec<u8>, path: PathBuf, columns: &[&str]) -> Result<Self, DataError> {
        let bytes = Buffer::from_vec(bytes);
        let bad = |error: ArrowError| DataError::Format { format: "Arrow", why: error.to_string(), path: path.clone() };
        let (schema, mut decoder, blocks) = ipc::open(&bytes).map_err(bad)?;
        let mut projection = Vec::new();
        for column in columns {
            let at = schema.index_of(column).map_err(|_| DataError::Column {
                column: (*column).to_owned(),
                why: "does not exist".to_owned(),
                path: path.clone(),
            })?;
            projection.push(at);
        }
        projection.sort_unstable();
        decoder = decoder.with_projection(projection);
        let batches = ipc::guarded(|| ipc::decode(&bytes, &mut decoder, &blocks)).map_err(bad)?;
        Ok(Self { schema: (*schema).clone(), batches, path })
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.batches.iter().map(RecordBatch::num_rows).sum()
    }

    /// The file, for errors about its rows.
    pub fn path(&self) -> &std::path::Path {
        &self.path
    }

    /// A column of floats of any width.
    pub fn floats(&self, name: &str) -> Result<Vec<f64>, DataError> {
        let mut all = Vec::with_capacity(self.len());
        for column in self.column(name)? {
            match column.data_type() {
                DataType::Float64 => all.extend(column.as_primitive::<Float64Type>().values().iter().copied()),
                DataType::Float32 => {
                    all.extend(column.as_primitive::<Float32Type>().values().iter().copied().map(f64::from));
                }
                DataType::Float16 => {
                    all.extend(column.as_primitive::<Float16Type>().values().iter().copied().map(f64::from));
                }
                other => return Err(self.wrong_type(name, other, "floating point numbers")),
            }
        }
        Ok(all)
    }

    /// A column of integers of any width.
    pub fn integers(&self, name: &str) -> Result<Vec<i64>, DataError> {
        let mut all = Vec::with_capacity(self.len());
        for column in self.column(name)? {
            let wide = widened(column).ok_or_else(|| self.wrong_type(name, column.data_type(), "integers"))?;
            all.extend(wide);
        }
        Ok(all)
    }

    /// A column of text: plain, large, or a dictionary of one of them.
    pub fn texts(&self, name: &str) -> Result<Texts, DataError> {
        let mut texts = Texts { values: Vec::new(), rows: Vec::with_capacity(self.len()) };
        let mut known: HashMap<String, u32> = HashMap::new();
        for column in self.column(name)? {
            let words = Words::of(column).ok_or_else(|| self.wrong_type(name, column.data_type(), "text"))?;
            for row in 0..column.len() {
                let word = words.get(row).ok_or_else(|| self.column_error(name, format!("row {row} has no text")))?;
                let value = match known.get(word) {
                    Some(value) => *value,
                    None => {
                        let value = texts.values.len() as u32;
                        texts.values.push(word.to_owned());
                        known.insert(word.to_owned(), value);
                        value
                    }
                };
                texts.rows.push(value);
            }
        }
        Ok(texts)
    }

    /// The column in every batch, free of nulls.
    fn column(&self, name: &str) -> Result<Vec<&ArrayRef>, DataError> {
        if self.schema.index_of(name).is_err() {
            return Err(self.column_error(name, "does not exist".to_owned()));
        }
        let mut columns = Vec::new();
        for batch in &self.batches {
            let column =
                batch.column_by_name(name).ok_or_else(|| self.column_error(name, "was not read".to_owned()))?;
            if column.null_count() > 0 {
                return Err(self.column_error(name, format!("{} rows are null", column.null_count())));
            }
            columns.push(column);
        }
        Ok(columns)
    }

    fn wrong_type(&self, name: &str, got: &DataType, want: &str) -> DataError {
        self.column_error(name, format!("holds {got} instead of {want}"))
    }

    fn column_error(&self, column: &str, why: String) -> DataError {
        DataError::Column { column: column.to_owned(), why, path: self.path.clone() }
    }
}

/// The integers of a column; `None` for another type or numbers beyond i64.
fn widened(column: &ArrayRef) -> Option<Vec<i64>> {
    Some(match column.data_type() {
        DataType::Int64 => column.as_primitive::<Int64Type>().values().to_vec(),
        DataType::Int32 => column.as_primitive::<Int32Type>().values().iter().copied().map(i64::from).collect(),
        DataType::Int16 => column.as_primitive::<Int16Type>().values().iter().copied().map(i64::from).collect(),
        DataType::Int8 => column.as_primitive::<Int8Type>().values().iter().copied().map(i64::from).collect(),
        DataType::UInt64 => {
            let values = column.as_primitive::<UInt64Type>().values().iter();
            values.map(|value| i64::try_from(*value).ok()).collect::<Option<_>>()?
        }
        DataType::UInt32 => column.as_primitive::<UInt32Type>().values().iter().copied().map(i64::from).collect(),
        DataType::UInt16 => column.as_primitive::<UInt16Type>().values().iter().copied().map(i64::from).collect(),
        DataType::UInt8 => column.as_primitive::<UInt8Type>().values().iter().copied().map(i64::from).collect(),
        _ => return None,
    })
}

/// A text column whatever its encoding.
struct Words<'a> {
    values: &'a ArrayRef,
    /// Indices into `values`, for dictionaries.
    keys: Option<Int64Array>,
}

impl<'a> Words<'a> {
    fn of(column: &'a ArrayRef) -> Option<Self> {
        let is_text = |array: &ArrayRef| matches!(array.data_type(), DataType::Utf8 | DataType::LargeUtf8);
        if is_text(column) {
            return Some(Self { values: column, keys: None });
        }
        let dictionary = column.as_any_dictionary_opt()?;
        let keys = Int64Array::from(widened(&dictionary.keys().slice(0, dictionary.keys().len()))?);
        is_text(dictionary.values()).then_some(Self { values: dictionary.values(), keys: Some(keys) })
    }

    fn get(&self, row: usize) -> Option<&'a str> {
        let at = match &self.keys {
            Some(keys) => usize::try_from(*keys.values().get(row)?).ok()?,
            None => row,
        };
        if at >= self.values.len() || self.values.is_null(at) {
            return None;
        }
        match self.values.data_type() {
            DataType::LargeUtf8 => Some(self.values.as_string::<i64>().value(at)),
            _ => Some(self.values.as_string::<i32>().value(at)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use arrow_array::{
        DictionaryArray, Float16Array, Float64Array, Int32Array, LargeStringArray, StringArray, UInt16Array,
    };
    use arrow_ipc::writer::{FileWriter, IpcWriteOptions};
    use arrow_ipc::{CompressionType, MetadataVersion};
    use half::f16;

    use super::*;

    /// Two batches of every kind of column that is read.
    fn bytes(compression: Option<CompressionType>) -> Vec<u8> {
        let words: DictionaryArray<Int32Type> = ["b", "a", "b"].into_iter().collect();
        let columns: Vec<(&str, ArrayRef)> = vec![
            ("stamp", Arc::new(Int64Array::from(vec![315_966_265_259_836_001, i64::MAX, -3]))),
            ("size", Arc::new(UInt16Array::from(vec![1, 2048, u16::MAX]))),
            ("value", Arc::new(Float64Array::from(vec![0.1, -2.5, 1e300]))),
            ("half", Arc::new(Float16Array::from([0.5, 1.0, -8.0].map(f16::from_f64).to_vec()))),
            ("word", Arc::new(StringArray::from(vec!["x", "yy", "x"]))),
            ("large", Arc::new(LargeStringArray::from(vec!["p", "q", ""]))),
            ("dictionary", Arc::new(words)),
            ("hole", Arc::new(Int32Array::from(vec![Some(1), None, Some(3)]))),
        ];
        let batch = RecordBatch::try_from_iter(columns).unwrap();
        let options = IpcWriteOptions::try_new(64, false, MetadataVersion::V5).unwrap();
        let options = options.try_with_compression(compression).unwrap();
        let mut writer = FileWriter::try_new_with_options(Vec::new(), &batch.schema(), options).unwrap();
        writer.write(&batch).unwrap();
        writer.write(&batch.slice(1, 2)).unwrap();
        writer.into_inner().unwrap()
    }

    fn read(bytes: &[u8], columns: &[&str]) -> Result<Table, DataError> {
        Table::decode(bytes.to_vec(), "table.feather".into(), columns)
    }

    const ALL: [&str; 8] = ["stamp", "size", "value", "half", "word", "large", "dictionary", "hole"];

    #[test]
    fn every_width_and_encoding_is_read_over_all_batches() {
        for compression in [None, Some(CompressionType::LZ4_FRAME)] {
            let table = read(&bytes(compression), &ALL).unwrap();
            assert_eq!(table.len(), 5);
            assert_eq!(table.integers("stamp").unwrap(), [315_966_265_259_836_001, i64::MAX, -3, i64::MAX, -3]);
            assert_eq!(table.integers("size").unwrap(), [1, 2048, 65535, 2048, 65535]);
            assert_eq!(table.floats("value").unwrap(), [0.1, -2.5, 1e300, -2.5, 1e300]);
            assert_eq!(table.floats("half").unwrap(), [0.5, 1.0, -8.0, 1.0, -8.0]);
            let words = |name: &str| {
                let texts = table.texts(name).unwrap();
                (0..5).map(|row| texts.get(row).to_owned()).collect::<Vec<_>>()
            };
            assert_eq!(words("word"), ["x", "yy", "x", "yy", "x"]);
            assert_eq!(words("large"), ["p", "q", "", "q", ""]);
            assert_eq!(words("dictionary"), ["b", "a", "b", "a", "b"]);
            for error in [
                table.integers("hole").unwrap_err(),
                table.integers("value").unwrap_err(),
                table.floats("size").unwrap_err(),
                table.texts("size").unwrap_err(),
            ] {
                assert!(matches!(error, DataError::Column { .. }) && error.to_string().ends_with("table.feather"));
            }
        }
        assert!(matches!(read(&bytes(None), &["absent"]), Err(DataError::Column { .. })));
    }

    #[test]
    fn damaged_files_end_in_errors_whatever_they_announce() {
        let mut refused = 0;
        for compression in [None, Some(CompressionType::LZ4_FRAME)] {
            let sound = bytes(compression);
            for length in (0..sound.len()).step_by(7) {
                assert!(read(&sound[..length], &ALL).is_err(), "{length} bytes load");
            }
            for at in (0..sound.len() - 8).step_by(4) {
                for word in [i64::MAX, -2, 0x7FFF_FFFF_7FFF_FFFF, 255] {
                    let mut damaged = sound.clone();
                    damaged[at..at + 8].copy_from_slice(&word.to_le_bytes());
                    let table = read(&damaged, &ALL);
                    refused += usize::from(table.is_err());
                    if let Ok(table) = table {
                        for column in ALL {
                            _ = (table.floats(column), table.integers(column), table.texts(column));
                        }
                    }
                }
            }
        }
        assert!(refused > 1000, "{refused}");
    }
}
