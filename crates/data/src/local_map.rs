//! Brings map elements into the ego frame and cuts them at the border of the asked square.

use geometry::Rigid;
use geometry::glam::{DVec2, DVec3, Vec3Swizzles};

use crate::{DataError, LocalMap, MapArea, MapKind, MapLine};

/// Collects the [`LocalMap`] of one instant.
#[derive(Debug)]
pub(crate) struct LocalMapBuilder {
    ego_from_world: Rigid,
    half_m: f64,
    map: LocalMap,
}

impl LocalMapBuilder {
    /// # Errors
    /// [`DataError::Config`] for a size that is not positive.
    pub(crate) fn new(world_from_ego: &Rigid, half_m: f64) -> Result<Self, DataError> {
        if !half_m.is_finite() || half_m <= 0.0 {
            return Err(DataError::Config(format!("a map cannot reach {half_m} m from the car")));
        }
        Ok(Self { ego_from_world: world_from_ego.inverse(), half_m, map: LocalMap::default() })
    }

    pub(crate) fn finish(self) -> LocalMap {
        self.map
    }

    /// The parts of a world polyline inside the square. A line that ends where it begins is a ring, whose first and last part are one.
    pub(crate) fn add_line(&mut self, kind: MapKind, world: impl IntoIterator<Item = DVec3>) {
        let points: Vec<DVec3> = world.into_iter().map(|point| self.ego_from_world * point).collect();
        let mut parts = self.cut(&points);
        let closed = points.len() > 2 && points.first() == points.last();
        if let [first, .., last] = parts.as_mut_slice()
            && closed
            && first.first() == points.first()
            && last.last() == points.first()
        {
            last.extend(first.drain(..).skip(1));
            parts.remove(0);
        }
        let line = |points: Vec<DVec3>| MapLine { kind, points: points.iter().map(|p| p.to_array()).collect() };
        self.map.lines.extend(parts.into_iter().map(line));
    }

    /// [`Self::add_line`] for a world ring on the ground whose first point is not repeated.
    pub(crate) fn add_ring(&mut self, kind: MapKind, world: &[DVec2]) {
        let closed = world.iter().chain(world.first());
        self.add_line(kind, closed.map(|point| point.extend(0.0)));
    }

    /// A world polygon on the ground, if it reaches into the square.
    pub(crate) fn add_area(&mut self, kind: MapKind, outer: &[DVec2], holes: &[Vec<DVec2>]) {
        let to_ego = |ring: &[DVec2]| -> Vec<DVec2> {
            ring.iter().map(|point| (self.ego_from_world * point.extend(0.0)).xy()).collect()
        };
        let outer = to_ego(outer);
        let sides = outer.iter().zip(outer.iter().cycle().skip(1));
        let touches = sides.clone().any(|(a, b)| self.inside(a.extend(0.0), b.extend(0.0)).is_some());
        if !touches && !contains(&outer, DVec2::ZERO) {
            return;
        }
        let arrays = |ring: Vec<DVec2>| ring.iter().map(DVec2::to_array).collect::<Vec<_>>();
        let holes = holes.iter().map(|hole| arrays(to_ego(hole))).collect();
        self.map.areas.push(MapArea { kind, outer: arrays(outer), holes });
    }

    fn cut(&self, points: &[DVec3]) -> Vec<Vec<DVec3>> {
        let mut parts: Vec<Vec<DVec3>> = Vec::new();
        let mut open = false;
        for pair in points.windows(2) {
            let &[a, b] = pair else { continue };
            let Some([enter, leave]) = self.inside(a, b) else {
                open = false;
                continue;
            };
            let at = |share: f64| {
                if share == 0.0 {
                    a
                } else if share == 1.0 {
                    b
                } else {
                    a.lerp(b, share)
                }
            };
            match parts.last_mut() {
                Some(part) if open && enter == 0.0 => part.push(at(leave)),
                _ => parts.push(vec![at(enter), at(leave)]),
            }
            open = leave == 1.0;
        }
        // Lines that only touch a corner of the square.
        parts.retain(|part| part.windows(2).any(|pair| pair[0] != pair[1]));
        parts
    }

    /// The shares of the way from `a` to `b` between which it lies in the square.
    fn inside(&self, a: DVec3, b: DVec3) -> Option<[f64; 2]> {
        let (mut enter, mut leave) = (0.0f64, 1.0f64);
        for (from, to) in [(a.x, b.x), (a.y, b.y)] {
            let way = to - from;
            if way == 0.0 {
                if from.abs() > self.half_m {
                    return None;
                }
                continue;
            }
            let (s, t) = ((-self.half_m - from) / way, (self.half_m - from) / way);
            enter = enter.max(s.min(t));
            leave = leave.min(s.max(t));
        }
        (enter <= leave).then_some([enter, leave])
    }
}

/// Even-odd rule.
pub(crate) fn contains(ring: &[DVec2], point: DVec2) -> bool {
    let sides = ring.iter().zip(ring.iter().cycle().skip(1));
    let crossings = sides.filter(|(a, b)| {
        (a.y <= point.y) != (b.y <= point.y) && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
    });
    crossings.count() % 2 == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn builder(yaw: f64) -> LocalMapBuilder {
        LocalMapBuilder::new(&Rigid::from_yaw(yaw, DVec3::new(100.0, 200.0, 0.0)), 10.0).unwrap()
    }

    #[test]
    fn lines_are_cut_at_the_square_in_ego_axes() {
        // The car looks along world +y.
        let mut map = builder(90f64.to_radians());
        map.add_line(
            MapKind::Divider,
            [(100.0, 150.0), (100.0, 205.0), (100.0, 300.0)].map(|(x, y)| DVec3::new(x, y, 0.0)),
        );
        map.add_line(MapKind::Divider, [(0.0, 211.0), (300.0, 211.0)].map(|(x, y)| DVec3::new(x, y, 0.0)));
        let lines = map.finish().lines;
        assert_eq!(lines.len(), 1);
        for (got, want) in lines[0].points.iter().zip([[-10.0, 0.0, 0.0], [5.0, 0.0, 0.0], [10.0, 0.0, 0.0]]) {
            assert!(DVec3::from_array(*got).abs_diff_eq(DVec3::from_array(want), 1e-9), "{got:?} instead of {want:?}");
        }
    }

    #[test]
    fn a_line_that_leaves_and_returns_has_two_parts_and_a_ring_is_joined() {
        let corners = [(100.0, 200.0), (120.0, 200.0), (120.0, 205.0), (100.0, 205.0)].map(|(x, y)| DVec2::new(x, y));
        let mut map = builder(0.0);
        map.add_line(MapKind::Boundary, corners.map(|point| point.extend(0.0)));
        map.add_ring(MapKind::Crossing, &corners);
        let lines = map.finish().lines;
        assert_eq!(lines.iter().map(|line| line.points.len()).collect::<Vec<_>>(), [2, 2, 4]);
        assert_eq!(lines[2].points, [[10.0, 5.0, 0.0], [0.0, 5.0, 0.0], [0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]);
        let mut map = builder(0.0);
        map.add_ring(MapKind::Crossing, &corners.map(|point| point.min(DVec2::new(105.0, 205.0))));
        assert_eq!(map.finish().lines[0].points.len(), 5, "a whole ring stays closed");
    }

    #[test]
    fn areas_count_when_they_reach_into_the_square() {
        let square = |low: f64, high: f64| {
            [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| DVec2::new(100.0 + x, 200.0 + y))
        };
        let mut map = builder(0.0);
        map.add_area(MapKind::Walkway, &square(-500.0, 500.0), &[square(-1.0, 1.0).to_vec()]);
        map.add_area(MapKind::Walkway, &square(9.0, 20.0), &[]);
        map.add_area(MapKind::Walkway, &square(11.0, 20.0), &[]);
        let areas = map.finish().areas;
        assert_eq!(areas.len(), 2);
        assert_eq!(areas[0].holes[0][0], [-1.0, -1.0]);
        assert!(LocalMapBuilder::new(&Rigid::IDENTITY, 0.0).is_err());
        assert!(LocalMapBuilder::new(&Rigid::IDENTITY, f64::NAN).is_err());
    }
}
