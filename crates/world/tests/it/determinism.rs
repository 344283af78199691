use geometry::Lens;
use world::{RenderOptions, TimeOfDay, TrafficSide, Weather, World, WorldConfig};

use crate::common::{camera, ego_from_cam};

fn picture(world: &World, parallel: bool) -> world::Rendering {
    let camera = camera(96, 60, Lens::Pinhole);
    let pose = world.world_from_ego(6.0) * ego_from_cam(0.4, 1.5, 0.2);
    let snapshot = world.snapshot(6.0);
    let options = RenderOptions::default();
    if parallel { snapshot.render(&camera, &pose, &options) } else { snapshot.render_serial(&camera, &pose, &options) }
}

#[test]
fn the_same_seed_gives_the_same_bytes_on_any_number_of_threads() {
    let make = || World::generate(3, &WorldConfig::default());
    let world = make();
    let serial = picture(&world, false);
    let again = make();
    assert_eq!(world.map(), again.map());
    assert_eq!(world.actors_at(4.0), again.actors_at(4.0));
    assert_eq!(world.caption(), again.caption());
    for threads in [1, 2, 5] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("thread pool");
        let parallel = pool.install(|| picture(&make(), true));
        assert!(serial == parallel, "{threads} threads");
    }
}

#[test]
fn other_seeds_give_other_worlds() {
    let (a, b) = (World::generate(1, &WorldConfig::default()), World::generate(2, &WorldConfig::default()));
    assert_ne!(a.map(), b.map());
    assert_ne!(picture(&a, false).rgb, picture(&b, false).rgb);
}

#[test]
fn the_config_rules_conditions_and_densities() {
    let config = WorldConfig {
        times_of_day: vec![TimeOfDay::Night],
        weathers: vec![Weather::Rain],
        left_hand: Some(true),
        traffic_density: 0.0,
        parked_density: 0.0,
        pedestrian_density: 0.0,
        ..WorldConfig::default()
    };
    let crowd = WorldConfig { traffic_density: 1.5, pedestrian_density: 2.0, ..WorldConfig::default() };
    let (mut few, mut many) = (0, 0);
    for seed in 0..4 {
        let world = World::generate(seed, &config);
        let conditions = world.conditions();
        assert_eq!(conditions.time_of_day, TimeOfDay::Night);
        assert_eq!(conditions.weather, Weather::Rain);
        assert_eq!(conditions.traffic_side, TrafficSide::Left);
        assert!(world.caption().starts_with("Rainy night"));
        few += world.actors_at(0.0).len();
        many += World::generate(seed, &crowd).actors_at(0.0).len();
    }
    assert!(few * 3 < many, "{few} {many}");
}

#[test]
fn nights_are_darker_than_days_and_no_frame_is_black() {
    let mean = |time: TimeOfDay, seed: u64| {
        let config = WorldConfig { times_of_day: vec![time], ..WorldConfig::default() };
        let view = picture(&World::generate(seed, &config), false);
        view.rgb.iter().map(|v| f64::from(*v)).sum::<f64>() / view.rgb.len() as f64
    };
    for seed in 0..4 {
        let (day, night) = (mean(TimeOfDay::Day, seed), mean(TimeOfDay::Night, seed));
        assert!(day > 60.0 && night > 6.0 && night < day * 0.75, "seed {seed}: day {day}, night {night}");
    }
}
