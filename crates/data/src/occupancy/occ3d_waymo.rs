//! Occ3D-Waymo: dense labels with observation states, in the vehicle frame.
//!
//! <https://tsinghua-mars-lab.github.io/Occ3D/>

use geometry::{BevGrid, Rigid};
use serde::{Deserialize, Serialize};

use super::grid::{OCC3D_GRID, from_xyz};
use super::occ3d::{bytes, check_labels, truths};
use crate::npz::Npz;
use crate::store::{Roots, Store, StoredFile};
use crate::{DataError, OccupancyGrid, OccupancyLabels};

/// Which of the two label files of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum WaymoVoxels {
    /// 0.4 m, ±40 m: the grid of Occ3D-nuScenes, one megabyte.
    #[default]
    Coarse,
    /// 0.1×0.1×0.2 m, ±80 m, z -5 to 7.8: half a gigabyte with both masks.
    Fine,
}

impl WaymoVoxels {
    /// The labels' grid.
    pub const fn grid(self) -> BevGrid {
        match self {
            Self::Coarse => OCC3D_GRID,
            Self::Fine => BevGrid {
                x_range: [-80.0, 80.0],
                y_range: [-80.0, 80.0],
                z_range: [-5.0, 7.8],
                cells: [64, 1600, 1600],
            },
        }
    }
}

/// A split folder (`training` or `validation`) of Occ3D-Waymo labels.
#[derive(Debug, Clone)]
pub struct Occ3dWaymo {
    store: Store,
    voxels: WaymoVoxels,
}

impl Occ3dWaymo {
    /// `root` holds the scenes' folders `000`, `001`, ...
    ///
    /// # Errors
    /// [`DataError::Missing`] without the folder.
    pub fn open(root: impl Into<Roots>, voxels: WaymoVoxels) -> Result<Self, DataError> {
        Ok(Self { store: Store::open_all(&root.into())?, voxels })
    }

    /// Labels of a frame, both numbered from 0 as the files are.
    ///
    /// # Errors
    /// [`DataError::Missing`] for a frame without labels; a broken file as [`read_occ3d_waymo`].
    pub fn read(&self, scene: usize, frame: usize) -> Result<OccupancyGrid, DataError> {
        let ending = match self.voxels {
            WaymoVoxels::Coarse => "_04.npz",
            WaymoVoxels::Fine => ".npz",
        };
        let name = format!("{scene:03}/{frame:03}{ending}");
        read_occ3d_waymo(&self.store.file(&name, "occupancy labels")?, self.voxels)
    }
}

/// Reads one label file. The camera mask is what the cameras observed and have in view; free keeps the file's label 23.
///
/// # Errors
/// As [`super::read_occ3d`].
pub fn read_occ3d_waymo(file: &StoredFile, voxels: WaymoVoxels) -> Result<OccupancyGrid, DataError> {
    let grid = voxels.grid();
    let [nz, ny, nx] = grid.cells;
    let shape = [Some(nx), Some(ny), Some(nz)];
    let mut npz = Npz::open(file)?;
    let labels = bytes(&mut npz, "voxel_label", &shape, file)?;
    check_labels(&labels, OccupancyLabels::Waymo, &grid.cells, file)?;
    let mut state = |name| Ok::<_, DataError>(truths(&bytes(&mut npz, name, &shape, file)?));
    let lidar = state("origin_voxel_state")?;
    let camera = state("final_voxel_state")?;
    let in_view = state("infov")?;
    let camera: Vec<bool> = camera.iter().zip(in_view).map(|(seen, in_view)| *seen && in_view).collect();
    let labels = from_xyz(&grid, &labels);
    let mut found = OccupancyGrid::new(grid, Rigid::IDENTITY, OccupancyLabels::Waymo, labels)?;
    found.lidar_mask = Some(from_xyz(&grid, &lidar));
    found.camera_mask = Some(from_xyz(&grid, &camera));
    Ok(found)
}
