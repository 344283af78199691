//! Occupancy along the rays of latent cells (ORS).
//!
//! DualDiff+, equations 1 and 2, read as one ray per latent cell from the camera's centre: as printed, the shapes do not fit each other.

use geometry::glam::{DVec2, DVec3};
use geometry::{Camera, ImageEdit, Rigid};
use serde::{Deserialize, Serialize};

use crate::{OccupancyGrid, SampleView};

/// How far a ray looks, and how often.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RaySampling {
    /// Samples of a ray, the first at the camera's centre.
    pub samples: usize,
    /// Distance between two of them.
    pub step_m: f64,
}

impl Default for RaySampling {
    /// 320 samples, 0.2 m apart, as the paper has them.
    fn default() -> Self {
        Self { samples: 320, step_m: 0.2 }
    }
}

/// A ray per cell of a latent picture.
#[derive(Debug, Clone, PartialEq)]
pub struct LatentRays {
    /// Rows and columns of the latent picture.
    pub size: [usize; 2],
    /// The camera's centre, ego metres.
    pub origin: DVec3,
    /// Unit directions in the ego frame, row by row; `None` where the lens maps no ray to the cell's centre.
    pub directions: Vec<Option<DVec3>>,
}

impl LatentRays {
    /// Rays through the cell centres of a picture that `edit` makes of a raw one, through any lens.
    #[must_use]
    pub fn new(camera: &Camera, edit: &ImageEdit, ego_from_cam: &Rigid, size: [usize; 2]) -> Self {
        Self::of(size, edit, ego_from_cam, |raw| camera.unproject(raw))
    }

    /// Rays of a view at network size, which is a pinhole picture.
    #[must_use]
    pub fn of_view(view: &SampleView, size: [usize; 2]) -> Self {
        let cam_from_raw = view.k.inverse();
        Self::of(size, &view.edit, &view.ego_from_cam, |raw| Some((cam_from_raw * raw.extend(1.0)).normalize()))
    }

    fn of(
        [rows, columns]: [usize; 2],
        edit: &ImageEdit,
        ego_from_cam: &Rigid,
        unproject: impl Fn(DVec2) -> Option<DVec3>,
    ) -> Self {
        let cell = DVec2::new(f64::from(edit.width) / columns as f64, f64::from(edit.height) / rows as f64);
        let ray = |at: usize| {
            let center = DVec2::new((at % columns) as f64 + 0.5, (at / columns) as f64 + 0.5) * cell;
            unproject(edit.invert(center)).map(|direction| ego_from_cam.transform_vector(direction))
        };
        let directions = (0..rows * columns).map(ray).collect();
        Self { size: [rows, columns], origin: ego_from_cam.translation, directions }
    }

    /// Labels of the cells that hold each ray's samples. Outside the grid, and where the grid knows nothing, space is free.
    #[must_use]
    pub fn sample(&self, grid: &OccupancyGrid, sampling: &RaySampling) -> RayLabels {
        let free = grid.label_set.free();
        let mut labels = vec![free; self.directions.len() * sampling.samples];
        let grid_from_ego = grid.ego_from_grid.inverse();
        let cell = grid.grid.cell_size();
        let start = (grid_from_ego * self.origin - grid.grid.low()) / cell;
        for (ray, direction) in labels.chunks_exact_mut(sampling.samples.max(1)).zip(&self.directions) {
            let Some(direction) = direction else { continue };
            let step = grid_from_ego.transform_vector(*direction) * sampling.step_m / cell;
            walk(grid, (start, step), ray);
        }
        for label in labels.iter_mut().filter(|label| **label == OccupancyGrid::IGNORED) {
            *label = free;
        }
        RayLabels { size: self.size, samples: sampling.samples, free, labels }
    }
}

/// Labels at `start + i·step`, in cells, wherever that lies in the grid.
fn walk(grid: &OccupancyGrid, (start, step): (DVec3, DVec3), ray: &mut [u8]) {
    let [nz, ny, nx] = grid.grid.cells;
    let size = DVec3::new(nx as f64, ny as f64, nz as f64);
    let (mut first, mut last) = (0.0_f64, ray.len() as f64 - 1.0);
    for axis in 0..3 {
        let (from, by, cells) = (start[axis], step[axis], size[axis]);
        if by == 0.0 {
            if !(0.0..cells).contains(&from) {
                return;
            }
            continue;
        }
        let (a, b) = (-from / by, (cells - from) / by);
        first = first.max(a.min(b));
        last = last.min(a.max(b));
    }
    // Rounding moves a border by less than a sample; the test inside decides.
    let (first, last) = ((first - 1.0).floor().max(0.0), (last + 1.0).ceil().min(ray.len() as f64 - 1.0));
    if first > last {
        return;
    }
    for (i, label) in ray.iter_mut().enumerate().take(last as usize + 1).skip(first as usize) {
        let at = (start + step * i as f64).floor();
        if at.cmpge(DVec3::ZERO).all() && at.cmplt(size).all() {
            *label = grid.labels[(at.z as usize * ny + at.y as usize) * nx + at.x as usize];
        }
    }
}

/// Labels along the rays of one latent picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RayLabels {
    /// Rows and columns.
    pub size: [usize; 2],
    /// Samples of a ray.
    pub samples: usize,
    /// The label of empty space.
    pub free: u8,
    /// `[rows, columns, samples]`
    pub labels: Vec<u8>,
}

impl RayLabels {
    /// The same rays where all labels but these are empty space: they hide nothing then.
    #[must_use]
    pub fn only(&self, kept: &[u8]) -> Self {
        let mut table = [self.free; 256];
        for label in kept {
            table[usize::from(*label)] = *label;
        }
        Self { labels: self.labels.iter().map(|label| table[usize::from(*label)]).collect(), ..self.clone() }
    }

    /// What `kept` leaves out: foreground and background of one picture.
    #[must_use]
    pub fn without(&self, removed: &[u8]) -> Self {
        let kept: Vec<u8> = (0..=u8::MAX).filter(|label| !removed.contains(label)).collect();
        self.only(&kept)
    }

    /// The first sample of each ray that is not in empty space.
    #[must_use]
    pub fn first_hits(&self) -> Vec<Option<usize>> {
        let rays = self.labels.chunks_exact(self.samples.max(1));
        rays.map(|ray| ray.iter().position(|label| *label != self.free)).collect()
    }
}
