//! What can be wrong with the sizes of a network.

use serde::{Deserialize, Serialize};

/// Why a set of sizes builds no network.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error, Serialize, Deserialize)]
pub enum ConfigError {
    /// A size is zero.
    #[error("{what} must be at least 1")]
    Zero {
        /// Which size.
        what: String,
    },
    /// One size must divide another.
    #[error("{divisor_name} {divisor} must divide {value_name} {value}")]
    Divides {
        /// What divides.
        divisor_name: String,
        /// Its value.
        divisor: usize,
        /// What is divided.
        value_name: String,
        /// Its value.
        value: usize,
    },
    /// Lists that go level by level differ in length.
    #[error("{what} has {found} entries for {levels} levels")]
    Levels {
        /// Which list.
        what: String,
        /// Its length.
        found: usize,
        /// Levels of the network.
        levels: usize,
    },
    /// A value outside its range.
    #[error("{what}: {reason}")]
    Range {
        /// Which value.
        what: String,
        /// What it must be.
        reason: String,
    },
}

/// Most channels, tokens' widths and the like; far above any network, and far below an overflow in a parameter's size.
const LARGEST: usize = 1 << 16;

/// Most levels and most residual blocks per level.
const MOST: usize = 32;

/// Refuses a size of 0, and one that no network has (sizes come from files).
pub(crate) fn positive(what: &str, value: usize) -> Result<(), ConfigError> {
    bounded(what, value, LARGEST)
}

/// Refuses a number of layers of 0, and one that no network has.
pub(crate) fn few(what: &str, value: usize) -> Result<(), ConfigError> {
    bounded(what, value, MOST)
}

fn bounded(what: &str, value: usize, largest: usize) -> Result<(), ConfigError> {
    match value {
        0 => Err(ConfigError::Zero { what: what.to_owned() }),
        _ if value > largest => {
            Err(ConfigError::Range { what: what.to_owned(), reason: format!("{value} is more than {largest}") })
        }
        _ => Ok(()),
    }
}

/// Refuses a divisor that leaves a rest.
pub(crate) fn divides(divisor: (&str, usize), value: (&str, usize)) -> Result<(), ConfigError> {
    positive(divisor.0, divisor.1)?;
    positive(value.0, value.1)?;
    if value.1.is_multiple_of(divisor.1) {
        return Ok(());
    }
    Err(ConfigError::Divides {
        divisor_name: divisor.0.to_owned(),
        divisor: divisor.1,
        value_name: value.0.to_owned(),
        value: value.1,
    })
}
