//! Lane centre lines as the map expansion stores them: pieces of three parts each (left arc, right arc or straight, of given
//! lengths and one radius), of which ours use a single one.
//!
//! Centre lines come as points. Runs of points that lie on one circle or one straight become one piece, so that the world's arcs
//! come back as arcs.

use glam::DVec2;
use serde::Serialize;

/// Farthest a point may lie from its piece, metres; the format's readers allow 5 cm at piece ends.
const TOLERANCE_M: f64 = 0.01;
/// Radius written for straights, where it has no effect.
const STRAIGHT_RADIUS_M: f64 = 1000.0;
/// Circles larger than this are straights within the tolerance for any lane.
const LARGEST_RADIUS_M: f64 = 5000.0;
/// An arc may bulge this far from the side between two of its points, metres. Three points always lie on a circle; a corner of the
/// road must not become one.
const BULGE_M: f64 = 0.1;

/// One piece.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct ArclinePiece {
    /// x, y, heading.
    pub(super) start_pose: [f64; 3],
    pub(super) end_pose: [f64; 3],
    pub(super) shape: &'static str,
    pub(super) radius: f64,
    pub(super) segment_length: [f64; 3],
}

/// Pieces that follow the points, each ending where the next begins.
pub(super) fn pieces(points: &[DVec2]) -> Vec<ArclinePiece> {
    let points = without_repeats(points);
    let mut pieces = vec![];
    let mut start = 0;
    while start + 1 < points.len() {
        // Two points always fit; grow while more do.
        let mut end = start + 1;
        let mut best = straight(points[start], points[end]);
        while let Some(piece) = points.get(start..=end + 1).and_then(fit) {
            best = piece;
            end += 1;
        }
        pieces.push(best);
        start = end;
    }
    pieces
}

fn without_repeats(points: &[DVec2]) -> Vec<DVec2> {
    let mut kept: Vec<DVec2> = vec![];
    for point in points {
        if kept.last().is_none_or(|last| last.distance(*point) > 1e-6) {
            kept.push(*point);
        }
    }
    kept
}

/// The straight or arc through all points, if there is one. At least three points.
fn fit(points: &[DVec2]) -> Option<ArclinePiece> {
    let (first, last) = (*points.first()?, *points.last()?);
    let chord = last - first;
    if chord.length() < 1e-6 {
        return None;
    }
    let normal = chord.perp().normalize();
    if points.iter().all(|p| (*p - first).dot(normal).abs() < TOLERANCE_M) && runs_forward(points, chord) {
        return Some(straight(first, last));
    }
    let (centre, radius) = circle(first, points[points.len() / 2], last)?;
    let on_circle = |p: &DVec2| (p.distance(centre) - radius).abs() < TOLERANCE_M;
    if radius > LARGEST_RADIUS_M || !points.iter().all(on_circle) {
        return None;
    }
    let side = chord.perp_dot(points[points.len() / 2] - first);
    // A bulge to the right of the chord is a left turn.
    let turn = if side < 0.0 { 1.0 } else { -1.0 };
    let mut swept = 0.0;
    for pair in points.windows(2) {
        let step = turn * (pair[0] - centre).angle_to(pair[1] - centre);
        if step <= 0.0 || radius * (1.0 - (0.5 * step).cos()) > BULGE_M {
            return None;
        }
        swept += step;
    }
    let heading = |p: DVec2| ((p - centre).perp() * turn).to_angle();
    Some(ArclinePiece {
        start_pose: [first.x, first.y, heading(first)],
        end_pose: [last.x, last.y, heading(last)],
        shape: if turn > 0.0 { "LSR" } else { "RSL" },
        radius,
        segment_length: [swept * radius, 0.0, 0.0],
    })
}

fn runs_forward(points: &[DVec2], direction: DVec2) -> bool {
    points.windows(2).all(|pair| (pair[1] - pair[0]).dot(direction) > 0.0)
}

fn straight(from: DVec2, to: DVec2) -> ArclinePiece {
    let heading = (to - from).to_angle();
    ArclinePiece {
        start_pose: [from.x, from.y, heading],
        end_pose: [to.x, to.y, heading],
        shape: "LSR",
        radius: STRAIGHT_RADIUS_M,
        segment_length: [0.0, from.distance(to), 0.0],
    }
}

/// Circle through three points; `None` when they are in line.
fn circle(a: DVec2, b: DVec2, c: DVec2) -> Option<(DVec2, f64)> {
    let (u, v) = (b - a, c - a);
    let twice_area = 2.0 * u.perp_dot(v);
    if twice_area.abs() < 1e-9 {
        return None;
    }
    let centre = a + DVec2::new(
        v.y * u.length_squared() - u.y * v.length_squared(),
        u.x * v.length_squared() - v.x * u.length_squared(),
    ) / twice_area;
    Some((centre, centre.distance(a)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    /// Where a piece ends when it is driven from its start.
    fn drive(piece: &ArclinePiece) -> DVec2 {
        let start = DVec2::new(piece.start_pose[0], piece.start_pose[1]);
        let heading = DVec2::from_angle(piece.start_pose[2]);
        let arc = piece.segment_length[0];
        let turn = if piece.shape == "LSR" { 1.0 } else { -1.0 };
        let centre = start + heading.perp() * turn * piece.radius;
        let turned = centre + DVec2::from_angle(turn * arc / piece.radius).rotate(start - centre);
        turned + heading * piece.segment_length[1]
    }

    #[test]
    fn a_bent_road_becomes_straight_arc_straight() {
        for turn in [1.0, -1.0] {
            let mut points: Vec<DVec2> = (0..=10).map(|i| DVec2::new(f64::from(i) * 3.0, 0.0)).collect();
            let centre = DVec2::new(30.0, turn * 20.0);
            points.extend((1..=12).map(|i| {
                let angle = turn * (f64::from(i) / 12.0 - 1.0) * FRAC_PI_2;
                centre + 20.0 * DVec2::from_angle(angle)
            }));
            points.extend((1..=4).map(|i| DVec2::new(50.0, turn * (20.0 + 5.0 * f64::from(i)))));
            let pieces = pieces(&points);
            assert_eq!(pieces.len(), 3, "{pieces:?}");
            assert!((pieces[1].radius - 20.0).abs() < 1e-6);
            assert!((pieces[1].segment_length[0] - 20.0 * FRAC_PI_2).abs() < 1e-6);
            assert_eq!(pieces[1].shape, if turn > 0.0 { "LSR" } else { "RSL" });
            for (piece, next) in pieces.iter().zip(pieces.iter().skip(1)) {
                assert_eq!(piece.end_pose[..2], next.start_pose[..2]);
            }
            for piece in &pieces {
                let end = DVec2::new(piece.end_pose[0], piece.end_pose[1]);
                assert!(drive(piece).distance(end) < 1e-6, "{piece:?}");
            }
        }
    }

    #[test]
    fn corners_and_repeated_points_are_kept_apart() {
        let points = [(0.0, 0.0), (5.0, 0.0), (5.0, 0.0), (10.0, 0.0), (10.0, 7.0), (3.0, 7.0)];
        let pieces = pieces(&points.map(|(x, y)| DVec2::new(x, y)));
        assert_eq!(
            pieces.iter().map(|p| p.segment_length).collect::<Vec<_>>(),
            [[0.0, 10.0, 0.0], [0.0, 7.0, 0.0], [0.0, 7.0, 0.0]]
        );
        assert_eq!(pieces[2].end_pose[..2], [3.0, 7.0]);
    }
}
