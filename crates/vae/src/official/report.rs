//! What became of every key of an official checkpoint.

use std::fmt::{self, Display};

use serde::Serialize;

/// One key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct KeyReport {
    /// Name in the official file.
    pub official: String,
    /// Our parameter, if there is one.
    pub ours: Option<String>,
    /// Shape in the file, if it is there.
    pub shape: Option<Vec<usize>>,
    /// What became of it.
    pub status: KeyStatus,
}

/// What became of a key.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum KeyStatus {
    /// Taken.
    Taken,
    /// No parameter by design: a table that follows from the config, a colour, a network of a loss or metric.
    Ignored,
    /// Our parameter of this shape has no tensor.
    Missing(Vec<usize>),
    /// A tensor without a parameter.
    Unexpected,
    /// The network needs another shape.
    WrongShape(Vec<usize>),
    /// The average has another shape than the parameter.
    WrongAverage(Vec<usize>),
    /// Not made of floats.
    NoFloats,
}

impl KeyStatus {
    /// Whether the key keeps the file from being taken.
    pub fn is_fault(&self) -> bool {
        !matches!(self, Self::Taken | Self::Ignored)
    }
}

impl Display for KeyStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Taken => f.write_str("taken"),
            Self::Ignored => f.write_str("ignored"),
            Self::Missing(wanted) => write!(f, "missing, the network needs {wanted:?}"),
            Self::Unexpected => f.write_str("unexpected"),
            Self::WrongShape(wanted) => write!(f, "wrong shape, the network needs {wanted:?}"),
            Self::WrongAverage(found) => write!(f, "its average has the shape {found:?}"),
            Self::NoFloats => f.write_str("holds no floats"),
        }
    }
}

/// Every key: the file's in the file's order, then those that it lacks.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Report {
    /// One entry per key.
    pub keys: Vec<KeyReport>,
}

impl Report {
    /// The keys that keep the file from being taken.
    pub fn faults(&self) -> impl Iterator<Item = &KeyReport> {
        self.keys.iter().filter(|key| key.status.is_fault())
    }

    /// How many keys were taken.
    pub fn taken(&self) -> usize {
        self.keys.iter().filter(|key| key.status == KeyStatus::Taken).count()
    }

    /// How many were ignored.
    pub fn ignored(&self) -> usize {
        self.keys.iter().filter(|key| key.status == KeyStatus::Ignored).count()
    }

    /// A table of all keys.
    pub fn markdown(&self) -> String {
        let row = |key: &KeyReport| {
            let shape = key.shape.as_ref().map_or_else(|| "-".to_owned(), |shape| format!("{shape:?}"));
            let ours = key.ours.as_deref().unwrap_or("-");
            format!("| {} | {ours} | {shape} | {} |\n", key.official, key.status)
        };
        let head = "| official name | ours | shape | status |\n|---|---|---|---|\n".to_owned();
        self.keys.iter().fold(head, |text, key| text + &row(key))
    }
}

/// The faults, at most twenty of them line by line.
impl Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const MOST: usize = 20;
        for key in self.faults().take(MOST) {
            let shape = key.shape.as_ref().map_or_else(String::new, |shape| format!(" {shape:?}"));
            write!(f, "\n  {}{shape}: {}", key.official, key.status)?;
        }
        match self.faults().count().saturating_sub(MOST) {
            0 => Ok(()),
            more => write!(f, "\n  and {more} more"),
        }
    }
}
