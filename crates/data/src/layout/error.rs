//! What can be wrong with a layout.

use super::MOST_BOXES;

/// A layout that cannot be used. Every message names the box.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LayoutError {
    /// A class that the table lacks.
    #[error("box {id:?} has the unknown class {class:?}; the classes are {}", known.join(", "))]
    UnknownClass {
        /// The box.
        id: String,
        /// Its class.
        class: String,
        /// The table.
        known: Vec<String>,
    },
    /// NaN or infinite numbers.
    #[error("box {id:?}: the {what} is not finite")]
    NotFinite {
        /// The box.
        id: String,
        /// Which numbers.
        what: &'static str,
    },
    /// A size that is not positive.
    #[error("box {id:?}: length, width and height must be above 0 m, but are {size:?}")]
    Size {
        /// The box.
        id: String,
        /// Length, width, height, metres.
        size: [f64; 3],
    },
    /// A quaternion that is no rotation.
    #[error("box {id:?}: the rotation quaternion has norm {norm}, it must be 1")]
    Rotation {
        /// The box.
        id: String,
        /// Its norm.
        norm: f64,
    },
    /// A heading that is missing, given twice or no rotation.
    #[error("box {id:?}: {why}")]
    Heading {
        /// The box.
        id: String,
        /// Complaint.
        why: String,
    },
    /// Two boxes with one id.
    #[error("two boxes are called {id:?}; give each its own id")]
    DuplicateId {
        /// The id.
        id: String,
    },
    /// More boxes than [`MOST_BOXES`].
    #[error("{count} boxes; a layout holds at most {MOST_BOXES}")]
    TooMany {
        /// How many there are.
        count: usize,
    },
    /// A change that cannot be made.
    #[error("edit {edit:?}: {why}")]
    Edit {
        /// The change as written.
        edit: String,
        /// Complaint.
        why: String,
    },
    /// A share of the way between two layouts outside 0 to 1.
    #[error("{amount} is no share of the way between two layouts, it must lie in 0..=1")]
    Amount {
        /// The number.
        amount: f64,
    },
    /// A table of classes that names nothing or one class twice.
    #[error("bad table of classes: {why}")]
    Classes {
        /// Complaint.
        why: String,
    },
    /// A grid that cannot be filled.
    #[error("bad grid: {0}")]
    Grid(#[from] geometry::GeometryError),
}
