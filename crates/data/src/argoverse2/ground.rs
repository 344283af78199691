//! Height of the ground: a raster of half floats and its place in the city.

use geometry::glam::DVec2;
use half::f16;
use serde::{Deserialize, Serialize};

use super::map::the_one;
use crate::DataError;
use crate::store::{Store, StoredFile};

/// Magic and the two version bytes of a NumPy array file.
const MAGIC: &[u8] = b"\x93NUMPY";

/// From city to raster: `p_raster = scale * (rotation * p_city + translation)`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Sim2 {
    /// 2×2 rotation, row by row.
    #[serde(rename = "R")]
    pub rotation: [f64; 4],
    /// Metres.
    #[serde(rename = "t")]
    pub translation: [f64; 2],
    /// Cells per metre.
    #[serde(rename = "s")]
    pub scale: f64,
}

/// Heights of the ground in the city frame.
#[derive(Debug, Clone, PartialEq)]
pub struct GroundHeight {
    rows: usize,
    columns: usize,
    /// Row by row; a row is a step along the raster's y axis. NaN where unknown.
    heights_m: Vec<f16>,
    raster_from_city: Sim2,
}

impl GroundHeight {
    /// From heights row by row, NaN where unknown. `None` when their number is not `rows * columns`.
    pub fn new(rows: usize, columns: usize, heights_m: Vec<f16>, raster_from_city: Sim2) -> Option<Self> {
        (rows.checked_mul(columns) == Some(heights_m.len())).then_some(Self {
            rows,
            columns,
            heights_m,
            raster_from_city,
        })
    }

    /// Level ground between two corners of the city frame, with the release's cells of 0.3 m.
    pub fn level(height_m: f64, low: DVec2, high: DVec2) -> Self {
        const CELLS_PER_M: f64 = 10.0 / 3.0;
        let cells = ((high - low).max(DVec2::ZERO) * CELLS_PER_M).ceil().min(DVec2::splat(30_000.0));
        let (rows, columns) = (cells.y as usize + 1, cells.x as usize + 1);
        Self {
            rows,
            columns,
            heights_m: vec![f16::from_f64(height_m); rows * columns],
            raster_from_city: Sim2 {
                rotation: [1.0, 0.0, 0.0, 1.0],
                translation: [-low.x, -low.y],
                scale: CELLS_PER_M,
            },
        }
    }

    /// Height of the ground at a point of the city frame, metres; `None` outside the raster and where it is unknown. The cell is found by
    /// truncation, so the steps of the raster show.
    pub fn at(&self, city: DVec2) -> Option<f64> {
        let Sim2 { rotation: [a, b, c, d], translation: [tx, ty], scale } = self.raster_from_city;
        let cell = scale * (DVec2::new(a * city.x + b * city.y, c * city.x + d * city.y) + DVec2::new(tx, ty));
        let index = |value: f64, count: usize| {
            let value = value.trunc();
            (value >= 0.0 && value < count as f64).then_some(value as usize)
        };
        let (row, column) = (index(cell.y, self.rows)?, index(cell.x, self.columns)?);
        let height = self.heights_m.get(row * self.columns + column)?.to_f64();
        height.is_finite().then_some(height)
    }

    /// Rows and columns.
    pub fn shape(&self) -> [usize; 2] {
        [self.rows, self.columns]
    }

    /// From city to cells.
    pub fn raster_from_city(&self) -> Sim2 {
        self.raster_from_city
    }

    /// The bytes of the NumPy file.
    pub(crate) fn to_npy(&self) -> Vec<u8> {
        let header =
            format!("{{'descr': '<f2', 'fortran_order': False, 'shape': ({}, {}), }}", self.rows, self.columns);
        // Magic, version, length of the header and the header itself fill a multiple of 64 bytes, the last of them a line feed.
        let whole = (MAGIC.len() + 4 + header.len() + 1).next_multiple_of(64);
        let width = whole - MAGIC.len() - 4;
        let mut bytes = MAGIC.to_vec();
        bytes.extend([1, 0]);
        bytes.extend((width as u16).to_le_bytes());
        bytes.extend(format!("{header:<fill$}\n", fill = width - 1).as_bytes());
        bytes.extend(self.heights_m.iter().flat_map(|height| height.to_le_bytes()));
        bytes
    }

    /// The raster of a log; `None` where it has none.
    pub(super) fn read(store: &Store, log: &str) -> Result<Option<Self>, DataError> {
        let raster = |name: &str| name.contains("_ground_height_surface____") && name.ends_with(".npy");
        let Some(raster) = the_one(store, log, raster)? else { return Ok(None) };
        let sim2 = the_one(store, log, |name| name.ends_with("___img_Sim2_city.json"))?;
        let sim2 = sim2.ok_or_else(|| DataError::Missing {
            what: "place of the ground height raster (*___img_Sim2_city.json)".to_owned(),
            path: store.path(&format!("{log}/map")),
        })?;
        let sim2 = read_sim2(&store.file(&sim2, "place of the ground height raster")?)?;
        let file = store.file(&raster, "ground height raster")?;
        read_npy(&file, sim2).map(Some)
    }
}

fn read_sim2(file: &StoredFile) -> Result<Sim2, DataError> {
    let json = |why: String| DataError::Json { why, path: file.path().to_owned() };
    let sim2: Sim2 = serde_json::from_slice(&file.bytes()?).map_err(|error| json(error.to_string()))?;
    let finite = [&sim2.rotation[..], &sim2.translation[..], &[sim2.scale]].concat().iter().all(|v| v.is_finite());
    if finite && sim2.scale > 0.0 { Ok(sim2) } else { Err(json("its numbers are no similarity".to_owned())) }
}

fn read_npy(file: &StoredFile, raster_from_city: Sim2) -> Result<GroundHeight, DataError> {
    let bytes = file.bytes()?;
    let bad = |why: &str| DataError::Format { format: "NumPy", why: why.to_owned(), path: file.path().to_owned() };
    let array = |got: String| DataError::Array {
        name: "ground height".to_owned(),
        got,
        want: "'<f2' in C order with two axes".to_owned(),
        path: file.path().to_owned(),
    };
    let rest = bytes.strip_prefix(MAGIC).ok_or_else(|| bad("no magic"))?;
    let (width, rest) = match rest {
        [1, _, a, b, rest @ ..] => (u32::from(u16::from_le_bytes([*a, *b])), rest),
        [2 | 3, _, a, b, c, d, rest @ ..] => (u32::from_le_bytes([*a, *b, *c, *d]), rest),
        _ => return Err(bad("no version that is known")),
    };
    let (header, data) = rest.split_at_checked(width as usize).ok_or_else(|| bad("the header is cut"))?;
    let header = std::str::from_utf8(header).map_err(|_| bad("the header is no text"))?;
    let (rows, columns) = half_raster_shape(header).ok_or_else(|| array(header.trim().to_owned()))?;
    if rows.checked_mul(columns).and_then(|cells| cells.checked_mul(2)) != Some(data.len()) {
        return Err(array(format!("{rows} x {columns} in {} bytes", data.len())));
    }
    let heights_m = data.as_chunks::<2>().0.iter().map(|bytes| f16::from_le_bytes(*bytes)).collect();
    Ok(GroundHeight { rows, columns, heights_m, raster_from_city })
}

/// Rows and columns of a header that describes half floats in C order.
fn half_raster_shape(header: &str) -> Option<(usize, usize)> {
    let value = |key: &str| Some(header.split_once(&format!("'{key}':"))?.1.trim_start());
    let half = value("descr")?.starts_with("'<f2'") && value("fortran_order")?.starts_with("False");
    let (shape, _) = value("shape")?.strip_prefix('(')?.split_once(')')?;
    let mut sizes = shape.split(',').map(|size| size.trim().parse::<usize>());
    match (half, sizes.next(), sizes.next(), sizes.next()) {
        (true, Some(Ok(rows)), Some(Ok(columns)), None) => Some((rows, columns)),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(bytes: &[u8]) -> Result<GroundHeight, DataError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ground.npy");
        std::fs::write(&path, bytes).unwrap();
        let sim2 = Sim2 { rotation: [1.0, 0.0, 0.0, 1.0], translation: [-100.0, -50.0], scale: 0.5 };
        read_npy(&path.into(), sim2)
    }

    fn raster() -> GroundHeight {
        let heights: Vec<f16> = [1.0, 2.0, 3.0, 4.0, f64::NAN, 6.0].map(f16::from_f64).to_vec();
        let sim2 = Sim2 { rotation: [1.0, 0.0, 0.0, 1.0], translation: [-100.0, -50.0], scale: 0.5 };
        GroundHeight::new(2, 3, heights, sim2).unwrap()
    }

    #[test]
    fn rows_are_y_and_cells_are_truncated() {
        let ground = read(&raster().to_npy()).unwrap();
        assert_eq!(ground.shape(), [2, 3]);
        assert_eq!(ground.at(DVec2::new(103.9, 51.9)), Some(2.0));
        assert_eq!(ground.at(DVec2::new(100.0, 52.0)), Some(4.0));
        assert_eq!(ground.at(DVec2::new(102.0, 53.0)), None, "not known");
        assert_eq!(
            [DVec2::new(106.0, 50.0), DVec2::new(100.0, 54.0), DVec2::new(97.9, 50.0)].map(|at| ground.at(at)),
            [None; 3]
        );
        assert_eq!(ground.at(DVec2::new(99.0, 50.0)), Some(1.0), "truncation, not rounding down");
    }

    #[test]
    fn other_arrays_are_refused_before_anything_is_reserved() {
        let sound = raster().to_npy();
        assert_eq!(sound.len() % 2, 0);
        for length in 0..sound.len() {
            assert!(read(&sound[..length]).is_err(), "{length} bytes load");
        }
        let header = |text: &str| {
            let mut bytes = MAGIC.to_vec();
            bytes.extend([1, 0]);
            bytes.extend((text.len() as u16).to_le_bytes());
            bytes.extend(text.as_bytes());
            bytes
        };
        for text in [
            "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 0), }",
            "{'descr': '|O', 'fortran_order': False, 'shape': (0, 0), }",
            "{'descr': '<f2', 'fortran_order': True, 'shape': (0, 0), }",
            "{'descr': '<f2', 'fortran_order': False, 'shape': (0,), }",
            "{'descr': '<f2', 'fortran_order': False, 'shape': (4294967296, 4294967296), }",
            "{'descr': '<f2', 'fortran_order': False, 'shape': (1000000, 1000000), }",
        ] {
            assert!(matches!(read(&header(text)), Err(DataError::Array { .. })), "{text}");
        }
        assert!(read(&header("{'descr': '<f2', 'fortran_order': False, 'shape': (0, 0), }")).is_ok());
    }
}
