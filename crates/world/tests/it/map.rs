use glam::{DVec2, DVec3};
use world::{MapAreaKind, MapLineKind, World, WorldConfig};

fn doubled_area(ring: &[DVec2]) -> f64 {
    (0..ring.len()).map(|i| ring[i].perp_dot(ring[(i + 1) % ring.len()])).sum()
}

fn inside(ring: &[DVec2], p: DVec2) -> bool {
    let crosses = |i: usize| {
        let (a, b) = (ring[i], ring[(i + 1) % ring.len()]);
        (a.y > p.y) != (b.y > p.y) && p.x < (b.x - a.x) * (p.y - a.y) / (b.y - a.y) + a.x
    };
    (0..ring.len()).filter(|i| crosses(*i)).count() % 2 == 1
}

/// Label of the ground, seen from a hand's breadth above it, below all bodies but kerbs.
fn ground(snapshot: &world::Snapshot, p: DVec2) -> u8 {
    snapshot.raycast(p.extend(0.02), DVec3::NEG_Z).expect("the ground is everywhere").semantic
}

#[test]
fn lines_and_areas_lie_where_the_ground_shows_them() {
    let mut kinds = std::collections::HashSet::new();
    for seed in 0..12 {
        let world = World::generate(seed, &WorldConfig::default());
        let (map, snapshot) = (world.map(), world.snapshot(0.0));
        let (low, high) = map.bounds();
        assert!(low.min_element() > 0.0 && high.max_element() < 2000.0, "{low} {high}");
        for line in &map.lines {
            assert!(line.points.len() >= 2);
            for pair in line.points.windows(2) {
                let (middle, along) = (pair[0].midpoint(pair[1]), (pair[1] - pair[0]).normalize());
                if line.kind == MapLineKind::Boundary {
                    let (a, b) = (middle + along.perp() * 0.25, middle - along.perp() * 0.25);
                    assert_ne!(world.drivable(a), world.drivable(b), "seed {seed} {middle}");
                } else if line.kind != MapLineKind::Crossing {
                    assert_eq!(ground(&snapshot, middle), 11, "seed {seed} {:?} {middle}", line.kind);
                }
            }
        }
        for area in &map.areas {
            kinds.insert(area.kind);
            assert!(doubled_area(&area.outer) > 0.0, "seed {seed} {:?}", area.kind);
            assert!(area.holes.iter().all(|hole| doubled_area(hole) < 0.0));
        }
    }
    assert_eq!(kinds.len(), 7, "{kinds:?}");
}

#[test]
fn the_drivable_area_is_what_the_world_says() {
    for seed in 0..6 {
        let world = World::generate(seed, &WorldConfig::default());
        let area = world.map().areas.iter().find(|a| a.kind == MapAreaKind::DrivableArea).expect("one drivable area");
        let pose = world.world_from_ego(7.0);
        let (mut agree, mut all) = (0, 0);
        for x in -60..60 {
            for y in -40..40 {
                let point = (pose * DVec3::new(f64::from(x) + 0.1, f64::from(y) + 0.3, 0.0)).truncate();
                let polygon = inside(&area.outer, point) && !area.holes.iter().any(|hole| inside(hole, point));
                all += 1;
                agree += usize::from(polygon == world.drivable(point));
            }
        }
        // Arcs are polylines in the map, so a few points beside the edge may differ.
        assert!(agree as f64 > 0.998 * all as f64, "seed {seed}: {agree} of {all}");
    }
}

#[test]
fn lanes_connect_and_the_ego_follows_one() {
    for seed in 0..8 {
        let world = World::generate(seed, &WorldConfig::default());
        let lanes = &world.map().lanes;
        assert!(lanes.iter().any(|l| l.connector) && lanes.iter().any(|l| !l.connector));
        for (index, lane) in lanes.iter().enumerate() {
            assert!(doubled_area(&lane.polygon()) > 0.0, "seed {seed} lane {index}");
            assert_eq!(lane.left.len(), lane.right.len());
            for next in &lane.successors {
                assert!(lanes[*next].predecessors.contains(&index));
                let (end, start) = (lane.centerline[lane.centerline.len() - 1], lanes[*next].centerline[0]);
                assert!((end - start).length() < 1e-9, "seed {seed} lane {index}");
            }
        }
        for step in 0..20 {
            let pose = world.world_from_ego(f64::from(step));
            let (here, ahead) = (pose.translation.truncate(), (pose.transform_vector(DVec3::X)).truncate());
            let near = lanes.iter().flat_map(|lane| lane.centerline.windows(2)).any(|pair| {
                let along = pair[1] - pair[0];
                let t = ((here - pair[0]).dot(along) / along.length_squared()).clamp(0.0, 1.0);
                (pair[0] + along * t - here).length() < 0.05 && along.normalize().dot(ahead) > 0.99
            });
            assert!(near, "seed {seed} at {step} s");
        }
    }
}
