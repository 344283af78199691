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
    /// A list of numbers of another length.
    #[error("{what} holds {got} numbers, not {want}")]
    Count {
        /// Which quantity.
        what: &'static str,
        /// How many there are.
        got: usize,
        /// How many there must be.
        want: usize,
    },
    /// A 4×4 matrix that is not a rotation with a shift.
    #[error("{what} is not a rotation with a shift: it differs from one by {deviation}")]
    NotRigid {
        /// Which matrix.
        what: &'static str,
        /// Greatest deviation of RᵀR from the identity, or of the last row from (0, 0, 0, 1); 2 for a mirror image.
        deviation: f64,
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
