//! What can go wrong while reading or writing a dataset. Callers tell the cases apart without reading the message; the path comes last
//! in the text.

use std::path::PathBuf;

use geometry::GeometryError;

/// A dataset that cannot be read or written as asked.
#[derive(Debug, thiserror::Error)]
pub enum DataError {
    /// A file or folder that must exist does not.
    #[error("missing {what}: {}", path.display())]
    Missing {
        /// What the file is for.
        what: String,
        /// The absent file.
        path: PathBuf,
    },
    /// The operating system refused.
    #[error("cannot {action} ({source}): {}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// Why it failed.
        source: std::io::Error,
        /// On which file.
        path: PathBuf,
    },
    /// A table that is not the JSON it should be.
    #[error("bad JSON, {why}: {}", path.display())]
    Json {
        /// Position and complaint.
        why: String,
        /// The table.
        path: PathBuf,
    },
    /// A file whose format or contents are not what its kind demands.
    #[error("not a readable {format} file ({why}): {}", path.display())]
    Format {
        /// What it should be: Arrow, SQLite, Parquet, COLMAP, pickle, TFRecord, npz, zip, tar.
        format: &'static str,
        /// Position and complaint.
        why: String,
        /// The file.
        path: PathBuf,
    },
    /// A table without a column, or with one of another type.
    #[error("column {column}: {why}: {}", path.display())]
    Column {
        /// The column.
        column: String,
        /// Complaint.
        why: String,
        /// The table's file.
        path: PathBuf,
    },
    /// A checksum that does not fit its bytes.
    #[error("wrong checksum of the {what} at byte {offset}: {}", path.display())]
    Checksum {
        /// Length, payload or entry.
        what: &'static str,
        /// Where it stands.
        offset: u64,
        /// The file.
        path: PathBuf,
    },
    /// A file that ends before its contents do.
    #[error("the file ends early at byte {offset}: {}", path.display())]
    Truncated {
        /// Where the missing part would begin.
        offset: u64,
        /// The file.
        path: PathBuf,
    },
    /// An array of another shape or element type.
    #[error("array {name} is {got}, not {want}: {}", path.display())]
    Array {
        /// Its name in the file.
        name: String,
        /// What the file holds.
        got: String,
        /// What it must hold.
        want: String,
        /// The file.
        path: PathBuf,
    },
    /// A key that names a row that does not exist.
    #[error("row {token} of {table} has a {field} that names no row: {}", path.display())]
    Dangling {
        /// Table that holds the key.
        table: &'static str,
        /// Row that holds the key.
        token: String,
        /// The key's field.
        field: &'static str,
        /// The table's file.
        path: PathBuf,
    },
    /// Two rows with one token.
    #[error("token {token} occurs twice in {table}: {}", path.display())]
    DuplicateToken {
        /// The table.
        table: &'static str,
        /// The token.
        token: String,
        /// The table's file.
        path: PathBuf,
    },
    /// Calibration or a pose that cannot be used.
    #[error("row {row}: {source}: {}", path.display())]
    Calibration {
        /// Token or number of the row.
        row: String,
        /// What is wrong with the numbers.
        source: GeometryError,
        /// The table's file.
        path: PathBuf,
    },
    /// An annotation that cannot be used.
    #[error("annotation {token}: {why}: {}", path.display())]
    Annotation {
        /// The row.
        token: String,
        /// Complaint.
        why: String,
        /// The table's file.
        path: PathBuf,
    },
    /// A picture that cannot be decoded completely.
    #[error("not a readable picture ({why}): {}", path.display())]
    Image {
        /// The decoder's complaint.
        why: String,
        /// The picture.
        path: PathBuf,
    },
    /// A picture whose size differs from its calibration.
    #[error("the picture is {}x{}, its table says {}x{}: {}", got.0, got.1, want.0, want.1, path.display())]
    ImageSize {
        /// Width and height in the file.
        got: (u32, u32),
        /// Width and height in the table.
        want: (u32, u32),
        /// The picture.
        path: PathBuf,
    },
    /// A layout of boxes that cannot be used.
    #[error("{why}: {}", path.display())]
    Layout {
        /// Complaint.
        why: crate::layout::LayoutError,
        /// The layout's file.
        path: PathBuf,
    },
    /// A name inside a file that would leave the dataset's folder.
    #[error("{text:?} is not a plain relative path inside the dataset: {}", path.display())]
    UnsafePath {
        /// The name as written.
        text: String,
        /// The file that holds the name.
        path: PathBuf,
    },
    /// A selection that holds nothing.
    #[error("{what} is empty: {}", path.display())]
    Empty {
        /// Which split or dataset.
        what: String,
        /// Where it was looked for.
        path: PathBuf,
    },
    /// Something this dataset cannot deliver.
    #[error("{dataset} has no {what}")]
    Unsupported {
        /// The dataset's name.
        dataset: String,
        /// What was asked for.
        what: &'static str,
    },
    /// A class name without an entry in the taxonomy.
    #[error("{dataset} has no rule for class {name:?}; add one under `classes` in the config")]
    UnknownClass {
        /// The dataset's name.
        dataset: String,
        /// The native class name.
        name: String,
    },
    /// A setting that cannot be met.
    #[error("{0}")]
    Config(String),
    /// A frame that failed; the cause names the file.
    #[error("frame {frame} of {scene} in {dataset}: {source}")]
    Frame {
        /// Dataset's name.
        dataset: String,
        /// Scene.
        scene: String,
        /// Frame.
        frame: String,
        /// The cause.
        source: Box<DataError>,
    },
}
