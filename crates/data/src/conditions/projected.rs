//! Boxes in pictures: corners in front of the camera and where edges pass its near plane, and the hull of them.

use geometry::Box3d;
use geometry::glam::{DVec2, DVec3, DVec4};

/// Nearest depth at which anything is drawn, metres.
const NEAR_M: f64 = 0.1;

/// Pairs of corners in the order of [`Box3d::corners`].
const EDGES: [[usize; 2]; 12] = [
    [0, 1],
    [1, 2],
    [2, 3],
    [3, 0], // front
    [4, 5],
    [5, 6],
    [6, 7],
    [7, 4], // back
    [0, 4],
    [1, 5],
    [2, 6],
    [3, 7],
];

/// The points whose hull is the picture of a box: its corners, cut along its edges at 0.1 m before the camera. None for a box behind it.
///
/// `img_from_ego` holds the rows of `p ↦ (u·z, v·z, z)`, as [`crate::SampleView::img_from_ego`] gives them; points are pixels and may
/// lie outside the picture.
#[must_use]
pub fn project_box(box3d: &Box3d, img_from_ego: &[[f64; 4]; 3]) -> Vec<DVec2> {
    let rows = img_from_ego.map(DVec4::from_array);
    let corners = box3d.corners().map(|corner| {
        let point = corner.extend(1.0);
        DVec3::new(rows[0].dot(point), rows[1].dot(point), rows[2].dot(point))
    });
    let pixel = |point: DVec3| point.truncate() / point.z;
    let seen = corners.iter().filter(|corner| corner.z >= NEAR_M).map(|corner| pixel(*corner));
    let cut = EDGES.iter().filter_map(|[a, b]| {
        let (a, b) = (corners[*a], corners[*b]);
        let part = (NEAR_M - a.z) / (b.z - a.z);
        ((a.z >= NEAR_M) != (b.z >= NEAR_M)).then(|| pixel(a.lerp(b, part)))
    });
    seen.chain(cut).collect()
}

/// The convex hull of points, counter-clockwise with y up.
#[derive(Debug, Clone, PartialEq)]
pub struct ConvexHull {
    points: Vec<DVec2>,
}

impl ConvexHull {
    /// Andrew, "Another efficient algorithm for convex hulls in two dimensions".
    #[must_use]
    pub fn new(points: &[DVec2]) -> Self {
        let mut sorted = points.to_vec();
        sorted.sort_by(|a, b| a.x.total_cmp(&b.x).then(a.y.total_cmp(&b.y)));
        sorted.dedup();
        let chain = |points: &mut dyn Iterator<Item = DVec2>| {
            let mut chain: Vec<DVec2> = Vec::new();
            for point in points {
                while let [.., a, b] = chain[..] {
                    if (b - a).perp_dot(point - b) > 0.0 {
                        break;
                    }
                    chain.pop();
                }
                chain.push(point);
            }
            // The other chain begins with it.
            chain.pop();
            chain
        };
        let mut hull = chain(&mut sorted.iter().copied());
        hull.extend(chain(&mut sorted.iter().rev().copied()));
        Self { points: if hull.is_empty() { sorted } else { hull } }
    }

    /// Leftmost and rightmost x on the line of this y, borders included.
    #[must_use]
    pub fn span(&self, y: f64) -> Option<[f64; 2]> {
        let mut span: Option<[f64; 2]> = None;
        for (a, b) in self.points.iter().zip(self.points.iter().cycle().skip(1)) {
            if y < a.y.min(b.y) || y > a.y.max(b.y) {
                continue;
            }
            let ends = if a.y == b.y { [a.x, b.x] } else { [a.x + (y - a.y) / (b.y - a.y) * (b.x - a.x); 2] };
            for x in ends {
                span = Some(span.map_or([x, x], |[low, high]| [low.min(x), high.max(x)]));
            }
        }
        span
    }

    /// Lowest and highest y; `None` without points.
    #[must_use]
    pub fn rows(&self) -> Option<[f64; 2]> {
        let ys = || self.points.iter().map(|point| point.y);
        Some([ys().reduce(f64::min)?, ys().reduce(f64::max)?])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn point(x: f64, y: f64) -> DVec2 {
        DVec2::new(x, y)
    }

    #[test]
    fn inner_points_and_points_on_borders_leave_the_hull() {
        let square = [(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.0)];
        let hull = ConvexHull::new(&square.map(|(x, y)| point(x, y)));
        assert_eq!(hull.points, [point(0.0, 0.0), point(2.0, 0.0), point(2.0, 2.0), point(0.0, 2.0)]);
        assert_eq!((hull.span(1.0), hull.span(2.0), hull.span(2.1)), (Some([0.0, 2.0]), Some([0.0, 2.0]), None));
        assert_eq!(hull.rows(), Some([0.0, 2.0]));
        let line = ConvexHull::new(&[point(1.0, 1.0), point(3.0, 3.0), point(2.0, 2.0)]);
        assert_eq!(line.span(2.0), Some([2.0, 2.0]));
        assert_eq!(ConvexHull::new(&[point(1.0, 4.0)]).span(4.0), Some([1.0, 1.0]));
        assert_eq!(ConvexHull::new(&[]).rows(), None);
    }

    #[test]
    fn a_box_through_the_image_plane_is_cut_and_one_behind_is_gone() {
        // Looking along +x: u = -y/x, v = -z/x.
        let rows = [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0]];
        let cube = |x: f64| Box3d { center: DVec3::new(x, 0.0, 0.0), size: DVec3::splat(2.0), yaw: 0.0 };
        assert_eq!(project_box(&cube(5.0), &rows).len(), 8);
        let through = project_box(&cube(0.0), &rows);
        assert_eq!(through.len(), 8, "four corners and four cuts");
        assert!(through.iter().all(|p| p.x.abs() == 1.0 || (p.x.abs() - 10.0).abs() < 1e-12), "{through:?}");
        assert!(project_box(&cube(-5.0), &rows).is_empty());
    }
}
