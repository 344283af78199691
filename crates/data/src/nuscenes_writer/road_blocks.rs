//! Road blocks: bundles of neighbouring lanes that run the same way, which the procedural world does not name.

use glam::DVec2;
use world::MapLane;

/// Boundaries of neighbouring lanes coincide within this, metres.
const TOUCH_M: f64 = 0.05;

/// One bundle.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Bundle {
    pub(super) outline: Vec<DVec2>,
    /// Across the road where the lanes begin.
    pub(super) from_edge: [DVec2; 2],
    /// Across the road where they end.
    pub(super) to_edge: [DVec2; 2],
}

/// Bundles of the lanes that are no connectors, in the order of their left-most lanes.
pub(super) fn bundles(lanes: &[MapLane]) -> Vec<Bundle> {
    let lanes: Vec<&MapLane> = lanes.iter().filter(|lane| !lane.connector && !lane.left.is_empty()).collect();
    let right_neighbour = |lane: &MapLane| lanes.iter().find(|other| touches(&lane.right, &other.left)).copied();
    let is_leftmost = |lane: &MapLane| !lanes.iter().any(|other| touches(&other.right, &lane.left));
    let mut bundles = vec![];
    for leftmost in lanes.iter().copied().filter(|lane| is_leftmost(lane)) {
        let mut rightmost = leftmost;
        // A chain is no longer than the number of lanes, whatever the map holds.
        for _ in 0..lanes.len() {
            match right_neighbour(rightmost) {
                Some(next) => rightmost = next,
                None => break,
            }
        }
        let (left, right) = (&leftmost.left, &rightmost.right);
        bundles.push(Bundle {
            outline: right.iter().chain(left.iter().rev()).copied().collect(),
            from_edge: [left[0], right[0]],
            to_edge: [left[left.len() - 1], right[right.len() - 1]],
        });
    }
    bundles
}

/// Same direction, same ends.
fn touches(a: &[DVec2], b: &[DVec2]) -> bool {
    let close = |p: Option<&DVec2>, q: Option<&DVec2>| p.zip(q).is_some_and(|(p, q)| p.distance(*q) < TOUCH_M);
    close(a.first(), b.first()) && close(a.last(), b.last())
}

/// Mean of the corners.
pub(super) fn middle(ring: &[DVec2]) -> DVec2 {
    ring.iter().sum::<DVec2>() / ring.len().max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use world::Paint;

    fn lane(left: f64, forward: bool, connector: bool) -> MapLane {
        let side = |y: f64| {
            if forward { [DVec2::new(0.0, y), DVec2::new(9.0, y)] } else { [DVec2::new(9.0, y), DVec2::new(0.0, y)] }
        };
        let width = if forward { -3.0 } else { 3.0 };
        MapLane {
            left: side(left).to_vec(),
            right: side(left + width).to_vec(),
            centerline: side(left + width * 0.5).to_vec(),
            left_paint: Paint::None,
            right_paint: Paint::None,
            connector,
            successors: vec![],
            predecessors: vec![],
        }
    }

    #[test]
    fn lanes_of_one_direction_are_bundled() {
        // Two lanes eastward right of the middle line, one westward, one connector.
        let lanes = [lane(-3.0, true, false), lane(0.0, true, false), lane(0.0, false, false), lane(-6.0, true, true)];
        let bundles = bundles(&lanes);
        assert_eq!(bundles.len(), 2);
        assert_eq!(bundles[0].from_edge, [DVec2::new(0.0, 0.0), DVec2::new(0.0, -6.0)]);
        assert_eq!(bundles[1].to_edge, [DVec2::new(0.0, 0.0), DVec2::new(0.0, 3.0)]);
        assert_eq!(middle(&bundles[0].outline), DVec2::new(4.5, -3.0));
    }
}
