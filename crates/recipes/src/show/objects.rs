//! What both kinds of picture draw: boxes as wires, the order of drawing, occupancy cells on the surface.

use data::{ObjectBox, OccupancyGrid};
use geometry::glam::DVec3;

use super::canvas::Color;
use super::colors;

/// Corners of the front face in order, and of the rear.
pub(super) const FRONT: [usize; 4] = [0, 1, 2, 3];
const REAR: [usize; 4] = [4, 5, 6, 7];

/// The wires of a box, closed rows of points and single edges, metres in ego.
pub(super) struct Wires {
    /// Closed.
    pub(super) front: Vec<DVec3>,
    /// Rear face and the four long edges.
    pub(super) others: Vec<Vec<DVec3>>,
}

impl Wires {
    pub(super) fn of(object: &ObjectBox) -> Self {
        let corners = object.box3d.corners();
        let ring = |face: [usize; 4]| face.into_iter().chain([face[0]]).map(|i| corners[i]).collect::<Vec<_>>();
        let long = FRONT.into_iter().zip(REAR).map(|(a, b)| vec![corners[a], corners[b]]);
        Self { front: ring(FRONT), others: [ring(REAR)].into_iter().chain(long).collect() }
    }
}

/// Far ones first, so that near ones are drawn over them.
pub(super) fn far_first(objects: &[ObjectBox], eye: DVec3) -> Vec<&ObjectBox> {
    let mut order: Vec<&ObjectBox> = objects.iter().collect();
    let distance = |object: &ObjectBox| object.box3d.center.distance_squared(eye);
    order.sort_by(|a, b| distance(b).total_cmp(&distance(a)));
    order
}

/// An occupied cell that touches empty space or the border.
pub(super) struct Cell {
    pub(super) center: DVec3,
    pub(super) color: Color,
}

/// The occupied cells that can be seen from somewhere.
pub(super) fn surface(grid: &OccupancyGrid) -> Vec<Cell> {
    let [nz, ny, nx] = grid.grid.cells;
    let filled = |label: u8| label != grid.free() && label != OccupancyGrid::IGNORED;
    let is_open = |z: usize, y: usize, x: usize| grid.label([z, y, x]).is_none_or(|label| !filled(label));
    let mut cells = Vec::new();
    for z in 0..nz {
        for y in 0..ny {
            for x in 0..nx {
                let Some(label) = grid.label([z, y, x]).filter(|label| filled(*label)) else { continue };
                // Wrapping below zero leaves the grid, which is open space.
                let around = [
                    (z.wrapping_sub(1), y, x),
                    (z + 1, y, x),
                    (z, y.wrapping_sub(1), x),
                    (z, y + 1, x),
                    (z, y, x.wrapping_sub(1)),
                    (z, y, x + 1),
                ];
                if around.into_iter().any(|(z, y, x)| is_open(z, y, x)) {
                    // Neighbours differ a little, so that single cells show.
                    let shade = if (x + y + z).is_multiple_of(2) { 1.0 } else { 0.82 };
                    let color = colors::of_label(grid.label_set, label).map(|value| (f64::from(value) * shade) as u8);
                    cells.push(Cell { center: grid.center_in_ego([z, y, x]), color });
                }
            }
        }
    }
    cells
}
