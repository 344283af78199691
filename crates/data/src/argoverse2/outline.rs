//! The outline of a union of areas: the border between the road and everything else, without the seams between its parts.

use geometry::glam::{DVec2, DVec3};

/// How far beside an edge its two sides are looked at, metres. Coordinates have steps of a centimetre, so seams up to this width close.
const BESIDE_M: f64 = 0.05;
/// Pieces of an edge shorter than this are noise of the cuts, metres.
const SHORTEST_M: f64 = 1e-6;

/// An area with its bounds, so that most questions end at once.
struct Part {
    outer: Vec<DVec2>,
    low: DVec2,
    high: DVec2,
}

/// Polylines along the border of the union of these rings (open: first point not repeated); closed borders repeat their first point.
pub(super) fn of_union(rings: &[Vec<DVec3>]) -> Vec<Vec<DVec3>> {
    let parts: Vec<Part> = rings.iter().map(|ring| Part::new(ring)).collect();
    let mut lines = Vec::new();
    for (index, ring) in rings.iter().enumerate() {
        let mut pieces: Vec<[DVec3; 2]> = Vec::new();
        for (a, b) in ring.iter().zip(ring.iter().cycle().skip(1)) {
            pieces.extend(border_pieces(*a, *b, index, &parts));
        }
        lines.extend(joined(pieces));
    }
    lines
}

impl Part {
    fn new(ring: &[DVec3]) -> Self {
        let outer: Vec<DVec2> = ring.iter().map(|point| point.truncate()).collect();
        let low = outer.iter().fold(DVec2::INFINITY, |low, point| low.min(*point));
        let high = outer.iter().fold(DVec2::NEG_INFINITY, |high, point| high.max(*point));
        Self { outer, low, high }
    }

    fn is_near(&self, low: DVec2, high: DVec2) -> bool {
        low.cmple(self.high + BESIDE_M).all() && high.cmpge(self.low - BESIDE_M).all()
    }

    fn contains(&self, point: DVec2) -> bool {
        self.is_near(point, point) && contains(&self.outer, point)
    }

    fn edges(&self) -> impl Iterator<Item = (DVec2, DVec2)> {
        self.outer.iter().copied().zip(self.outer.iter().copied().cycle().skip(1))
    }
}

/// The pieces of an edge with the union on exactly one side.
fn border_pieces(a: DVec3, b: DVec3, index: usize, parts: &[Part]) -> Vec<[DVec3; 2]> {
    let (from, to) = (a.truncate(), b.truncate());
    let length = from.distance(to);
    if length < SHORTEST_M {
        return Vec::new();
    }
    let near: Vec<(usize, &Part)> =
        parts.iter().enumerate().filter(|(_, part)| part.is_near(from.min(to), from.max(to))).collect();
    let mut cuts = vec![0.0, 1.0];
    for (_, part) in near.iter().filter(|(other, _)| *other != index) {
        for (c, d) in part.edges() {
            cuts.extend(crossing(from, to, c, d));
            // Where two edges run along each other, they part at a corner.
            cuts.extend(foot(from, to, c));
        }
    }
    cuts.sort_by(f64::total_cmp);
    let beside = (to - from).perp() / length * BESIDE_M;
    let mut pieces = Vec::new();
    for pair in cuts.windows(2) {
        let [start, end] = *pair else { continue };
        if (end - start) * length < SHORTEST_M {
            continue;
        }
        let middle = from.lerp(to, (start + end) * 0.5);
        let inside = |point: DVec2| near.iter().any(|(_, part)| part.contains(point));
        // Of two areas that share a border and a side, the first keeps it.
        let taken = near
            .iter()
            .any(|(other, part)| *other < index && part.edges().any(|(c, d)| runs_along(from, to, middle, c, d)));
        if inside(middle + beside) != inside(middle - beside) && !taken {
            pieces.push([a.lerp(b, start), a.lerp(b, end)]);
        }
    }
    pieces
}

/// Share of the way a to b at which it crosses the segment c to d.
fn crossing(a: DVec2, b: DVec2, c: DVec2, d: DVec2) -> Option<f64> {
    let (along, other) = (b - a, d - c);
    let cross = along.perp_dot(other);
    if cross.abs() < 1e-12 {
        return None;
    }
    let (share, of_other) = ((c - a).perp_dot(other) / cross, (c - a).perp_dot(along) / cross);
    ((0.0..=1.0).contains(&share) && (0.0..=1.0).contains(&of_other)).then_some(share)
}

/// Share of the way a to b at which a corner lies on it, within the width that counts as a seam.
fn foot(a: DVec2, b: DVec2, corner: DVec2) -> Option<f64> {
    let along = b - a;
    let share = (corner - a).dot(along) / along.length_squared();
    ((0.0..=1.0).contains(&share) && a.lerp(b, share).distance(corner) < BESIDE_M).then_some(share)
}

/// Whether the segment c to d runs along a to b at this point.
fn runs_along(a: DVec2, b: DVec2, point: DVec2, c: DVec2, d: DVec2) -> bool {
    let (along, other) = (b - a, d - c);
    let parallel = along.perp_dot(other).abs() <= 1e-3 * along.length() * other.length();
    parallel && other != DVec2::ZERO && foot(c, d, point).is_some()
}

/// Pieces that follow each other become one line; the ends of a closed ring meet.
fn joined(pieces: Vec<[DVec3; 2]>) -> Vec<Vec<DVec3>> {
    let mut lines: Vec<Vec<DVec3>> = Vec::new();
    for [start, end] in pieces {
        match lines.last_mut() {
            Some(line) if line.last().is_some_and(|last| last.distance(start) < SHORTEST_M) => line.push(end),
            _ => lines.push(vec![start, end]),
        }
    }
    let meets = match (lines.first(), lines.last()) {
        (Some(first), Some(last)) if lines.len() > 1 => {
            first.first().zip(last.last()).is_some_and(|(a, b)| a.distance(*b) < SHORTEST_M)
        }
        _ => false,
    };
    if meets
        && let Some(mut last) = lines.pop()
        && let Some(first) = lines.first_mut()
    {
        last.extend(first.iter().skip(1));
        *first = last;
    }
    lines
}

/// Whether a point lies inside an outline (even-odd rule).
pub(super) fn contains(outer: &[DVec2], point: DVec2) -> bool {
    let edges = outer.iter().zip(outer.iter().cycle().skip(1));
    let crossed = edges.filter(|(a, b)| {
        (a.y > point.y) != (b.y > point.y) && point.x < a.x + (point.y - a.y) / (b.y - a.y) * (b.x - a.x)
    });
    crossed.count() % 2 == 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rectangle(low: [f64; 2], high: [f64; 2]) -> Vec<DVec3> {
        [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
            .map(|[x, y]| DVec3::new(x, y, 0.0))
            .to_vec()
    }

    fn length(lines: &[Vec<DVec3>]) -> f64 {
        lines.iter().flat_map(|line| line.windows(2)).map(|pair| pair[0].distance(pair[1])).sum()
    }

    #[test]
    fn a_single_area_keeps_its_closed_outline() {
        let lines = of_union(&[rectangle([0.0, 0.0], [4.0, 2.0])]);
        assert_eq!(lines.len(), 1);
        assert_eq!(lines[0].first(), lines[0].last());
        assert!((length(&lines) - 12.0).abs() < 1e-9);
    }

    #[test]
    fn seams_vanish_and_overlaps_leave_the_outer_border() {
        let abutting = of_union(&[rectangle([0.0, 0.0], [4.0, 2.0]), rectangle([4.0, 0.0], [9.0, 2.0])]);
        assert!((length(&abutting) - 22.0).abs() < 1e-9, "{abutting:?}");
        // A crossroads: 2 * (10 + 2) * 2 minus four sides of the middle, each counted for both roads.
        let cross = of_union(&[rectangle([-5.0, -1.0], [5.0, 1.0]), rectangle([-1.0, -5.0], [1.0, 5.0])]);
        assert!((length(&cross) - (48.0 - 8.0)).abs() < 1e-9, "{cross:?}");
        let partly = of_union(&[rectangle([0.0, 0.0], [4.0, 2.0]), rectangle([1.0, 2.0], [3.0, 5.0])]);
        assert!((length(&partly) - (12.0 + 6.0)).abs() < 1e-9, "{partly:?}");
    }

    #[test]
    fn a_shared_border_on_one_side_counts_once_and_a_doubled_area_is_one() {
        let inner = of_union(&[rectangle([0.0, 0.0], [8.0, 4.0]), rectangle([2.0, 0.0], [5.0, 2.0])]);
        assert!((length(&inner) - 24.0).abs() < 1e-9, "{inner:?}");
        let twice = of_union(&[rectangle([0.0, 0.0], [8.0, 4.0]), rectangle([0.0, 0.0], [8.0, 4.0])]);
        assert!((length(&twice) - 24.0).abs() < 1e-9, "{twice:?}");
    }

    #[test]
    fn a_narrow_gap_of_rounded_coordinates_is_a_seam() {
        let lines = of_union(&[rectangle([0.0, 0.0], [4.0, 2.0]), rectangle([4.01, 0.0], [9.0, 2.0])]);
        assert!((length(&lines) - 22.0).abs() < 0.1, "{lines:?}");
    }
}
