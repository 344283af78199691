//! Questions to an occupancy grid, and how the files' memory order becomes the grid's.

use geometry::glam::DVec3;
use geometry::{BevGrid, Rigid};

use crate::{DataError, OccupancyGrid, OccupancyLabels};

/// The grid of Occ3D, of its coarse Waymo labels too: 0.4 m cells, ±40 m, 1 m below to 5.4 m above the ego's origin.
pub const OCC3D_GRID: BevGrid =
    BevGrid { x_range: [-40.0, 40.0], y_range: [-40.0, 40.0], z_range: [-1.0, 5.4], cells: [16, 200, 200] };

impl OccupancyLabels {
    /// The label of empty space.
    pub const fn free(self) -> u8 {
        match self {
            Self::NuScenes => 17,
            Self::Waymo => 23,
        }
    }

    /// Names of the classes 0, 1, ...; empty space has none.
    pub const fn class_names(self) -> &'static [&'static str] {
        match self {
            Self::NuScenes => &[
                "others",
                "barrier",
                "bicycle",
                "bus",
                "car",
                "construction_vehicle",
                "motorcycle",
                "pedestrian",
                "traffic_cone",
                "trailer",
                "truck",
                "driveable_surface",
                "other_flat",
                "sidewalk",
                "terrain",
                "manmade",
                "vegetation",
            ],
            Self::Waymo => &[
                "general_object",
                "vehicle",
                "pedestrian",
                "sign",
                "cyclist",
                "traffic_light",
                "pole",
                "construction_cone",
                "bicycle",
                "motorcycle",
                "building",
                "vegetation",
                "tree_trunk",
                "road",
                "walkable",
            ],
        }
    }

    /// Whether a file may hold this label.
    pub fn holds(self, label: u8) -> bool {
        label == self.free() || usize::from(label) < self.class_names().len()
    }

    /// Labels of road users: what rays and losses treat as foreground unless told otherwise.
    pub const fn foreground(self) -> &'static [u8] {
        match self {
            Self::NuScenes => &[2, 3, 4, 5, 6, 7, 9, 10],
            Self::Waymo => &[1, 2, 4, 8, 9],
        }
    }
}

impl OccupancyGrid {
    /// Label of a cell of which nothing is known.
    pub const IGNORED: u8 = 255;

    /// A grid without masks from labels in memory order.
    ///
    /// # Errors
    /// [`DataError::Config`] for a number of labels that is not the grid's, or one that is neither in the set nor 255.
    pub fn new(
        grid: BevGrid,
        ego_from_grid: Rigid,
        label_set: OccupancyLabels,
        labels: Vec<u8>,
    ) -> Result<Self, DataError> {
        if labels.len() != grid.len() {
            return Err(DataError::Config(format!("{} labels for a grid of {} cells", labels.len(), grid.len())));
        }
        if let Some(label) = labels.iter().find(|label| !label_set.holds(**label) && **label != Self::IGNORED) {
            return Err(DataError::Config(format!("{label} is no label of {label_set:?}")));
        }
        Ok(Self { grid, ego_from_grid, label_set, labels, lidar_mask: None, camera_mask: None })
    }

    /// The label of empty space.
    pub fn free(&self) -> u8 {
        self.label_set.free()
    }

    /// Position of cell (z, y, x) in memory.
    pub fn index(&self, [z, y, x]: [usize; 3]) -> usize {
        let [_, ny, nx] = self.grid.cells;
        (z * ny + y) * nx + x
    }

    /// Label of cell (z, y, x); `None` outside.
    pub fn label(&self, cell: [usize; 3]) -> Option<u8> {
        let inside = cell.iter().zip(self.grid.cells).all(|(at, count)| *at < count);
        if inside { self.labels.get(self.index(cell)).copied() } else { None }
    }

    /// Cell (z, y, x) around a point of the ego frame, metres; `None` outside.
    pub fn cell_at(&self, ego: DVec3) -> Option<[usize; 3]> {
        self.grid.cell_of(self.ego_from_grid.inverse() * ego)
    }

    /// Label at a point of the ego frame, metres; `None` outside.
    pub fn label_at(&self, ego: DVec3) -> Option<u8> {
        self.cell_at(ego).and_then(|cell| self.label(cell))
    }

    /// Cell (z, y, x) whose centre is nearest to a point of the ego frame, for points outside one at the border; `None` for points that
    /// are no numbers.
    pub fn nearest_cell(&self, ego: DVec3) -> Option<[usize; 3]> {
        let point = self.ego_from_grid.inverse() * ego;
        let low = self.grid.low() + 0.5 * self.grid.cell_size();
        let high = self.grid.low() + self.grid.extent() - 0.5 * self.grid.cell_size();
        if !point.is_finite() {
            return None;
        }
        self.grid.cell_of(point.clamp(low, high))
    }

    /// Centre of cell (z, y, x) in the ego frame, metres.
    pub fn center_in_ego(&self, [z, y, x]: [usize; 3]) -> DVec3 {
        self.ego_from_grid * self.grid.center(z, y, x)
    }

    /// Labels at `samples` points of a ray, `step_m` apart and beginning at its origin; 255 outside the grid. Origin and direction in the
    /// ego frame, the direction of length 1.
    pub fn along_ray(&self, origin: DVec3, direction: DVec3, step_m: f64, samples: usize) -> Vec<u8> {
        let grid_from_ego = self.ego_from_grid.inverse();
        let (start, step) = (grid_from_ego * origin, grid_from_ego.transform_vector(direction) * step_m);
        let label = |at: usize| self.grid.cell_of(start + step * at as f64).and_then(|cell| self.label(cell));
        (0..samples).map(|at| label(at).unwrap_or(Self::IGNORED)).collect()
    }

    /// True where a label is of a class of this list, in memory order.
    pub fn is_one_of(&self, classes: &[u8]) -> Vec<bool> {
        self.labels.iter().map(|label| classes.contains(label)).collect()
    }

    /// True where a cell counts for losses and scores on camera models: known, and seen by a camera where the dataset says so.
    pub fn counted(&self) -> Vec<bool> {
        let known = self.labels.iter().map(|label| *label != Self::IGNORED);
        match &self.camera_mask {
            Some(mask) => known.zip(mask).map(|(known, seen)| known && *seen).collect(),
            None => known.collect(),
        }
    }
}

/// Values of a file's \[x\]\[y\]\[z\] array in the memory order of the grid.
pub(super) fn from_xyz<T: Copy>(grid: &BevGrid, values: &[T]) -> Vec<T> {
    let [nz, ny, nx] = grid.cells;
    let mut out = Vec::with_capacity(values.len());
    for z in 0..nz {
        for y in 0..ny {
            out.extend((0..nx).filter_map(|x| values.get((x * ny + y) * nz + z)));
        }
    }
    out
}

/// Values in the memory order of the grid as a file's \[x\]\[y\]\[z\] array.
pub(super) fn to_xyz<T: Copy>(grid: &BevGrid, values: &[T]) -> Vec<T> {
    let [nz, ny, nx] = grid.cells;
    let mut out = Vec::with_capacity(values.len());
    for x in 0..nx {
        for y in 0..ny {
            out.extend((0..nz).filter_map(|z| values.get((z * ny + y) * nx + x)));
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use geometry::glam::DQuat;

    use super::*;

    fn small(ego_from_grid: Rigid) -> OccupancyGrid {
        let grid = BevGrid { x_range: [0.0, 3.0], y_range: [-1.0, 1.0], z_range: [0.0, 2.0], cells: [2, 2, 3] };
        OccupancyGrid::new(grid, ego_from_grid, OccupancyLabels::NuScenes, (0..12).collect()).unwrap()
    }

    #[test]
    fn memory_orders_are_inverse_and_right() {
        let grid = small(Rigid::IDENTITY);
        let xyz = to_xyz(&grid.grid, &grid.labels);
        // x = 0: (y 0: z 0, z 1), (y 1: z 0, z 1), then x = 1.
        assert_eq!(xyz, [0, 6, 3, 9, 1, 7, 4, 10, 2, 8, 5, 11]);
        assert_eq!(from_xyz(&grid.grid, &xyz), grid.labels);
    }

    #[test]
    fn points_find_their_cells_in_a_turned_grid() {
        // The grid's x axis points to the ego's left.
        let turned =
            Rigid { rotation: DQuat::from_rotation_z(90f64.to_radians()), translation: DVec3::new(5.0, 0.0, 1.0) };
        let grid = small(turned);
        for z in 0..2 {
            for y in 0..2 {
                for x in 0..3 {
                    let center = grid.center_in_ego([z, y, x]);
                    assert_eq!(grid.cell_at(center), Some([z, y, x]));
                    assert_eq!(grid.label_at(center), Some(((z * 2 + y) * 3 + x) as u8));
                }
            }
        }
        assert_eq!(grid.cell_at(DVec3::new(5.5, 2.5, 1.5)), Some([0, 0, 2]));
        assert_eq!(grid.label_at(DVec3::new(5.5, 3.5, 1.5)), None);
        assert_eq!(grid.nearest_cell(DVec3::new(5.5, 30.5, -70.0)), Some([0, 0, 2]));
        assert_eq!(grid.nearest_cell(DVec3::new(5.5, f64::NAN, 0.0)), None);
        assert_eq!(grid.label([0, 0, 3]), None);
    }

    #[test]
    fn a_ray_reads_the_cells_it_passes() {
        let grid = small(Rigid::IDENTITY);
        let along = grid.along_ray(DVec3::new(-0.5, 0.5, 0.5), DVec3::X, 0.5, 9);
        assert_eq!(along, [255, 3, 3, 4, 4, 5, 5, 255, 255]);
    }

    #[test]
    fn labels_outside_the_set_are_refused() {
        let grid = BevGrid { x_range: [0.0, 1.0], y_range: [0.0, 1.0], z_range: [0.0, 1.0], cells: [1, 1, 2] };
        let make = |set, labels: &[u8]| OccupancyGrid::new(grid, Rigid::IDENTITY, set, labels.to_vec());
        assert!(make(OccupancyLabels::NuScenes, &[17, 255]).is_ok());
        assert!(make(OccupancyLabels::NuScenes, &[18, 0]).is_err());
        assert!(make(OccupancyLabels::Waymo, &[23, 14]).is_ok());
        assert!(make(OccupancyLabels::Waymo, &[15, 0]).is_err());
        assert!(make(OccupancyLabels::Waymo, &[0]).is_err());
        let mut grid = make(OccupancyLabels::NuScenes, &[4, 255]).unwrap();
        assert_eq!(grid.counted(), [true, false]);
        grid.camera_mask = Some(vec![false, true]);
        assert_eq!(grid.counted(), [false, false]);
        assert_eq!(grid.is_one_of(OccupancyLabels::NuScenes.foreground()), [true, false]);
    }
}
