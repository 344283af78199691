//! Semantic occupancy in the style of Occ3D-nuScenes: a cell is occupied when it overlaps a body or holds the ground plane.

use geometry::{BevGrid, Rigid};
use glam::{DVec3, Vec3};

use crate::rendering::FREE_LABEL;
use crate::scenery::{SIDEWALK, VEGETATION};
use crate::shape::{Shape, Surface};
use crate::snapshot::Snapshot;

impl Snapshot {
    /// Label of every cell of a grid at `world_from_grid`, in the grid's memory order (z, y, x); 17 is free.
    pub fn occupancy(&self, world_from_grid: &Rigid, grid: &BevGrid) -> Vec<u8> {
        let mut labels = vec![FREE_LABEL; grid.len()];
        let fill = Fill { world_from_grid, grid, grid_from_world: world_from_grid.inverse() };
        self.fill_ground(&fill, &mut labels);
        for (shape, surface) in self.scene.bvh.parts().chain(self.movers.parts()) {
            self.fill_body(&fill, shape, surface, &mut labels);
        }
        labels
    }

    fn fill_ground(&self, fill: &Fill, labels: &mut [u8]) {
        let [nz, ny, nx] = fill.grid.cells;
        let half = fill.grid.cell_size().z * 0.5;
        for y in 0..ny {
            for x in 0..nx {
                for z in 0..nz {
                    let center = fill.world_from_grid.transform_point(fill.grid.center(z, y, x));
                    // Half open, so that a plane on a border belongs to the upper cell alone, as in `BevGrid::cell_of`.
                    if center.z > half || center.z <= -half {
                        continue;
                    }
                    labels[(z * ny + y) * nx + x] = self.spot(self.scene.to_local(center)).cover.label();
                }
            }
        }
    }

    fn fill_body(&self, fill: &Fill, shape: &Shape, surface: &Surface, labels: &mut [u8]) {
        let origin = self.scene.origin.extend(0.0);
        let (low, high) = shape.bounds();
        let (mut first, mut last) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in 0..8 {
            let pick = |bit: usize, a: f32, b: f32| if corner >> bit & 1 == 0 { a } else { b };
            let local = Vec3::new(pick(0, low.x, high.x), pick(1, low.y, high.y), pick(2, low.z, high.z));
            let point = fill.grid_from_world.transform_point(local.as_dvec3() + origin);
            (first, last) = (first.min(point), last.max(point));
        }
        let cell = fill.grid.cell_size();
        let [nz, ny, nx] = fill.grid.cells;
        let index = |point: DVec3| ((point - fill.grid.low()) / cell).floor();
        let (a, b) = (index(first), index(last));
        let range = |a: f64, b: f64, n: usize| (a.max(0.0) as usize)..((b + 1.0).clamp(0.0, n as f64) as usize);
        for z in range(a.z, b.z, nz) {
            for y in range(a.y, b.y, ny) {
                for x in range(a.x, b.x, nx) {
                    let at = (z * ny + y) * nx + x;
                    if rank(surface.label) >= rank(labels[at]) && fill.overlaps(shape, origin, z, y, x) {
                        labels[at] = surface.label;
                    }
                }
            }
        }
    }
}

struct Fill<'a> {
    world_from_grid: &'a Rigid,
    grid_from_world: Rigid,
    grid: &'a BevGrid,
}

impl Fill<'_> {
    /// Whether a body reaches into a cell: its point nearest to the centre or to one of the corners lies in the cell.
    fn overlaps(&self, shape: &Shape, origin: DVec3, z: usize, y: usize, x: usize) -> bool {
        let center = self.grid.center(z, y, x);
        let half = self.grid.cell_size() * 0.5;
        let reaches = |point: DVec3| {
            let scene = (self.world_from_grid.transform_point(point) - origin).as_vec3();
            let nearest = shape.local_nearest(shape.local_of(scene - shape.center));
            let back = (shape.scene_of(nearest) + shape.center).as_dvec3() + origin;
            let off = (self.grid_from_world.transform_point(back) - center).abs();
            off.cmple(half + 1e-4).all()
        };
        reaches(center)
            || (0..8).any(|corner| {
                let sign = |bit: usize| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
                reaches(center + half * DVec3::new(sign(0), sign(1), sign(2)))
            })
    }
}

/// Which label wins where several bodies share a cell: actors, then buildings and poles, plants, kerbs, ground.
fn rank(label: u8) -> u8 {
    match label {
        FREE_LABEL => 0,
        SIDEWALK => 2,
        11 | 12 | 14 => 1,
        VEGETATION => 3,
        15 => 4,
        _ => 5,
    }
}
