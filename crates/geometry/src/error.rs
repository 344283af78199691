//! What can be wrong with calibration numbers.

/// A calibration or grid that cannot be used. Readers add the file and row.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum GeometryError {
    /// A quaternion whose norm is further than 1e-3 from 1.
    #[error("quaternion {wxyz:?} (w, x, y, z) has norm {norm}, which is not within 1e-3 of 1")]
    QuaternionNorm {
        /// The four numbers as given.
        wxyz: [f64; 4],
        /// Their norm.
        norm: f64,
    },
    /// A number that is NaN or infinite.
    #[error("{what} is not finite")]
    NotFinite {
        /// Which quantity.
        what: &'static str,
    },
    /// A quantity that must be positive.
    #[error("{what} must be positive, but is {value}")]
    NotPositive {
        /// Which quantity.
        what: &'static str,
        /// Its value.
        value: f64,
    },
    /// A pose was asked for outside the covered time, or inside a gap that is too long to interpolate.
    #[error("no pose at {timestamp_ns} ns: {why}")]
    NoPose {
        /// The instant that was asked for.
        timestamp_ns: i64,
        /// The covered interval or the gap.
        why: String,
    },
}
