//! Logs are SQLite databases from elsewhere: opened read-only and immutable, and trusted in nothing but plain tables.

use std::path::{Path, PathBuf};

use rusqlite::types::ValueRef;
use rusqlite::{Connection, MAIN_DB, OpenFlags};

use super::token::Token;
use crate::DataError;
use crate::store::StoredFile;

/// Functions in a foreign schema must not run, nothing may be written, and sorting must not spill to disk.
const SETTINGS: &str =
    "PRAGMA trusted_schema = OFF; PRAGMA query_only = ON; PRAGMA temp_store = MEMORY; PRAGMA cell_size_check = ON;";
/// No row of a table with an eight-byte key is smaller. Pages that name the same child twice could otherwise give rows without end.
const SMALLEST_ROW_BYTES: u64 = 8;

/// An opened database.
#[derive(Debug)]
pub(crate) struct Database {
    connection: Connection,
    path: PathBuf,
    most_rows: u64,
}

impl Database {
    /// # Errors
    /// [`DataError::Missing`] or [`DataError::Io`] for the file, [`DataError::Format`] for something that is no database.
    pub fn open(file: &StoredFile) -> Result<Self, DataError> {
        let Some(path) = file.on_disk() else { return Self::from_bytes(file.bytes()?, file.path()) };
        let io = |source| DataError::Io { action: "open", source, path: path.to_owned() };
        let size = std::fs::metadata(path).map_err(io)?.len();
        let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
        let connection = Connection::open_with_flags(immutable_uri(path), flags).map_err(sqlite(path))?;
        Self::checked(connection, path, size)
    }

    /// A database inside an archive.
    pub fn from_bytes(mut bytes: Vec<u8>, path: &Path) -> Result<Self, DataError> {
        // SQLite refuses write-ahead logging in memory; without a log file beside it the two modes hold the same pages.
        for version in bytes.iter_mut().skip(18).take(2) {
            *version = (*version).min(1);
        }
        if bytes.is_empty() {
            return Err(DataError::Format { format: "SQLite", why: "it is empty".to_owned(), path: path.to_owned() });
        }
        let mut connection = Connection::open_in_memory().map_err(sqlite(path))?;
        connection.deserialize_read_exact(MAIN_DB, bytes.as_slice(), bytes.len(), true).map_err(sqlite(path))?;
        Self::checked(connection, path, bytes.len() as u64)
    }

    fn checked(connection: Connection, path: &Path, size: u64) -> Result<Self, DataError> {
        connection.execute_batch(SETTINGS).map_err(sqlite(path))?;
        let database = Self { connection, path: path.to_owned(), most_rows: size / SMALLEST_ROW_BYTES };
        // The settings alone read nothing of the file.
        database.has_table("camera")?;
        Ok(database)
    }

    /// The file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// # Errors
    /// A name that stands for a view or a virtual table: those run code of the file's author.
    pub fn has_table(&self, table: &str) -> Result<bool, DataError> {
        let query =
            "SELECT type, rootpage FROM sqlite_schema WHERE name = ?1 COLLATE NOCASE AND type IN ('table', 'view')";
        let mut statement = self.connection.prepare(query).map_err(sqlite(&self.path))?;
        let mut rows = statement.query([table]).map_err(sqlite(&self.path))?;
        let Some(row) = rows.next().map_err(sqlite(&self.path))? else { return Ok(false) };
        let kind: String = row.get(0).map_err(sqlite(&self.path))?;
        let root: i64 = row.get(1).map_err(sqlite(&self.path))?;
        if kind == "table" && root > 0 {
            return Ok(true);
        }
        Err(self.bad(format!("{table} is no plain table")))
    }

    /// Whether a table has no rows.
    pub fn is_empty(&self, table: &'static str) -> Result<bool, DataError> {
        let columns = ["token"];
        self.check_columns(table, &columns)?;
        let first = self.query(&format!("SELECT token FROM {table} LIMIT 1"), [], table, &columns, |_| Ok(()))?;
        Ok(first.is_empty())
    }

    /// A complaint about the file.
    pub fn bad(&self, why: String) -> DataError {
        DataError::Format { format: "SQLite", why, path: self.path.clone() }
    }

    /// That the table exists with stored columns of these names.
    pub fn check_columns(&self, table: &str, columns: &[&str]) -> Result<(), DataError> {
        if !self.has_table(table)? {
            return Err(self.bad(format!("it has no table {table}")));
        }
        let query = "SELECT name, hidden FROM pragma_table_xinfo(?1)";
        let mut statement = self.connection.prepare(query).map_err(sqlite(&self.path))?;
        let found = statement.query_map([table], |row| Ok((row.get(0)?, row.get(1)?))).map_err(sqlite(&self.path))?;
        let found: Vec<(String, i64)> = found.collect::<Result<_, _>>().map_err(sqlite(&self.path))?;
        for column in columns {
            let why = match found.iter().find(|(name, _)| name.eq_ignore_ascii_case(column)) {
                Some((_, 0)) => continue,
                Some(_) => "is computed, not stored",
                None => "does not exist",
            };
            let column = format!("{table}.{column}");
            return Err(DataError::Column { column, why: why.to_owned(), path: self.path.clone() });
        }
        Ok(())
    }

    /// Whether a plain table has a stored column of this name.
    pub fn has_column(&self, table: &str, column: &str) -> Result<bool, DataError> {
        match self.check_columns(table, &[column]) {
            Ok(()) => Ok(true),
            Err(DataError::Column { .. }) => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Reads a table in the order of the file. The first column must be the row's token.
    ///
    /// # Errors
    /// An absent table or column, a damaged file, and whatever `read` refuses.
    pub fn read<T>(
        &self,
        table: &'static str,
        columns: &[&'static str],
        mut read: impl FnMut(&Row<'_>) -> Result<T, DataError>,
    ) -> Result<Vec<T>, DataError> {
        self.check_columns(table, columns)?;
        self.query(&format!("SELECT {} FROM {table}", columns.join(", ")), [], table, columns, &mut read)
    }

    /// Reads the rows of a query whose results are `columns`; its tables must have been read or checked before.
    pub fn query<T>(
        &self,
        sql: &str,
        parameters: impl rusqlite::Params,
        table: &'static str,
        columns: &[&'static str],
        mut read: impl FnMut(&Row<'_>) -> Result<T, DataError>,
    ) -> Result<Vec<T>, DataError> {
        let mut statement = self.connection.prepare(sql).map_err(sqlite(&self.path))?;
        let mut rows = statement.query(parameters).map_err(sqlite(&self.path))?;
        let mut all = Vec::new();
        while let Some(row) = rows.next().map_err(sqlite(&self.path))? {
            if all.len() as u64 >= self.most_rows {
                return Err(self.bad(format!("{table} gives more rows than the file can hold")));
            }
            all.push(read(&Row { row, table, columns, path: &self.path })?);
        }
        Ok(all)
    }
}

/// An error of SQLite with its file.
pub(crate) fn sqlite(path: &Path) -> impl FnOnce(rusqlite::Error) -> DataError {
    move |error| DataError::Format { format: "SQLite", why: error.to_string(), path: path.to_owned() }
}

/// SQLite's own spelling of a path; without `immutable` it fails on read-only disks.
fn immutable_uri(path: &Path) -> String {
    let mut uri = "file:".to_owned();
    for byte in path.as_os_str().as_encoded_bytes() {
        match byte {
            b'/' | b'-' | b'_' | b'.' | b'~' => uri.push(char::from(*byte)),
            byte if byte.is_ascii_alphanumeric() => uri.push(char::from(*byte)),
            byte => uri.push_str(&format!("%{byte:02X}")),
        }
    }
    uri.push_str("?mode=ro&immutable=1");
    uri
}

/// A row whose values are asked for by position.
pub(crate) struct Row<'r> {
    row: &'r rusqlite::Row<'r>,
    table: &'static str,
    columns: &'r [&'static str],
    path: &'r Path,
}

impl Row<'_> {
    /// A value of another type than the column's.
    pub fn wrong(&self, at: usize, why: &str) -> DataError {
        let row = match self.row.get_ref(0) {
            Ok(ValueRef::Integer(key)) => key.to_string(),
            Ok(ValueRef::Blob(token)) => token.iter().map(|byte| format!("{byte:02x}")).collect(),
            _ => "without a token".to_owned(),
        };
        let column = self.columns.get(at).copied().unwrap_or_default();
        let column = format!("{}.{column}", self.table);
        DataError::Column { column, why: format!("row {row} {why}"), path: self.path.to_owned() }
    }

    fn value(&self, at: usize) -> Result<ValueRef<'_>, DataError> {
        self.row.get_ref(at).map_err(sqlite(self.path))
    }

    /// A key that may be absent.
    pub fn maybe_token(&self, at: usize) -> Result<Option<Token>, DataError> {
        match self.value(at)? {
            ValueRef::Null => Ok(None),
            ValueRef::Blob(bytes) => {
                let token = bytes.try_into().map(Token);
                token.map(Some).map_err(|_| self.wrong(at, "holds a token that is not 8 bytes long"))
            }
            _ => Err(self.wrong(at, "holds no token of 8 bytes")),
        }
    }

    /// A key.
    pub fn token(&self, at: usize) -> Result<Token, DataError> {
        self.maybe_token(at)?.ok_or_else(|| self.wrong(at, "holds nothing"))
    }

    /// A number that may be absent.
    pub fn maybe_number(&self, at: usize) -> Result<Option<f64>, DataError> {
        match self.value(at)? {
            ValueRef::Null => Ok(None),
            ValueRef::Integer(value) => Ok(Some(value as f64)),
            ValueRef::Real(value) => Ok(Some(value)),
            _ => Err(self.wrong(at, "holds no number")),
        }
    }

    /// A number, stored as INTEGER or REAL.
    pub fn number(&self, at: usize) -> Result<f64, DataError> {
        self.maybe_number(at)?.ok_or_else(|| self.wrong(at, "holds nothing"))
    }

    /// `N` numbers from column `at` on.
    pub fn numbers<const N: usize>(&self, at: usize) -> Result<[f64; N], DataError> {
        let mut numbers = [0.0; N];
        for (offset, number) in numbers.iter_mut().enumerate() {
            *number = self.number(at + offset)?;
        }
        Ok(numbers)
    }

    /// A stamp in microseconds as nanoseconds.
    pub fn time_ns(&self, at: usize) -> Result<i64, DataError> {
        let microseconds = match self.value(at)? {
            ValueRef::Integer(value) => Some(value),
            // Whole microseconds are exact in f64 up to 9e15, which is the year 2255.
            ValueRef::Real(value) => (value.fract() == 0.0 && value.abs() < 9e15).then_some(value as i64),
            _ => None,
        };
        let nanoseconds = microseconds.and_then(|value| value.checked_mul(1000));
        nanoseconds.ok_or_else(|| self.wrong(at, "holds no time in microseconds"))
    }

    /// A picture side: a whole number, stored as INTEGER or REAL.
    pub fn side(&self, at: usize) -> Result<u32, DataError> {
        let value = self.number(at)?;
        let whole = value.fract() == 0.0 && (0.0..=65_535.0).contains(&value);
        if whole { Ok(value as u32) } else { Err(self.wrong(at, &format!("holds {value}, no picture size"))) }
    }

    /// Text.
    pub fn text(&self, at: usize) -> Result<&str, DataError> {
        match self.value(at)? {
            ValueRef::Text(bytes) => {
                std::str::from_utf8(bytes).map_err(|_| self.wrong(at, "holds text that is not UTF-8"))
            }
            _ => Err(self.wrong(at, "holds no text")),
        }
    }

    /// Text that may be absent.
    pub fn maybe_text(&self, at: usize) -> Result<Option<&str>, DataError> {
        match self.value(at)? {
            ValueRef::Null => Ok(None),
            _ => self.text(at).map(Some),
        }
    }

    /// Bytes that may be absent.
    pub fn maybe_blob(&self, at: usize) -> Result<Option<&[u8]>, DataError> {
        match self.value(at)? {
            ValueRef::Null => Ok(None),
            _ => self.blob(at).map(Some),
        }
    }

    /// Bytes.
    pub fn blob(&self, at: usize) -> Result<&[u8], DataError> {
        match self.value(at)? {
            ValueRef::Blob(bytes) => Ok(bytes),
            _ => Err(self.wrong(at, "holds no bytes")),
        }
    }

    /// The database.
    pub fn path(&self) -> &Path {
        self.path
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn made(sql: &str) -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        // Every character that means something in a URI.
        let path = folder.path().join("a log?mode=rwc#1%20&x.db");
        Connection::open(&path).unwrap().execute_batch(sql).unwrap();
        (folder, path)
    }

    fn tokens(database: &Database) -> Vec<String> {
        database.read("camera", &["token"], |row| Ok(row.token(0)?.to_string())).unwrap()
    }

    const CAMERA: &str = "CREATE TABLE camera (token BLOB); INSERT INTO camera VALUES (x'00000000000000ab');";

    #[test]
    fn files_and_bytes_read_alike_also_with_write_ahead_logging() {
        for mode in ["DELETE", "WAL"] {
            let (folder, path) = made(&format!("PRAGMA journal_mode = {mode}; {CAMERA}"));
            let bytes = std::fs::read(&path).unwrap();
            assert_eq!(bytes[18], if mode == "WAL" { 2 } else { 1 });
            let before = std::fs::read_dir(folder.path()).unwrap().count();
            assert_eq!(tokens(&Database::open(&path.clone().into()).unwrap()), ["00000000000000ab"]);
            assert_eq!(tokens(&Database::from_bytes(bytes.clone(), &path).unwrap()), ["00000000000000ab"]);
            // Reading leaves no journal and no shared memory file behind, and the file as it was.
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), before);
            assert_eq!(std::fs::read(&path).unwrap(), bytes);
        }
    }

    #[test]
    fn what_is_no_database_is_refused() {
        let path = Path::new("x/log.db");
        for bytes in [Vec::new(), b"SQLite format 3\0".to_vec(), vec![7; 5000]] {
            let error = Database::from_bytes(bytes, path).and_then(|db| db.check_columns("camera", &[])).unwrap_err();
            assert!(error.to_string().ends_with("x/log.db"), "{error}");
        }
        let absent = Database::open(&PathBuf::from("absent.db").into()).unwrap_err();
        assert!(absent.to_string().ends_with("absent.db"), "{absent}");
    }

    #[test]
    fn nothing_can_be_written_and_no_more_rows_are_read_than_fit() {
        let (_folder, path) = made(CAMERA);
        let mut database = Database::open(&path.clone().into()).unwrap();
        assert!(database.connection.execute_batch("DELETE FROM camera").is_err());
        database.most_rows = 0;
        let error = database.read("camera", &["token"], |_| Ok(())).unwrap_err().to_string();
        assert!(error.contains("more rows than the file can hold"), "{error}");
    }
}
