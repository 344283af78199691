//! Lines and areas against the square |x|, |y| <= half around the car.

use geometry::glam::{DVec2, DVec3};

/// The parts of a polyline inside the square, cut at its border.
pub(super) fn clip_line(points: &[DVec3], half: f64) -> Vec<Vec<DVec3>> {
    let (mut parts, mut part) = (Vec::new(), Vec::new());
    for (a, b) in points.iter().zip(points.iter().skip(1)) {
        let Some((from, to)) = inside(a.truncate(), b.truncate(), half) else { continue };
        if from > 0.0 || part.is_empty() {
            flush(&mut parts, &mut part);
            part.push(a.lerp(*b, from));
        }
        part.push(if to < 1.0 { a.lerp(*b, to) } else { *b });
        if to < 1.0 {
            flush(&mut parts, &mut part);
        }
    }
    flush(&mut parts, &mut part);
    parts
}

fn flush(parts: &mut Vec<Vec<DVec3>>, part: &mut Vec<DVec3>) {
    if part.len() > 1 {
        parts.push(std::mem::take(part));
    }
    part.clear();
}

/// The share [from, to] of the way from a to b that lies in the square; `None` where that is not even a piece.
fn inside(a: DVec2, b: DVec2, half: f64) -> Option<(f64, f64)> {
    let (mut from, mut to) = (0.0_f64, 1.0_f64);
    for (start, end) in [(a.x, b.x), (a.y, b.y), (-a.x, -b.x), (-a.y, -b.y)] {
        // Stay where the coordinate is at most `half`.
        let (before, step) = (half - start, end - start);
        if step > 0.0 {
            to = to.min(before / step);
        } else if step < 0.0 {
            from = from.max(before / step);
        } else if before < 0.0 {
            return None;
        }
    }
    (from < to).then_some((from, to))
}

/// Whether a polygon and the square have points in common.
pub(super) fn reaches_square(outline: &[DVec2], half: f64) -> bool {
    let edges = || outline.iter().zip(outline.iter().cycle().skip(1));
    // Either a border of one crosses the other, or the square lies wholly within.
    let crosses = edges().any(|(a, b)| inside(*a, *b, half).is_some());
    let right_of_origin =
        |(a, b): &(&DVec2, &DVec2)| (a.y > 0.0) != (b.y > 0.0) && a.x + (b.x - a.x) * (-a.y / (b.y - a.y)) > 0.0;
    outline.len() > 2 && (crosses || edges().filter(right_of_origin).count() % 2 == 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: &[[f64; 3]]) -> Vec<DVec3> {
        points.iter().copied().map(DVec3::from_array).collect()
    }

    #[test]
    fn lines_are_cut_at_the_border() {
        let through = clip_line(&line(&[[-20.0, 1.0, 0.0], [20.0, 1.0, 4.0]]), 10.0);
        assert_eq!(through, [line(&[[-10.0, 1.0, 1.0], [10.0, 1.0, 3.0]])]);
        let inner = line(&[[0.0, 0.0, 0.0], [5.0, 5.0, 1.0], [-5.0, 5.0, 2.0]]);
        assert_eq!(clip_line(&inner, 10.0), [inner]);
        assert!(clip_line(&line(&[[11.0, -5.0, 0.0], [11.0, 5.0, 0.0], [30.0, 5.0, 0.0]]), 10.0).is_empty());
        assert!(clip_line(&line(&[[1.0, 1.0, 0.0]]), 10.0).is_empty() && clip_line(&[], 10.0).is_empty());
    }

    #[test]
    fn a_line_that_leaves_and_returns_has_two_parts() {
        let way = line(&[[0.0, 0.0, 0.0], [20.0, 0.0, 0.0], [20.0, 5.0, 0.0], [0.0, 5.0, 0.0], [0.0, 6.0, 0.0]]);
        let parts = clip_line(&way, 10.0);
        let want =
            [line(&[[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]), line(&[[10.0, 5.0, 0.0], [0.0, 5.0, 0.0], [0.0, 6.0, 0.0]])];
        assert_eq!(parts, want);
    }

    #[test]
    fn areas_that_reach_into_the_square_count() {
        let square = |x: f64, y: f64, side: f64| {
            [(0.0, 0.0), (side, 0.0), (side, side), (0.0, side)].map(|(dx, dy)| DVec2::new(x + dx, y + dy))
        };
        assert!(reaches_square(&square(-1.0, -1.0, 2.0), 10.0), "inside");
        assert!(reaches_square(&square(-50.0, -50.0, 100.0), 10.0), "around");
        assert!(reaches_square(&square(8.0, 8.0, 5.0), 10.0), "across a corner");
        assert!(!reaches_square(&square(11.0, -5.0, 10.0), 10.0) && !reaches_square(&square(-30.0, 0.0, 10.0), 10.0));
        assert!(!reaches_square(&square(0.0, 0.0, 1.0)[..2], 10.0) && !reaches_square(&[], 10.0));
    }
}
