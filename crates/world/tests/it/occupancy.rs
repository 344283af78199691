use geometry::BevGrid;
use glam::DVec3;
use world::{FREE_LABEL, World, WorldConfig};

#[test]
fn what_a_ray_meets_is_occupied_with_its_label() {
    let grid = BevGrid { x_range: [-40.0, 40.0], y_range: [-40.0, 40.0], z_range: [-1.0, 5.4], cells: [16, 200, 200] };
    let (mut hits, mut occupied, mut same) = (0usize, 0usize, 0usize);
    let mut labels_seen = std::collections::BTreeSet::new();
    for seed in 0..3 {
        let world = World::generate(seed, &WorldConfig::default());
        let time = 9.0;
        let (snapshot, pose) = (world.snapshot(time), world.world_from_ego(time));
        let labels = world.occupancy(time, &pose, &grid);
        assert_eq!(labels.len(), grid.len());
        labels_seen.extend(labels.iter().copied());
        let free = labels.iter().filter(|l| **l == FREE_LABEL).count();
        assert!(free > labels.len() / 2 && free < labels.len(), "seed {seed}: {free} free");
        let eye = DVec3::new(1.5, 0.0, 1.6);
        for azimuth in 0..180 {
            for tilt in -20..12 {
                let (a, e) = (f64::from(azimuth).to_radians() * 2.0, f64::from(tilt).to_radians());
                let direction = DVec3::new(a.cos() * e.cos(), a.sin() * e.cos(), e.sin());
                let Some(hit) = snapshot.raycast(pose * eye, pose.transform_vector(direction)) else { continue };
                // A hair beyond the surface lies inside the body.
                let Some([z, y, x]) = grid.cell_of(eye + direction * (hit.distance + 1e-3)) else { continue };
                let label = labels[(z * 200 + y) * 200 + x];
                hits += 1;
                occupied += usize::from(label != FREE_LABEL);
                same += usize::from(label == hit.semantic);
            }
        }
    }
    assert!(hits > 5000, "{hits}");
    assert!(occupied as f64 > 0.995 * hits as f64, "{occupied} of {hits}");
    assert!(same as f64 > 0.93 * hits as f64, "{same} of {hits}");
    for label in [4, 11, 13, 15, 16, 17] {
        assert!(labels_seen.contains(&label), "{labels_seen:?}");
    }
}

#[test]
fn cells_outside_all_bodies_are_free() {
    let grid = BevGrid { x_range: [-8.0, 8.0], y_range: [-8.0, 8.0], z_range: [30.0, 34.0], cells: [4, 8, 8] };
    let config = WorldConfig { building_density: 0.0, ..WorldConfig::default() };
    let world = World::generate(1, &config);
    let labels = world.occupancy(0.0, &world.world_from_ego(0.0), &grid);
    assert!(labels.iter().all(|l| *l == FREE_LABEL));
}
