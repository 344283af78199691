//! What can be wrong with tokenizers and text encoders.

use std::path::PathBuf;

use nn::weights::WeightError;

/// Why a tokenizer or a text encoder could not be built, read or written. The path stands last.
#[derive(Debug, thiserror::Error)]
pub enum TextError {
    /// The operating system refused.
    #[error("{source}: {}", path.display())]
    Io {
        /// What the system said.
        source: std::io::Error,
        /// The file or folder.
        path: PathBuf,
    },
    /// A file does not hold what it should.
    #[error("{reason}: {}", path.display())]
    Format {
        /// What is wrong.
        reason: String,
        /// The file or folder.
        path: PathBuf,
    },
    /// A line of a file does not hold what it should.
    #[error("line {line}: {reason}: {}", path.display())]
    Line {
        /// Counted from 1.
        line: usize,
        /// What is wrong.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// Sizes that build no encoder.
    #[error("text encoder: {0}")]
    Sizes(String),
    /// The weights cannot be read or do not fit the config.
    #[error(transparent)]
    Weights(#[from] WeightError),
}
