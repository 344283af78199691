//! `scene_metadata.csv`: tags of the scenes.

use std::collections::BTreeMap;
use std::path::Path;

use crate::DataError;
use crate::store::StoredFile;

/// The column that names the scene.
pub(crate) const SCENE_COLUMN: &str = "scene_id";
/// The other columns of the release, in order.
pub(crate) const TAG_COLUMNS: [&str; 12] = [
    "Weather",
    "Time of Day",
    "Same direction Vehicle Traffic",
    "Road Type",
    "Oncoming vehicle traffic",
    "Cross vehicle traffic",
    "Pedestrian crossing road",
    "Pedestrian on sidewalk",
    "Cyclists / motorbike present",
    "Large Exposure Change",
    "Traffic Light Change",
    "Changing brake light / indicator",
];
/// What the columns hold that are no yes or no.
const VALUES: [(usize, &[&str]); 3] = [
    (0, &["Overcast", "Rainy", "Sunny"]),
    (1, &["Day", "Dusk", "Night"]),
    (3, &["Highway", "Residential", "Rural", "Urban"]),
];
const SEPARATOR: &str = ", ";

/// The tags of all scenes.
#[derive(Debug, Clone, PartialEq, Default)]
pub(super) struct Metadata {
    /// By scene: column and cell.
    rows: BTreeMap<String, Vec<(String, String)>>,
}

impl Metadata {
    /// # Errors
    /// [`DataError::Column`] for a table without scene names, [`DataError::Format`] with the line for rows of another length,
    /// [`DataError::DuplicateToken`] for a scene with two rows.
    pub(super) fn read(file: &StoredFile) -> Result<Self, DataError> {
        let path = file.path();
        let bad = |why: String| DataError::Format { format: "CSV", why, path: path.to_owned() };
        let text = String::from_utf8(file.bytes()?).map_err(|_| bad("it is not UTF-8".to_owned()))?;
        let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
        let header = lines.next().map(|(_, line)| cells(line.trim_start_matches('\u{feff}'))).unwrap_or_default();
        let scene_column = header.iter().position(|name| name == SCENE_COLUMN).ok_or_else(|| DataError::Column {
            column: SCENE_COLUMN.to_owned(),
            why: "it is missing".to_owned(),
            path: path.to_owned(),
        })?;
        let mut rows = BTreeMap::new();
        for (number, line) in lines {
            let mut row = cells(line);
            if row.len() != header.len() {
                let (got, want) = (row.len(), header.len());
                return Err(bad(format!("line {} has {got} cells instead of {want}", number + 1)));
            }
            let scene = row.remove(scene_column);
            let names = header.iter().filter(|name| *name != SCENE_COLUMN).cloned();
            if rows.insert(scene.clone(), names.zip(row).collect()).is_some() {
                return Err(duplicate(scene, path));
            }
        }
        Ok(Self { rows })
    }

    /// Columns and cells of a scene; `None` for a scene without a row.
    pub(super) fn tags(&self, scene: &str) -> Option<&[(String, String)]> {
        self.rows.get(scene).map(Vec::as_slice)
    }

    /// What a scene has, in the order of the columns: the name of a column that says yes, the cell of one that is no yes or no.
    pub(super) fn text(&self, scene: &str) -> Option<String> {
        let tag = |(column, cell): &(String, String)| match cell.as_str() {
            "Yes" => Some(column.clone()),
            "No" | "" => None,
            value => Some(value.to_owned()),
        };
        let tags: Vec<String> = self.tags(scene)?.iter().filter_map(tag).collect();
        (!tags.is_empty()).then(|| tags.join(SEPARATOR))
    }
}

/// The cells of a row whose text [`Metadata::text`] could have made; `None` for other text, which the table has no place for.
pub(crate) fn cells_of_text(text: &str) -> Option<[String; TAG_COLUMNS.len()]> {
    let mut row: [String; TAG_COLUMNS.len()] = TAG_COLUMNS.map(|_| "No".to_owned());
    for (column, _) in VALUES {
        row[column].clear();
    }
    let mut next = 0;
    for tag in text.split(SEPARATOR) {
        let (column, cell) = match TAG_COLUMNS.iter().position(|name| *name == tag) {
            Some(column) => (column, "Yes"),
            None => (VALUES.iter().find(|(_, values)| values.contains(&tag))?.0, tag),
        };
        if column < next {
            return None;
        }
        next = column + 1;
        *row.get_mut(column)? = cell.to_owned();
    }
    Some(row)
}

/// One line of the table.
pub(crate) fn line<'a>(cells: impl IntoIterator<Item = &'a str>) -> String {
    let quoted = |cell: &str| match cell.contains([',', '"']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.to_owned(),
    };
    cells.into_iter().map(quoted).collect::<Vec<_>>().join(",") + "\n"
}

fn duplicate(token: String, path: &Path) -> DataError {
    DataError::DuplicateToken { table: "scene_metadata", token, path: path.to_owned() }
}

/// Cells between commas; quotes hold commas, doubled quotes hold a quote.
fn cells(line: &str) -> Vec<String> {
    let mut cells = vec![String::new()];
    let mut quoted = false;
    let mut chars = line.trim_end_matches('\r').chars().peekable();
    while let Some(char) = chars.next() {
        match char {
            '"' if quoted && chars.peek() == Some(&'"') => {
                chars.next();
                push(&mut cells, '"');
            }
            '"' => quoted = !quoted,
            ',' if !quoted => cells.push(String::new()),
            char => push(&mut cells, char),
        }
    }
    cells.iter().map(|cell| cell.trim().to_owned()).collect()
}

fn push(cells: &mut [String], char: char) {
    if let Some(last) = cells.last_mut() {
        last.push(char);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<Metadata, DataError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("t.csv");
        std::fs::write(&path, text).unwrap();
        Metadata::read(&path.into())
    }

    #[test]
    fn tags_become_text_and_back() {
        let header = line([SCENE_COLUMN].into_iter().chain(TAG_COLUMNS));
        let cells = ["Rainy", "Night", "Yes", "Urban", "No", "Yes", "No", "No", "Yes", "No", "No", "Yes"];
        let table = read(&(header + &line(["scene_007"].into_iter().chain(cells)))).unwrap();
        let text = table.text("scene_007").unwrap();
        assert_eq!(
            text,
            "Rainy, Night, Same direction Vehicle Traffic, Urban, Cross vehicle traffic, Cyclists / motorbike present, \
             Changing brake light / indicator"
        );
        assert_eq!(cells_of_text(&text).unwrap(), cells);
        assert_eq!(table.text("scene_008"), None);
        for other in ["Parked cars, a bus stop", "Urban, Rainy", ""] {
            assert_eq!(cells_of_text(other), None, "{other:?}");
        }
    }

    #[test]
    fn quotes_blank_cells_and_line_ends_are_read() {
        let table = read("\u{feff}scene_id,A,B\r\na,\"x, \"\"y\"\"\",\r\n\r\nb,,\r\n").unwrap();
        assert_eq!(table.text("a").unwrap(), "x, \"y\"");
        assert_eq!((table.text("b"), table.tags("b").unwrap().len()), (None, 2));
        assert_eq!(cells(&line(["p, \"q\"", "r"])), ["p, \"q\"", "r"]);
    }

    #[test]
    fn broken_tables_are_named() {
        assert!(matches!(read("a,b\n1,2\n"), Err(DataError::Column { .. })));
        assert!(matches!(read(""), Err(DataError::Column { .. })));
        assert!(matches!(read("scene_id,b\nx,1\nx,2\n"), Err(DataError::DuplicateToken { .. })));
        let error = read("scene_id,b\nx\n").unwrap_err().to_string();
        assert!(error.contains("line 2 has 1 cells instead of 2") && error.ends_with("t.csv"), "{error}");
    }
}
