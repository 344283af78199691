//! Writes Occ3D-nuScenes labels.

use std::io::Write;
use std::path::{Path, PathBuf};

use geometry::Rigid;

use super::grid::{OCC3D_GRID, to_xyz};
use crate::npz::{Dtype, npz_bytes};
use crate::store::checked_name;
use crate::{DataError, OccupancyGrid, OccupancyLabels};

/// A `labels.npz`. A grid without masks is written as seen everywhere, because the format's readers need the masks. Equal grids give
/// equal bytes.
///
/// # Errors
/// [`DataError::Config`] for another grid, frame or label set than Occ3D-nuScenes', for ignored cells, which it cannot express, and for
/// labels or masks of another length.
pub fn occ3d_bytes(grid: &OccupancyGrid) -> Result<Vec<u8>, DataError> {
    let refuse = |why: &str| Err(DataError::Config(format!("these labels cannot be written as Occ3D: {why}")));
    if grid.grid != OCC3D_GRID || grid.label_set != OccupancyLabels::NuScenes {
        return refuse("another grid or label set");
    }
    if grid.ego_from_grid != Rigid::IDENTITY {
        return refuse("they are not in the ego frame");
    }
    if grid.labels.iter().any(|label| !grid.label_set.holds(*label)) {
        return refuse("a cell is of no class");
    }
    let everywhere = || vec![true; grid.labels.len()];
    let mask = |mask: &Option<Vec<bool>>| -> Vec<u8> {
        let mask = mask.clone().unwrap_or_else(everywhere);
        to_xyz(&OCC3D_GRID, &mask).into_iter().map(u8::from).collect()
    };
    let arrays = [
        ("semantics", to_xyz(&OCC3D_GRID, &grid.labels)),
        ("mask_lidar", mask(&grid.lidar_mask)),
        ("mask_camera", mask(&grid.camera_mask)),
    ];
    let [nz, ny, nx] = OCC3D_GRID.cells;
    let shape = [nx, ny, nz];
    let arrays: Vec<_> = arrays.iter().map(|(name, bytes)| (*name, Dtype::U8, &shape[..], bytes.as_slice())).collect();
    npz_bytes(&arrays)
}

/// Writes `gts/<scene>/<sample>/labels.npz` below `root` and returns its path. A file that is already there is never replaced.
///
/// # Errors
/// As [`occ3d_bytes`]; [`DataError::UnsafePath`] for names that are no plain names; [`DataError::Io`].
pub fn write_occ3d(root: &Path, scene: &str, sample: &str, grid: &OccupancyGrid) -> Result<PathBuf, DataError> {
    let name = format!("gts/{scene}/{sample}/labels.npz");
    let path = root.join(checked_name(&name, root)?);
    let bytes = occ3d_bytes(grid)?;
    let io = |action, path: &Path| {
        let path = path.to_owned();
        move |source| DataError::Io { action, source, path }
    };
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(io("make", folder))?;
    }
    let mut file = std::fs::File::create_new(&path).map_err(io("make", &path))?;
    file.write_all(&bytes).map_err(io("write", &path))?;
    Ok(path)
}
