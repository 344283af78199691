//! From a map archive to lines and areas with a shared meaning, and the part of them around a car.

use std::collections::HashSet;

use geometry::Rigid;
use geometry::glam::{DVec2, DVec3};

use super::map::{Argoverse2Map, LaneSegment, MapPoint};
use super::outline;
use crate::{LocalMap, MapArea, MapKind, MapLine};

/// Distance between points of a centre line, metres.
const CENTERLINE_STEP_M: f64 = 1.0;

/// The lines and areas of a log in the city frame.
#[derive(Debug)]
pub(super) struct CityMap {
    lines: Vec<(MapKind, Vec<DVec3>)>,
    areas: Vec<(MapKind, Vec<DVec3>)>,
}

impl CityMap {
    pub fn new(map: &Argoverse2Map) -> Self {
        let areas: Vec<Vec<DVec3>> = map.drivable_areas.values().map(|area| ring(&area.area_boundary)).collect();
        let mut lines: Vec<(MapKind, Vec<DVec3>)> = Vec::new();
        lines.extend(dividers(map).map(|points| (MapKind::Divider, points)));
        lines.extend(outline::of_union(&areas).into_iter().map(|points| (MapKind::Boundary, points)));
        lines.extend(map.lane_segments.values().map(|lane| (MapKind::Centerline, centerline(lane))));
        let crossings = map.pedestrian_crossings.values().map(|crossing| {
            let back = crossing.edge2.iter().rev();
            (MapKind::Crossing, crossing.edge1.iter().chain(back).map(|point| point.to_vec()).collect())
        });
        let areas = areas.into_iter().map(|area| (MapKind::Boundary, area)).chain(crossings).collect();
        Self { lines, areas }
    }

    /// What lies within ±`half_m` along both axes of the ego frame, in that frame.
    pub fn around(&self, world_from_ego: &Rigid, half_m: f64) -> LocalMap {
        let ego_from_world = world_from_ego.inverse();
        let here = |points: &[DVec3]| points.iter().map(|point| ego_from_world * *point).collect::<Vec<_>>();
        let mut local = LocalMap::default();
        for (kind, points) in &self.lines {
            for points in cropped(&here(points), half_m) {
                local.lines.push(MapLine { kind: *kind, points });
            }
        }
        for (kind, points) in &self.areas {
            let outer: Vec<DVec2> = here(points).iter().map(|point| point.truncate()).collect();
            if reaches(&outer, half_m) {
                let outer = outer.iter().map(|point| point.to_array()).collect();
                local.areas.push(MapArea { kind: *kind, outer, holes: Vec::new() });
            }
        }
        local
    }
}

/// An outline without the repeated first point.
fn ring(points: &[MapPoint]) -> Vec<DVec3> {
    let mut ring: Vec<DVec3> = points.iter().map(|point| point.to_vec()).collect();
    if ring.len() > 1 && ring.first() == ring.last() {
        ring.pop();
    }
    ring
}

/// Painted boundaries, each once: neighbours share theirs, in either direction.
fn dividers(map: &Argoverse2Map) -> impl Iterator<Item = Vec<DVec3>> {
    let mut seen: HashSet<Vec<[u64; 2]>> = HashSet::new();
    let borders = map.lane_segments.values().flat_map(|lane| {
        let left = (&lane.left_lane_boundary, &lane.left_lane_mark_type);
        [left, (&lane.right_lane_boundary, &lane.right_lane_mark_type)]
    });
    let painted = borders.filter(|(_, mark)| !matches!(mark.as_str(), "NONE" | "UNKNOWN"));
    painted.filter_map(move |(points, _)| {
        let forward: Vec<[u64; 2]> = points.iter().map(|point| [point.x.to_bits(), point.y.to_bits()]).collect();
        let back = forward.iter().rev().copied().collect();
        seen.insert(forward.min(back)).then(|| points.iter().map(|point| point.to_vec()).collect())
    })
}

/// Middle between the boundaries, both resampled to the same number of evenly spaced points.
fn centerline(lane: &LaneSegment) -> Vec<DVec3> {
    let [left, right] = [&lane.left_lane_boundary, &lane.right_lane_boundary]
        .map(|line| line.iter().map(|p| p.to_vec()).collect::<Vec<_>>());
    let pieces = (length(&left).max(length(&right)) / CENTERLINE_STEP_M).ceil().clamp(1.0, 10_000.0) as usize;
    let middle = |step: usize| {
        let share = step as f64 / pieces as f64;
        Some((along(&left, share)? + along(&right, share)?) * 0.5)
    };
    (0..=pieces).filter_map(middle).collect()
}

fn length(line: &[DVec3]) -> f64 {
    line.windows(2).map(|pair| if let [a, b] = pair { a.distance(*b) } else { 0.0 }).sum()
}

/// The point at a share of a line's length; `None` for a line without points.
fn along(line: &[DVec3], share: f64) -> Option<DVec3> {
    let mut left = length(line) * share;
    for pair in line.windows(2) {
        let [a, b] = pair else { continue };
        let piece = a.distance(*b);
        if left <= piece && piece > 0.0 {
            return Some(a.lerp(*b, left / piece));
        }
        left -= piece;
    }
    line.last().copied()
}

/// The parts of a line inside the square.
fn cropped(line: &[DVec3], half_m: f64) -> Vec<Vec<[f64; 3]>> {
    let mut parts: Vec<Vec<[f64; 3]>> = Vec::new();
    let mut open: Vec<DVec3> = Vec::new();
    let mut close = |open: &mut Vec<DVec3>| {
        if open.len() > 1 {
            parts.push(open.iter().map(|point| point.to_array()).collect());
        }
        open.clear();
    };
    for pair in line.windows(2) {
        let [a, b] = pair else { continue };
        let Some((enter, leave)) = inside_span(*a, *b, half_m) else {
            close(&mut open);
            continue;
        };
        let at = |share: f64| match share {
            0.0 => *a,
            1.0 => *b,
            _ => a.lerp(*b, share),
        };
        if enter > 0.0 || open.is_empty() {
            close(&mut open);
            open.push(at(enter));
        }
        open.push(at(leave));
        if leave < 1.0 {
            close(&mut open);
        }
    }
    close(&mut open);
    parts
}

/// The shares of the way from a to b between which it lies inside the square (Liang and Barsky); `None` where it only touches it.
fn inside_span(a: DVec3, b: DVec3, half_m: f64) -> Option<(f64, f64)> {
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for (from, to) in [(a.x, b.x), (a.y, b.y)] {
        let step = to - from;
        if step == 0.0 {
            if from.abs() > half_m {
                return None;
            }
            continue;
        }
        let (low, high) = ((-half_m - from) / step, (half_m - from) / step);
        enter = enter.max(low.min(high));
        leave = leave.min(low.max(high));
    }
    (enter < leave).then_some((enter, leave))
}

/// Whether an outline and the square share a point.
fn reaches(outer: &[DVec2], half_m: f64) -> bool {
    let closed = outer.iter().zip(outer.iter().cycle().skip(1));
    let mut edges = closed.map(|(a, b)| inside_span(a.extend(0.0), b.extend(0.0), half_m));
    // No edge enters the square: either all of it lies inside the area or all of it outside.
    edges.any(|span| span.is_some()) || outline::contains(outer, DVec2::ZERO)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_cut_at_the_border_and_fall_into_parts() {
        let line = [[-20.0, 0.0], [0.0, 0.0], [0.0, 20.0], [4.0, 20.0], [4.0, -20.0]].map(|[x, y]| DVec3::new(x, y, x));
        let parts = cropped(&line, 10.0);
        assert_eq!(
            parts,
            [vec![[-10.0, 0.0, -10.0], [0.0, 0.0, 0.0], [0.0, 10.0, 0.0]], vec![[4.0, 10.0, 4.0], [4.0, -10.0, 4.0]]]
        );
        assert!(cropped(&[DVec3::new(11.0, -5.0, 0.0), DVec3::new(11.0, 5.0, 0.0)], 10.0).is_empty());
        assert!(cropped(&[DVec3::ZERO], 10.0).is_empty());
    }

    #[test]
    fn areas_around_across_and_beside_the_square() {
        let square = |x: f64, half: f64| {
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]].map(|[a, b]| DVec2::new(x + a * half, b * half))
        };
        assert!(reaches(&square(0.0, 100.0), 10.0));
        assert!(reaches(&square(0.0, 1.0), 10.0));
        assert!(reaches(&square(15.0, 6.0), 10.0));
        assert!(!reaches(&square(15.0, 4.0), 10.0));
    }

    #[test]
    fn shared_boundaries_count_once_and_unpainted_ones_never() {
        let line = |y: f64, turned: bool| {
            let mut line: Vec<MapPoint> = [0.0, 10.0].iter().map(|x| MapPoint { x: *x, y, z: 1.0 }).collect();
            if turned {
                line.reverse();
            }
            line
        };
        let lane = |id: i64, left: (f64, &str), right: (f64, &str), turned: bool| LaneSegment {
            id,
            is_intersection: false,
            lane_type: "VEHICLE".into(),
            left_lane_boundary: line(left.0, turned),
            left_lane_mark_type: left.1.into(),
            right_lane_boundary: line(right.0, turned),
            right_lane_mark_type: right.1.into(),
            successors: vec![],
            predecessors: vec![],
            right_neighbor_id: None,
            left_neighbor_id: None,
        };
        let mut map = Argoverse2Map::default();
        let yellow = "DOUBLE_SOLID_YELLOW";
        map.lane_segments.insert("1".into(), lane(1, (0.0, yellow), (-4.0, "NONE"), false));
        map.lane_segments.insert("2".into(), lane(2, (0.0, yellow), (3.0, "UNKNOWN"), true));
        assert_eq!(dividers(&map).count(), 1);
        let middle = centerline(&map.lane_segments["1"]);
        assert_eq!((middle.len(), middle[3]), (11, DVec3::new(3.0, -2.0, 1.0)));
        assert_eq!(centerline(&map.lane_segments["2"])[0], DVec3::new(10.0, 1.5, 1.0));
    }
}
