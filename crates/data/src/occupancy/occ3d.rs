//! Occ3D-nuScenes: dense labels with masks, in the ego frame of the sample's lidar pose.
//!
//! <https://tsinghua-mars-lab.github.io/Occ3D/>

use geometry::Rigid;

use super::grid::{OCC3D_GRID, from_xyz};
use crate::npz::{Dtype, Npz, Want};
use crate::store::{Roots, Store, StoredFile, checked_name};
use crate::{DataError, OccupancyGrid, OccupancyLabels};

/// Axes of the dense arrays.
pub(super) const XYZ: [Option<usize>; 3] = [Some(200), Some(200), Some(16)];

/// A folder of Occ3D-nuScenes labels.
#[derive(Debug, Clone)]
pub struct Occ3d {
    store: Store,
    prefix: &'static str,
    masks: bool,
}

impl Occ3d {
    /// `root` holds `gts`, or is it. With `masks` both masks are read and must be there.
    ///
    /// # Errors
    /// [`DataError::Missing`] without the folder.
    pub fn open(root: impl Into<Roots>, masks: bool) -> Result<Self, DataError> {
        let store = Store::open_all(&root.into())?;
        let prefix = if store.list("gts")?.is_empty() { "" } else { "gts/" };
        Ok(Self { store, prefix, masks })
    }

    /// Labels of a sample.
    ///
    /// # Errors
    /// [`DataError::Missing`] for a sample without labels; a broken file as [`read_occ3d`].
    pub fn read(&self, scene: &str, sample: &str) -> Result<OccupancyGrid, DataError> {
        let name = format!("{}{scene}/{sample}/labels.npz", self.prefix);
        let name = checked_name(&name, &self.store.path(""))?;
        read_occ3d(&self.store.file(name, "occupancy labels")?, self.masks)
    }
}

/// Reads one `labels.npz`.
///
/// # Errors
/// [`DataError::Array`] for another shape or element type, [`DataError::Missing`] for an absent array, [`DataError::Format`] for a label
/// outside the set and for every other fault of the file.
pub fn read_occ3d(file: &StoredFile, masks: bool) -> Result<OccupancyGrid, DataError> {
    let mut npz = Npz::open(file)?;
    let labels = bytes(&mut npz, "semantics", &XYZ, file)?;
    let label_set = OccupancyLabels::NuScenes;
    check_labels(&labels, label_set, &OCC3D_GRID.cells, file)?;
    let labels = from_xyz(&OCC3D_GRID, &labels);
    let mut grid = OccupancyGrid::new(OCC3D_GRID, Rigid::IDENTITY, label_set, labels)?;
    if masks {
        let mut mask = |name| Ok::<_, DataError>(truths(&bytes(&mut npz, name, &XYZ, file)?));
        grid.lidar_mask = Some(from_xyz(&OCC3D_GRID, &mask("mask_lidar")?));
        grid.camera_mask = Some(from_xyz(&OCC3D_GRID, &mask("mask_camera")?));
    }
    Ok(grid)
}

/// An array of bytes or truths.
pub(super) fn bytes(
    npz: &mut Npz,
    name: &str,
    shape: &[Option<usize>],
    file: &StoredFile,
) -> Result<Vec<u8>, DataError> {
    let array = npz.array(name, &Want { dtypes: &[Dtype::U8, Dtype::Bool], shape })?;
    array.into_u8().map_err(|array| DataError::Array {
        name: name.to_owned(),
        got: array.dtype().descr().to_owned(),
        want: "one byte per element".to_owned(),
        path: file.path().to_owned(),
    })
}

pub(super) fn truths(bytes: &[u8]) -> Vec<bool> {
    bytes.iter().map(|byte| *byte != 0).collect()
}

/// Labels of an \[x\]\[y\]\[z\] array for a grid of `cells` (z, y, x).
pub(super) fn check_labels(
    labels: &[u8],
    set: OccupancyLabels,
    [nz, ny, _]: &[usize; 3],
    file: &StoredFile,
) -> Result<(), DataError> {
    match labels.iter().position(|label| !set.holds(*label)) {
        None => Ok(()),
        Some(at) => {
            let [x, y, z] = [at / (ny * nz), at / nz % ny, at % nz];
            let label = labels.get(at).copied().unwrap_or_default();
            let why = format!("label {label} at x {x}, y {y}, z {z} is no class");
            Err(DataError::Format { format: "npz", why, path: file.path().to_owned() })
        }
    }
}
