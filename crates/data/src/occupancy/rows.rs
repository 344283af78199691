//! OpenOccupancy and SurroundOcc: lists of occupied cells in the lidar's frame (x right, y forward). Cells that are not listed are free.

use geometry::{BevGrid, Rigid};

use crate::npz::{Dtype, Want, read_npy};
use crate::store::StoredFile;
use crate::{DataError, OccupancyGrid, OccupancyLabels};

/// The grid of OpenOccupancy, lidar frame.
pub const OPEN_OCCUPANCY_GRID: BevGrid =
    BevGrid { x_range: [-51.2, 51.2], y_range: [-51.2, 51.2], z_range: [-5.0, 3.0], cells: [40, 512, 512] };
/// The grid of SurroundOcc, lidar frame.
pub const SURROUND_OCC_GRID: BevGrid =
    BevGrid { x_range: [-50.0, 50.0], y_range: [-50.0, 50.0], z_range: [-5.0, 3.0], cells: [16, 200, 200] };

/// Label 0 in these files: points of no class, to be ignored.
const NO_CLASS: i64 = 0;
const LAST_CLASS: i64 = 16;

/// Reads an OpenOccupancy file: rows z, y, x, label.
///
/// # Errors
/// [`DataError::Array`] for another shape or elements that are no integers, [`DataError::Format`] for a row outside the grid or of no
/// class, naming the row.
pub fn read_open_occupancy(file: &StoredFile, ego_from_lidar: Rigid) -> Result<OccupancyGrid, DataError> {
    read(file, OPEN_OCCUPANCY_GRID, ego_from_lidar, |[z, y, x]| [z, y, x])
}

/// Reads a SurroundOcc file: rows x, y, z, label.
///
/// # Errors
/// As [`read_open_occupancy`].
pub fn read_surround_occ(file: &StoredFile, ego_from_lidar: Rigid) -> Result<OccupancyGrid, DataError> {
    read(file, SURROUND_OCC_GRID, ego_from_lidar, |[x, y, z]| [z, y, x])
}

fn read(
    file: &StoredFile,
    grid: BevGrid,
    ego_from_grid: Rigid,
    cell_of_row: fn([i64; 3]) -> [i64; 3],
) -> Result<OccupancyGrid, DataError> {
    let array = read_npy(file, &Want { dtypes: &Dtype::ALL, shape: &[None, Some(4)] })?;
    let bad = |row: usize, why: &str| DataError::Format {
        format: "npy",
        why: format!("row {row} {why}"),
        path: file.path().to_owned(),
    };
    let values = array.to_i64().map_err(|at| bad(at / 4, "holds a number that is no integer"))?;
    let label_set = OccupancyLabels::NuScenes;
    let mut found = OccupancyGrid::new(grid, ego_from_grid, label_set, vec![label_set.free(); grid.len()])?;
    for (row, values) in values.chunks_exact(4).enumerate() {
        let &[a, b, c, label] = values else { continue };
        let cell = cell_of_row([a, b, c]).map(|at| usize::try_from(at).unwrap_or(usize::MAX));
        if cell.iter().zip(grid.cells).any(|(at, count)| *at >= count) {
            return Err(bad(row, &format!("({a}, {b}, {c}) lies outside the grid")));
        }
        let label = match label {
            NO_CLASS => OccupancyGrid::IGNORED,
            1..=LAST_CLASS => label as u8,
            _ => return Err(bad(row, &format!("has the label {label}, which is no class"))),
        };
        let index = found.index(cell);
        if let Some(place) = found.labels.get_mut(index) {
            *place = label;
        }
    }
    Ok(found)
}
