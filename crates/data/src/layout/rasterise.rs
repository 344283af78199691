//! Layouts as binary occupancy, the condition of a network on the BEV grid.

use std::ops::Range;

use geometry::glam::DVec3;
use geometry::{BevGrid, OrientedBox};
use serde::{Deserialize, Serialize};

use super::{Layout, LayoutClasses, LayoutError};

/// Which cells of the grid a box marks.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Rasterise {
    /// Those whose centre lies strictly inside, the rule of the paper. A traffic cone then misses most grids.
    Centres,
    /// The same; a box that holds no centre marks the cell that holds its own centre.
    #[default]
    CentresOrNearest,
}

impl Layout {
    /// Binary occupancy `[K, Z, Y, X]` in index order k, z, y, x: 1 where a box of class k marks cell (z, y, x).
    ///
    /// Boxes reach as far as the grid does: one wholly outside marks nothing. The cost is linear in the boxes, each at most the cells of
    /// the part of the grid it reaches.
    ///
    /// # Errors
    /// As [`Layout::check`]; [`LayoutError::UnknownClass`], [`LayoutError::Classes`], [`LayoutError::Grid`].
    pub fn occupancy(&self, grid: &BevGrid, classes: &LayoutClasses, rule: Rasterise) -> Result<Vec<f32>, LayoutError> {
        grid.checked()?;
        self.check()?;
        self.check_classes(classes)?;
        let mut occupancy = vec![0.0; classes.len() * grid.len()];
        for found in &self.boxes {
            let Some(class) = classes.index(&found.class) else { continue };
            let start = class * grid.len();
            if let Some(channel) = occupancy.get_mut(start..start + grid.len()) {
                mark(channel, grid, &found.shape, rule);
            }
        }
        Ok(occupancy)
    }
}

fn mark(channel: &mut [f32], grid: &BevGrid, shape: &OrientedBox, rule: Rasterise) {
    let mut set = |[z, y, x]: [usize; 3]| {
        let [_, rows, columns] = grid.cells;
        if let Some(cell) = channel.get_mut((z * rows + y) * columns + x) {
            *cell = 1.0;
        }
    };
    let mut marked = false;
    let [slices, rows, columns] = reach(grid, shape);
    for z in slices {
        for y in rows.clone() {
            for x in columns.clone() {
                if shape.holds(grid.center(z, y, x)) {
                    set([z, y, x]);
                    marked = true;
                }
            }
        }
    }
    if rule == Rasterise::CentresOrNearest && !marked {
        grid.cell_of(shape.center).into_iter().for_each(set);
    }
}

/// Cells along (z, y, x) that the box can touch, a cell more on each side against rounding.
fn reach(grid: &BevGrid, shape: &OrientedBox) -> [Range<usize>; 3] {
    let corners = shape.corners();
    let low = corners.into_iter().fold(DVec3::INFINITY, DVec3::min);
    let high = corners.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max);
    let (low, high) = (grid.unit_from_ego(low), grid.unit_from_ego(high));
    let [z, y, x] = grid.cells;
    let range = |low: f64, high: f64, cells: usize| {
        // Casts saturate: a box below the grid starts at 0, one beyond it at the last cell.
        let first = ((low * cells as f64).floor() as usize).saturating_sub(1).min(cells);
        let end = ((high * cells as f64).ceil() as usize).saturating_add(1).min(cells);
        first..end
    };
    [range(low.z, high.z, z), range(low.y, high.y, y), range(low.x, high.x, x)]
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};
    use std::time::{Duration, Instant};

    use geometry::Box3d;
    use geometry::glam::DQuat;

    use super::super::{LayoutBox, MOST_BOXES};
    use super::*;

    const GRID: BevGrid =
        BevGrid { x_range: [-51.2, 51.2], y_range: [-51.2, 51.2], z_range: [-5.0, 3.0], cells: [8, 128, 128] };

    fn upright(center: [f64; 3], size: [f64; 3], yaw: f64) -> OrientedBox {
        Box3d { center: DVec3::from_array(center), size: DVec3::from_array(size), yaw }.into()
    }

    fn one(class: &str, shape: OrientedBox) -> Layout {
        Layout { boxes: vec![LayoutBox::new("it", class, shape)] }
    }

    fn filled(layout: &Layout, rule: Rasterise) -> Vec<[usize; 4]> {
        let [nz, ny, nx] = GRID.cells;
        let values = layout.occupancy(&GRID, &LayoutClasses::nuscenes(), rule).unwrap();
        assert_eq!(values.len(), 10 * nz * ny * nx);
        assert!(values.iter().all(|value| *value == 0.0 || *value == 1.0));
        let place = |at: usize| [at / (nz * ny * nx), at / (ny * nx) % nz, at / nx % ny, at % nx];
        values.iter().enumerate().filter(|(_, value)| **value == 1.0).map(|(at, _)| place(at)).collect()
    }

    #[test]
    fn a_box_ahead_on_the_left_lands_in_its_row_and_column() {
        // One cell of the class bus: x ahead 10 m, y left 5 m, just below the car's axle.
        let (z, y, x) = (4, 70, 76);
        let center = GRID.center(z, y, x);
        assert!(center.x > 9.0 && center.y > 5.0);
        let found = filled(&one("bus", upright(center.to_array(), [0.5, 0.5, 0.5], 0.3)), Rasterise::Centres);
        assert_eq!(found, [[3, z, y, x]]);
    }

    #[test]
    fn the_marked_volume_is_that_of_the_box_whatever_its_heading() {
        let cell = GRID.cell_size();
        for yaw in [0.0, FRAC_PI_4, FRAC_PI_2, -2.0] {
            let (l, w, h) = (12.0, 3.1, 3.3);
            let count = filled(&one("truck", upright([7.13, -3.07, 0.2], [l, w, h], yaw)), Rasterise::Centres).len();
            let volume = count as f64 * cell.x * cell.y * cell.z;
            let (least, most) = ((l - 0.8) * (w - 0.8) * (h - 1.0), (l + 0.8) * (w + 0.8) * (h + 1.0));
            assert!(volume > least && volume < most, "{volume} not in {least}..{most} at {yaw}");
        }
    }

    #[test]
    fn thin_objects_are_kept_by_the_nearest_cell_only() {
        let cone = one("traffic_cone", upright([10.0, 0.0, -0.6], [0.4, 0.4, 0.7], 0.0));
        assert_eq!(filled(&cone, Rasterise::Centres), Vec::<[usize; 4]>::new());
        let cell = GRID.cell_of(cone.boxes[0].shape.center).unwrap();
        assert_eq!(filled(&cone, Rasterise::CentresOrNearest), [[9, cell[0], cell[1], cell[2]]]);
        let car = one("car", upright([10.0, 0.0, 0.0], [4.5, 1.9, 1.6], 0.2));
        assert_eq!(filled(&car, Rasterise::Centres), filled(&car, Rasterise::CentresOrNearest));
    }

    #[test]
    fn boxes_outside_mark_nothing_and_boxes_on_the_border_what_is_inside() {
        for center in [[80.0, 0.0, 0.0], [0.0, -60.0, 0.0], [0.0, 0.0, 30.0], [-1e300, 1e300, 0.0]] {
            let far = one("car", upright(center, [4.5, 1.9, 1.6], 0.5));
            assert!(filled(&far, Rasterise::CentresOrNearest).is_empty(), "{center:?}");
        }
        let half_out = filled(&one("car", upright([51.2, 0.0, 0.0], [4.0, 4.0, 2.0], 0.0)), Rasterise::Centres);
        assert!(!half_out.is_empty() && half_out.iter().all(|place| place[3] >= 125));
        let huge = one("car", upright([0.0; 3], [1e9, 1e9, 1e9], 0.1));
        assert_eq!(filled(&huge, Rasterise::Centres).len(), GRID.len());
    }

    #[test]
    fn classes_are_channels_and_boxes_of_one_class_merge() {
        let shape = upright([5.0, 5.0, 0.0], [4.0, 2.0, 2.0], 0.0);
        let mut layout = one("car", shape);
        let alone = filled(&layout, Rasterise::Centres);
        layout.boxes.push(LayoutBox::new("again", "car", shape));
        assert_eq!(filled(&layout, Rasterise::Centres), alone);
        layout.boxes[1].class = "bus".into();
        assert_eq!(filled(&layout, Rasterise::Centres).len(), 2 * alone.len());
        assert!(filled(&Layout::default(), Rasterise::CentresOrNearest).is_empty(), "an empty street is legal");
    }

    #[test]
    fn malformed_layouts_name_the_box() {
        let shape = upright([5.0, 5.0, 0.0], [4.0, 2.0, 2.0], 0.0);
        let why = |layout: Layout| {
            let error = layout.occupancy(&GRID, &LayoutClasses::nuscenes(), Rasterise::Centres).unwrap_err();
            assert!(error.to_string().contains("\"it\""), "{error}");
            error
        };
        let unknown = why(one("hovercraft", shape)).to_string();
        assert!(unknown.contains("hovercraft") && unknown.contains("construction_vehicle"), "{unknown}");
        let nan = OrientedBox { center: DVec3::new(f64::NAN, 0.0, 0.0), ..shape };
        assert!(matches!(why(one("car", nan)), LayoutError::NotFinite { what: "centre", .. }));
        let endless = OrientedBox { size: DVec3::new(4.0, f64::INFINITY, 1.0), ..shape };
        assert!(matches!(why(one("car", endless)), LayoutError::NotFinite { what: "size", .. }));
        for size in [DVec3::ZERO, DVec3::new(4.0, -2.0, 1.0)] {
            assert!(matches!(why(one("car", OrientedBox { size, ..shape })), LayoutError::Size { .. }));
        }
        let stretched = OrientedBox { rotation: DQuat::from_xyzw(0.0, 0.0, 0.0, 2.0), ..shape };
        assert!(matches!(why(one("car", stretched)), LayoutError::Rotation { .. }));
        let twice = Layout { boxes: [one("car", shape).boxes, one("bus", shape).boxes].concat() };
        assert!(matches!(why(twice), LayoutError::DuplicateId { .. }));
    }

    #[test]
    fn unusable_grids_and_tables_are_refused() {
        let layout = one("car", upright([0.0; 3], [1.0; 3], 0.0));
        let flat = BevGrid { x_range: [1.0, 1.0], ..GRID };
        let classes = LayoutClasses::nuscenes();
        assert!(matches!(layout.occupancy(&flat, &classes, Rasterise::Centres), Err(LayoutError::Grid(_))));
        let none = LayoutClasses { names: vec![] };
        assert!(matches!(layout.occupancy(&GRID, &none, Rasterise::Centres), Err(LayoutError::Classes { .. })));
    }

    #[test]
    fn a_million_boxes_are_refused_at_once_and_the_most_allowed_are_quick() {
        let many = |count: usize| Layout {
            boxes: (0..count)
                .map(|i| {
                    let at = [(i % 100) as f64 - 50.0, (i / 100 % 100) as f64 - 50.0, 0.0];
                    LayoutBox::new(format!("{i}"), "car", upright(at, [4.5, 1.9, 1.6], i as f64))
                })
                .collect(),
        };
        let layout = many(1_000_000);
        let start = Instant::now();
        let error = layout.occupancy(&GRID, &LayoutClasses::nuscenes(), Rasterise::Centres).unwrap_err();
        assert_eq!(error, LayoutError::TooMany { count: 1_000_000 });
        assert!(start.elapsed() < Duration::from_millis(100));
        let layout = many(MOST_BOXES);
        let start = Instant::now();
        layout.occupancy(&GRID, &LayoutClasses::nuscenes(), Rasterise::Centres).unwrap();
        assert!(start.elapsed() < Duration::from_secs(2), "{:?}", start.elapsed());
    }
}
