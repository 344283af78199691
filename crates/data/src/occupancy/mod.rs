//! Occupancy labels: readers of the published sets and a writer. All give [`OccupancyGrid`](crate::OccupancyGrid).
//!
//! | set | frame | cells | file |
//! |---|---|---|---|
//! | Occ3D-nuScenes | ego | 0.4 m, 200×200×16 | `gts/<scene>/<sample>/labels.npz`, dense |
//! | Occ3D-Waymo | vehicle | 0.4 m or 0.1×0.1×0.2 m | `<scene>/<frame>_04.npz` or `<frame>.npz`, dense |
//! | OpenOccupancy | lidar | 0.2 m, 512×512×40 | rows z, y, x, label |
//! | SurroundOcc | lidar | 0.5 m, 200×200×16 | rows x, y, z, label |

mod grid;
mod occ3d;
mod occ3d_waymo;
mod rows;
mod write;

use serde::{Deserialize, Serialize};

pub use grid::OCC3D_GRID;
pub use occ3d::{Occ3d, read_occ3d};
pub use occ3d_waymo::{Occ3dWaymo, WaymoVoxels, read_occ3d_waymo};
pub use rows::{OPEN_OCCUPANCY_GRID, SURROUND_OCC_GRID, read_open_occupancy, read_surround_occ};
pub use write::{occ3d_bytes, write_occ3d};

use crate::store::Roots;

/// Labels that are attached to a nuScenes-layout dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OccupancyConfig {
    /// Which set.
    pub kind: OccupancyKind,
    /// Its folder or archive, or a list of both: the one with `gts` (Occ3D), with the `scene_...` folders (OpenOccupancy), with `samples` (SurroundOcc).
    pub root: Roots,
    /// Read the lidar and camera masks too, which must be there then. Only Occ3D has them.
    #[serde(default = "yes")]
    pub masks: bool,
    /// What frames between key frames get: labels exist at key frames only.
    #[serde(default)]
    pub between: BetweenKeyFrames,
}

impl OccupancyConfig {
    /// A set with its masks, at key frames.
    pub fn new(kind: OccupancyKind, root: impl Into<Roots>) -> Self {
        Self { kind, root: root.into(), masks: true, between: BetweenKeyFrames::default() }
    }
}

const fn yes() -> bool {
    true
}

/// The published label sets for nuScenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OccupancyKind {
    /// Occ3D-nuScenes.
    Occ3d,
    /// OpenOccupancy.
    OpenOccupancy,
    /// SurroundOcc.
    SurroundOcc,
}

/// Labels of frames between key frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BetweenKeyFrames {
    /// None: asking for them is an error.
    #[default]
    Missing,
    /// Those of the key frame nearest in time, as if the car stood where it stood then.
    Nearest,
    /// Those of the key frame nearest in time, placed by the car's motion since. What moves by itself stays where it was.
    Moved,
}
