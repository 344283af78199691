//! What can be wrong with the input of a metric.

/// Why a metric has no value.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MetricError {
    /// A covariance or a pair statistic needs more samples.
    #[error("{what} has {found} samples, at least {needed} are needed; add images or clips")]
    TooFew {
        /// Which set.
        what: String,
        /// Its samples.
        found: usize,
        /// Samples the metric needs.
        needed: usize,
    },
    /// Two sets or a row do not belong to the same feature.
    #[error(
        "{what}: {found} numbers per sample where {expected} are expected; both sides must come from the same network and layer"
    )]
    Width {
        /// Which rows.
        what: String,
        /// Their length.
        found: usize,
        /// The length asked for.
        expected: usize,
    },
    /// A network returned NaN or infinity.
    #[error("a feature of sample {sample} is not finite: the network or its input is broken")]
    NotFinite {
        /// Position among the rows given.
        sample: usize,
    },
    /// A picture is smaller than the metric's windows.
    #[error("{what} needs pictures of at least {needed} px on both sides, got {height}x{width}")]
    TooSmall {
        /// Which metric.
        what: String,
        /// Smallest allowed side, px.
        needed: usize,
        /// Rows, px.
        height: usize,
        /// Columns, px.
        width: usize,
    },
    /// Halves of a picture do not fit the matcher's grid.
    #[error(
        "halves of {height}x{width} pictures cannot be matched: the height must be a multiple of 8, the width of 16; resize them"
    )]
    SeamSize {
        /// Rows, px.
        height: usize,
        /// Columns, px.
        width: usize,
    },
    /// An eigenvalue iteration did not converge.
    #[error("the eigenvalues of a {size}x{size} covariance cannot be computed: it holds {reason}")]
    Eigen {
        /// Rows of the matrix.
        size: usize,
        /// What is wrong with it.
        reason: String,
    },
    /// A detection result breaks the rules of the benchmark.
    #[error("{0}")]
    Detection(String),
    /// A protocol file is wrong.
    #[error("{0}")]
    Protocol(String),
}
