use std::collections::BTreeSet;

use geometry::Box3d;
use glam::DVec2;
use world::{ActorClass, World, WorldConfig};

/// Corners of a box on the ground plan.
fn plan(b: &Box3d) -> Vec<DVec2> {
    let corners = b.corners();
    [0, 1, 5, 4].map(|i| corners[i].truncate()).to_vec()
}

/// Separating axes of two rectangles.
fn overlap(a: &Box3d, b: &Box3d) -> bool {
    let (pa, pb) = (plan(a), plan(b));
    let axes = [a.yaw, a.yaw + std::f64::consts::FRAC_PI_2, b.yaw, b.yaw + std::f64::consts::FRAC_PI_2];
    axes.iter().all(|angle| {
        let axis = DVec2::from_angle(*angle);
        let range = |points: &[DVec2]| {
            let along = points.iter().map(|p| p.dot(axis));
            along.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
        };
        let ((a0, a1), (b0, b1)) = (range(&pa), range(&pb));
        a0 < b1 && b0 < a1
    })
}

#[test]
fn the_ego_drives_smoothly_on_the_road_and_touches_nobody() {
    for seed in 0..20 {
        let world = World::generate(seed, &WorldConfig::default());
        let mut last = world.world_from_ego(0.0);
        let (start_yaw, mut turned) = (last.yaw(), 0.0f64);
        let mut driven = 0.0;
        let steps = (world.duration_secs() * 10.0) as usize;
        for step in 0..=steps {
            let time = step as f64 * 0.1;
            let pose = world.world_from_ego(time);
            let moved = (pose.translation - last.translation).length();
            let yawed = geometry::wrap_angle(pose.yaw() - last.yaw()).abs();
            assert!(moved < 2.0 && yawed < 0.06, "seed {seed} at {time}: {moved} m, {yawed} rad in 0.1 s");
            driven += moved;
            turned = turned.max(geometry::wrap_angle(pose.yaw() - start_yaw).abs());
            last = pose;
            let ego = world.ego_box(time);
            assert!(plan(&ego).into_iter().all(|p| world.drivable(p)), "seed {seed} at {time}: off the road");
            for actor in world.actors_at(time) {
                assert!(!overlap(&ego, &actor.world_box), "seed {seed} at {time}: touches {actor:?}");
            }
        }
        assert!(driven > 90.0 && turned > 0.25, "seed {seed}: {driven} m, {turned} rad");
        assert!(world.duration_secs() >= 20.0);
    }
}

#[test]
fn velocities_are_the_slope_of_positions() {
    let world = World::generate(4, &WorldConfig::default());
    let (dt, time) = (1e-4, 7.0);
    let (before, now, after) = (world.actors_at(time - dt), world.actors_at(time), world.actors_at(time + dt));
    let mut moving = 0;
    for actor in &now {
        let find = |list: &[world::ActorState]| list.iter().find(|a| a.id == actor.id).cloned();
        let (Some(a), Some(b)) = (find(&before), find(&after)) else { continue };
        let slope = (b.world_box.center - a.world_box.center).truncate() / (2.0 * dt);
        assert!((slope - actor.velocity).length() < 0.02, "{actor:?} {slope}");
        moving += usize::from(actor.velocity.length() > 0.5);
        if actor.parked {
            assert_eq!(actor.velocity, DVec2::ZERO);
        }
    }
    assert!(moving > 5);
}

#[test]
fn all_classes_occur_and_actors_come_and_go() {
    let mut classes = BTreeSet::new();
    let (mut appeared, mut vanished, mut parked) = (0, 0, 0);
    for seed in 0..16 {
        let world = World::generate(seed, &WorldConfig::default());
        let ids = |time: f64| world.actors_at(time).iter().map(|a| a.id).collect::<BTreeSet<_>>();
        let (first, last) = (ids(0.0), ids(world.duration_secs()));
        appeared += last.difference(&first).count();
        vanished += first.difference(&last).count();
        let actors = world.actors_at(0.0);
        assert!(actors.windows(2).all(|pair| pair[0].id < pair[1].id));
        parked += actors.iter().filter(|a| a.parked).count();
        classes.extend(actors.iter().map(|a| a.class));
        for actor in &actors {
            let bottom = actor.world_box.center.z - actor.world_box.size.z * 0.5;
            assert!(bottom.abs() < 1e-9 && actor.world_box.size.min_element() > 0.1, "{actor:?}");
        }
    }
    assert_eq!(classes.into_iter().collect::<Vec<_>>(), ActorClass::ALL.to_vec());
    assert!(appeared > 0 && vanished > 0 && parked > 50, "{appeared} {vanished} {parked}");
}
