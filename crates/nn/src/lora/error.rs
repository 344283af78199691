//! What can be wrong with adapters.

use std::path::PathBuf;

use crate::weights::WeightError;

/// Why adapters could not be attached, changed, read or written.
#[derive(Debug, thiserror::Error)]
pub enum LoraError {
    /// A setting outside its range.
    #[error("LoRA {name:?}: {reason}")]
    Config {
        /// The adapter.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// A target that names no layer.
    #[error("LoRA {name:?}: target {pattern:?} names no layer of the model; its layers are for example {examples:?}")]
    NoTarget {
        /// The adapter.
        name: String,
        /// The pattern.
        pattern: String,
        /// Some of the model's layers.
        examples: Vec<String>,
    },
    /// An adapter that the model does not carry.
    #[error("the model carries no LoRA {name:?}, only {known:?}")]
    Unknown {
        /// The name asked for.
        name: String,
        /// The names there are.
        known: Vec<String>,
    },
    /// A name that is taken.
    #[error("the model carries a LoRA {name:?} already")]
    Taken {
        /// The name.
        name: String,
    },
    /// Settings beside or inside a file that cannot be used.
    #[error("LoRA settings cannot be used: {reason}: {}", path.display())]
    Settings {
        /// What is wrong.
        reason: String,
        /// The file.
        path: PathBuf,
    },
    /// Tensors that cannot be read, written or do not fit the model.
    #[error(transparent)]
    Weights(#[from] WeightError),
}
