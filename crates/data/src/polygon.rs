//! Polygons of maps, and one shape from overlapping and touching ones.

use geometry::glam::DVec2;
use i_overlay::core::fill_rule::FillRule;
use i_overlay::float::simplify::SimplifyShape;

use crate::local_map::contains;

/// A polygon; rings do not repeat their first point.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MapPolygon {
    /// Outer ring, metres.
    pub outer: Vec<DVec2>,
    /// Inner rings, metres.
    pub holes: Vec<Vec<DVec2>>,
}

impl MapPolygon {
    /// Whether a point lies in it and in none of its holes.
    pub fn contains(&self, point: DVec2) -> bool {
        contains(&self.outer, point) && !self.holes.iter().any(|hole| contains(hole, point))
    }
}

/// Holes and shapes that enclose less lie between polygons that should touch, square metres.
const SLIVER_M2: f64 = 0.01;

/// The union. Outer rings run counter-clockwise, holes clockwise.
pub(crate) fn union<'a>(polygons: impl Iterator<Item = &'a MapPolygon>) -> Vec<MapPolygon> {
    let mut rings: Vec<Vec<[f64; 2]>> = Vec::new();
    for polygon in polygons {
        rings.push(turned(&polygon.outer, 1.0));
        rings.extend(polygon.holes.iter().map(|hole| turned(hole, -1.0)));
    }
    let mut shapes = Vec::new();
    // Non-zero winding: a polygon over another's hole fills it.
    for shape in rings.simplify_shape_as::<i64>(FillRule::NonZero) {
        let mut rings = shape.into_iter().map(|ring| ring.into_iter().map(DVec2::from_array).collect::<Vec<_>>());
        let outer = rings.next().unwrap_or_default();
        let holes = rings.filter(|hole| doubled_area(hole).abs() > 2.0 * SLIVER_M2).collect();
        if doubled_area(&outer).abs() > 2.0 * SLIVER_M2 {
            shapes.push(MapPolygon { outer, holes });
        }
    }
    shapes
}

/// The ring with its area's sign turned to `sign`.
fn turned(ring: &[DVec2], sign: f64) -> Vec<[f64; 2]> {
    let points = ring.iter().map(DVec2::to_array);
    if doubled_area(ring) * sign < 0.0 { points.rev().collect() } else { points.collect() }
}

/// Positive for counter-clockwise rings, square metres.
pub(crate) fn doubled_area(ring: &[DVec2]) -> f64 {
    ring.iter().zip(ring.iter().cycle().skip(1)).map(|(a, b)| a.perp_dot(*b)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(low: f64, high: f64, shift: f64) -> Vec<DVec2> {
        [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| DVec2::new(x + shift, y)).to_vec()
    }

    fn polygon(outer: Vec<DVec2>) -> MapPolygon {
        MapPolygon { outer, holes: Vec::new() }
    }

    fn area(shapes: &[MapPolygon]) -> f64 {
        let rings = shapes.iter().flat_map(|shape| std::iter::once(&shape.outer).chain(&shape.holes));
        rings.map(|ring| doubled_area(ring)).sum::<f64>() * 0.5
    }

    #[test]
    fn touching_and_overlapping_polygons_become_one_whatever_their_turn() {
        let mut second = square(0.0, 10.0, 10.0);
        second.reverse();
        let shapes = union([polygon(square(0.0, 10.0, 0.0)), polygon(second), polygon(square(2.0, 8.0, 15.0))].iter());
        assert_eq!(shapes.len(), 1);
        assert!((area(&shapes) - (200.0 + 3.0 * 6.0)).abs() < 1e-6, "{}", area(&shapes));
        assert!(doubled_area(&shapes[0].outer) > 0.0);
        // A city's coordinates and a gap of a tenth of a millimetre.
        let far = |shift: f64| polygon(square(2000.0, 2010.0, shift));
        let shapes = union([far(0.0), far(10.0001)].iter());
        assert_eq!(shapes.len(), 2);
        assert!((area(&shapes) - 200.0).abs() < 1e-5);
    }

    #[test]
    fn holes_stay_and_may_be_filled_by_others() {
        let ring = MapPolygon { outer: square(0.0, 10.0, 0.0), holes: vec![square(2.0, 8.0, 0.0)] };
        let shapes = union([ring.clone()].iter());
        assert_eq!((shapes.len(), shapes[0].holes.len()), (1, 1));
        assert!((area(&shapes) - 64.0).abs() < 1e-6);
        assert!(doubled_area(&shapes[0].holes[0]) < 0.0);
        let shapes = union([ring, polygon(square(2.0, 5.0, 0.0))].iter());
        assert!((area(&shapes) - 73.0).abs() < 1e-6, "{}", area(&shapes));
        assert!(union(std::iter::empty()).is_empty());
    }
}
