//! The map that our own writer makes, read back: what the world says about itself.

use data::{LocalMap, MapKind, MapLine};
use geometry::Rigid;
use glam::DVec2;
use world::MapLineKind;

use super::*;

fn distance(lines: &[Vec<DVec2>], point: DVec2) -> f64 {
    let pairs = lines.iter().flat_map(|line| line.windows(2));
    let distances = pairs.map(|pair| {
        let way = pair[1] - pair[0];
        let share = ((point - pair[0]).dot(way) / way.length_squared().max(1e-12)).clamp(0.0, 1.0);
        point.distance(pair[0] + way * share)
    });
    distances.fold(f64::INFINITY, f64::min)
}

/// Lines of a kind, near enough to the car that the cut of the square plays no role.
fn read_lines(map: &LocalMap, kind: MapKind) -> Vec<Vec<DVec2>> {
    let line = |line: &MapLine| line.points.iter().map(|p| DVec2::new(p[0], p[1])).collect();
    map.lines.iter().filter(|found| found.kind == kind).map(line).collect()
}

fn world_lines(truth: &Truth, world_from_ego: &Rigid, kinds: &[MapLineKind]) -> Vec<Vec<DVec2>> {
    let ego_from_world = world_from_ego.inverse();
    let to_ego = |point: &DVec2| (ego_from_world * point.extend(0.0)).truncate();
    let lines = truth.world.map().lines.iter().filter(|line| kinds.contains(&line.kind));
    lines.map(|line| line.points.iter().map(to_ego).collect()).collect()
}

/// Largest distance between two sets of lines, both ways, over points within 30 m of the car.
fn error(a: &[Vec<DVec2>], b: &[Vec<DVec2>]) -> (f64, usize) {
    let near = |lines: &[Vec<DVec2>]| -> Vec<DVec2> {
        lines.iter().flatten().filter(|point| point.length() < 30.0).copied().collect()
    };
    let (from_a, from_b) = (near(a), near(b));
    let there = from_a.iter().map(|point| distance(b, *point)).fold(0.0, f64::max);
    let back = from_b.iter().map(|point| distance(a, *point)).fold(0.0, f64::max);
    (there.max(back), from_a.len().min(from_b.len()))
}

#[test]
fn the_map_that_was_written_is_read_back() {
    let dataset = open(FrameChoice::KeyFrames);
    for (index, frame) in frames(&dataset).iter().enumerate() {
        let truth = Truth::of(&frame.id.scene);
        let map = dataset.local_map(index, 40.0).unwrap();
        let world_from_ego = truth.map_from_world.inverse() * frame.world_from_ego;
        let kinds = [
            (MapKind::Divider, vec![MapLineKind::RoadDivider, MapLineKind::LaneDivider], 1e-3),
            (MapKind::Crossing, vec![MapLineKind::Crossing], 1e-3),
            // Points on circles become arcs; they lie on the arcs, the arcs bulge between them.
            (MapKind::Centerline, vec![MapLineKind::Centerline], 0.05),
            (MapKind::Boundary, vec![MapLineKind::Boundary], 0.02),
        ];
        for (kind, world_kinds, tolerance) in kinds {
            let (worst, points) = error(&read_lines(&map, kind), &world_lines(&truth, &world_from_ego, &world_kinds));
            eprintln!("{} {kind:?}: {points} points, {worst} m", frame.id.scene);
            assert!(worst < tolerance, "{kind:?} differs by {worst} m");
            assert!(points > 0 || kind == MapKind::Crossing, "no {kind:?} near the car");
        }
        assert!(
            dataset
                .map_prior(index)
                .unwrap()
                .covers(frame.world_from_ego.translation.x, frame.world_from_ego.translation.y)
                .unwrap()
        );
    }
}
