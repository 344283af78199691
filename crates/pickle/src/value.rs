//! What [`super::decode`] returns.

/// A decoded object. Lists that Python shared are copies here.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// `None`.
    None,
    /// An integer of at most 64 bits.
    Int(i64),
    /// A float.
    Float(f64),
    /// A string.
    Text(String),
    /// A list, or an instance of an allowed list class.
    List(Vec<Self>),
    /// A tuple.
    Tuple(Vec<Self>),
}

impl Value {
    /// A float or an integer as f64.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Int(value) => Some(*value as f64),
            Self::Float(value) => Some(*value),
            _ => None,
        }
    }

    /// The items of a list or tuple.
    pub fn items(&self) -> Option<&[Self]> {
        match self {
            Self::List(items) | Self::Tuple(items) => Some(items),
            _ => None,
        }
    }

    /// A list or tuple of exactly `N` numbers.
    pub fn numbers<const N: usize>(&self) -> Option<[f64; N]> {
        let numbers: Option<Vec<f64>> = self.items()?.iter().map(Self::number).collect();
        numbers?.try_into().ok()
    }

    /// Exactly `R` rows of exactly `C` numbers.
    pub fn rows<const R: usize, const C: usize>(&self) -> Option<[[f64; C]; R]> {
        let rows: Option<Vec<[f64; C]>> = self.items()?.iter().map(Self::numbers).collect();
        rows?.try_into().ok()
    }

    /// Kind and length, for messages.
    pub fn describe(&self) -> String {
        match self {
            Self::None => "None".to_owned(),
            Self::Int(_) | Self::Float(_) => "one number".to_owned(),
            Self::Text(_) => "text".to_owned(),
            Self::List(items) => format!("a list of {}", items.len()),
            Self::Tuple(items) => format!("a tuple of {}", items.len()),
        }
    }
}
