//! Feather tables for tests: read whole, changed, written again.

use std::path::Path;
use std::sync::Arc;

use arrow_array::{Array, ArrayRef, BooleanArray, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow_ipc::reader::FileReader;
use arrow_ipc::writer::FileWriter;
use arrow_schema::Schema;

pub fn read(path: &Path) -> (Arc<Schema>, Vec<RecordBatch>) {
    let reader = FileReader::try_new(std::io::Cursor::new(std::fs::read(path).unwrap()), None).unwrap();
    (reader.schema(), reader.map(Result::unwrap).collect())
}

pub fn write(path: &Path, batch: &RecordBatch) {
    let mut writer = FileWriter::try_new(Vec::new(), &batch.schema()).unwrap();
    writer.write(batch).unwrap();
    std::fs::write(path, writer.into_inner().unwrap()).unwrap();
}

/// Column names and types.
pub fn types(path: &Path) -> Vec<(String, String)> {
    read(path).0.fields().iter().map(|field| (field.name().clone(), field.data_type().to_string())).collect()
}

pub fn floats(path: &Path, column: &str) -> Vec<f64> {
    let (_, batches) = read(path);
    let column = |batch: &RecordBatch| batch.column_by_name(column).unwrap().clone();
    batches
        .iter()
        .map(column)
        .flat_map(|c| c.as_any().downcast_ref::<Float64Array>().unwrap().values().to_vec())
        .collect()
}

pub fn integers(path: &Path, column: &str) -> Vec<i64> {
    let (_, batches) = read(path);
    let column = |batch: &RecordBatch| batch.column_by_name(column).unwrap().clone();
    batches
        .iter()
        .map(column)
        .flat_map(|c| c.as_any().downcast_ref::<Int64Array>().unwrap().values().to_vec())
        .collect()
}

pub fn texts(path: &Path, column: &str) -> Vec<String> {
    let (_, batches) = read(path);
    let column = |batch: &RecordBatch| batch.column_by_name(column).unwrap().clone();
    let text = |c: ArrayRef| {
        let texts = c.as_any().downcast_ref::<StringArray>().unwrap().clone();
        (0..texts.len()).map(|row| texts.value(row).to_owned()).collect::<Vec<_>>()
    };
    batches.iter().map(column).flat_map(text).collect()
}

/// Keeps the rows of a table of one batch for which the text column passes.
pub fn retain(path: &Path, column: &str, keep: impl Fn(&str) -> bool) {
    let (_, batches) = read(path);
    let names = texts(path, column);
    let mask: BooleanArray = names.iter().map(|name| Some(keep(name))).collect();
    let rows: Vec<usize> = (0..mask.len()).filter(|row| mask.value(*row)).collect();
    let parts: Vec<RecordBatch> = rows.iter().map(|row| batches[0].slice(*row, 1)).collect();
    let schema = batches[0].schema();
    let mut writer = FileWriter::try_new(Vec::new(), &schema).unwrap();
    parts.iter().for_each(|part| writer.write(part).unwrap());
    std::fs::write(path, writer.into_inner().unwrap()).unwrap();
}

/// Replaces a column of a table of one batch.
pub fn replace(path: &Path, column: &str, values: ArrayRef) {
    let (schema, batches) = read(path);
    let columns = schema.fields().iter().zip(batches[0].columns()).map(|(field, old)| {
        let new = if field.name() == column { values.clone() } else { old.clone() };
        (field.name().clone(), new)
    });
    write(path, &RecordBatch::try_from_iter(columns).unwrap());
}
