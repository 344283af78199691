//! `metrics.jsonl`: one JSON object per logged step, flushed at once.

use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};

use serde_json::{Map, Value};

use crate::TrainError;
use crate::files::replace_file;

/// One line of the log.
#[derive(Clone, Copy, Debug)]
pub struct MetricsRow<'a> {
    /// Steps done.
    pub step: u64,
    /// Which kind of values: `train` or `validation`.
    pub split: &'static str,
    /// The values, in order.
    pub values: &'a [(String, f64)],
}

/// The run's metrics file.
#[derive(Debug)]
pub struct MetricsLog {
    path: PathBuf,
    file: File,
}

impl MetricsLog {
    /// Opens `<run_dir>/metrics.jsonl`. Rows after `step`, written by a run that went on beyond its last checkpoint, and
    /// a half-written last row are removed.
    ///
    /// # Errors
    /// When the file cannot be read or written.
    pub fn open(run_dir: &Path, step: u64) -> Result<Self, TrainError> {
        let path = run_dir.join("metrics.jsonl");
        if path.exists() {
            let bytes = fs::read(&path).map_err(TrainError::io("read", &path))?;
            let text = String::from_utf8_lossy(&bytes);
            let kept: String = text.split_inclusive('\n').filter(|line| is_row_until(line, step)).collect();
            if kept.len() != bytes.len() {
                replace_file(&path, kept.as_bytes())?;
            }
        }
        let file = OpenOptions::new().create(true).append(true).open(&path).map_err(TrainError::io("open", &path))?;
        Ok(Self { path, file })
    }

    /// Appends a row. Values that are not finite become `null`.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn append(&mut self, row: MetricsRow) -> Result<(), TrainError> {
        let mut object = Map::new();
        object.insert("step".into(), row.step.into());
        object.insert("split".into(), row.split.into());
        object.extend(row.values.iter().map(|(name, value)| (name.clone(), Value::from(*value))));
        let line = format!("{}\n", Value::Object(object));
        self.file.write_all(line.as_bytes()).map_err(TrainError::io("write", &self.path))
    }
}

fn is_row_until(line: &str, step: u64) -> bool {
    let row: Option<Value> = line.strip_suffix('\n').and_then(|line| serde_json::from_str(line).ok());
    row.and_then(|row| row.get("step")?.as_u64()).is_some_and(|row_step| row_step <= step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_after_the_resumed_step_and_torn_rows_go() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("metrics.jsonl");
        let mut log = MetricsLog::open(folder.path(), 0).unwrap();
        for step in [10, 20, 30] {
            let values = [("loss".to_string(), 0.5), ("bad".to_string(), f64::NAN)];
            log.append(MetricsRow { step, split: "train", values: &values }).unwrap();
        }
        fs::OpenOptions::new().append(true).open(&path).unwrap().write_all(b"{\"step\": 1").unwrap();
        MetricsLog::open(folder.path(), 20).unwrap();
        let text = fs::read_to_string(&path).unwrap();
        let rows: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
        assert_eq!(rows.len(), 2);
        assert_eq!(rows[1]["step"], 20);
        assert_eq!((&rows[1]["loss"], &rows[1]["bad"]), (&Value::from(0.5), &Value::Null));
    }
}
