use std::collections::BTreeMap;

use geometry::Lens;
use glam::{DVec2, DVec3};
use world::{RenderOptions, SKY_LABEL, World, WorldConfig};

use crate::common::{camera, ego_from_cam, lenses};

#[test]
fn a_ray_to_a_visible_box_centre_meets_the_actor() {
    let mut met: BTreeMap<&str, usize> = BTreeMap::new();
    for seed in 0..16 {
        let world = World::generate(seed, &WorldConfig::default());
        for step in 0..6 {
            let time = f64::from(step) * 3.3;
            let snapshot = world.snapshot(time);
            let eye = world.world_from_ego(time) * DVec3::new(1.5, 0.0, 1.5);
            for actor in world.actors_at(time) {
                let to = actor.world_box.center - eye;
                let distance = to.length();
                let reach = actor.world_box.size.length() * 0.5;
                if distance > 60.0 {
                    continue;
                }
                let hit = snapshot.raycast(eye, to / distance).expect("the ground lies behind every box");
                let own = hit.instance == actor.id + 1;
                if own {
                    assert_eq!(hit.semantic, actor.class.semantic());
                    assert!((hit.distance - distance).abs() < reach + 0.01, "{distance} {hit:?} {actor:?}");
                    *met.entry(actor.class.name()).or_default() += 1;
                }
                // Whatever is met instead stands before the centre.
                assert!(own || hit.distance < distance, "seed {seed} at {time}: {actor:?} missed, met {hit:?}");
            }
        }
    }
    assert_eq!(met.len(), 10, "{met:?}");
}

#[test]
fn pixels_agree_with_single_rays_for_every_lens() {
    for (lens, seed) in lenses().into_iter().zip([2, 5, 8]) {
        let world = World::generate(seed, &WorldConfig::default());
        let (camera, snapshot) = (camera(64, 48, lens), world.snapshot(5.0));
        let pose = world.world_from_ego(5.0) * ego_from_cam(-0.9, 1.5, -0.4);
        let view = snapshot.render(&camera, &pose, &RenderOptions::default());
        let mut hits = 0;
        for row in 0..48u32 {
            for column in 0..64u32 {
                let at = (row * 64 + column) as usize;
                let pixel = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
                let ray = camera.unproject(pixel).expect("these lenses cover the picture");
                match snapshot.raycast(pose.translation, pose.transform_vector(ray)) {
                    Some(hit) => {
                        hits += 1;
                        let depth = hit.distance * ray.z;
                        assert!((f64::from(view.depth[at]) - depth).abs() < 1e-4 * depth.max(1.0), "{lens:?} {pixel}");
                        assert_eq!((view.semantic[at], view.instance[at]), (hit.semantic, hit.instance));
                        // The point projects back onto its pixel.
                        let point = camera.project(ray * hit.distance).expect("before the camera");
                        assert!((point - pixel).length() < 1e-4, "{lens:?} {pixel} {point}");
                    }
                    None => {
                        assert_eq!(view.semantic[at], SKY_LABEL);
                        assert!(view.depth[at].is_infinite() && view.instance[at] == 0);
                    }
                }
            }
        }
        assert!(hits > 1000 && hits < 64 * 48, "{lens:?} {hits}");
    }
}

#[test]
fn two_views_agree_on_a_point_that_both_see() {
    let (width, height) = (128u32, 96u32);
    let camera = camera(width, height, Lens::Pinhole);
    let (mut common, mut same, mut difference) = (0usize, 0usize, 0.0f64);
    for seed in 0..4 {
        let world = World::generate(seed, &WorldConfig::default());
        let snapshot = world.snapshot(8.0);
        let pose = |azimuth: f64, y: f64| world.world_from_ego(8.0) * ego_from_cam(azimuth, 1.5, y);
        let (a, b) = (pose(0.0, 0.0), pose(0.6, 0.5));
        let view = |pose| snapshot.render(&camera, pose, &RenderOptions::default());
        let (left, right) = (view(&a), view(&b));
        for at in 0..(width * height) as usize {
            let pixel = DVec2::new((at as u32 % width) as f64 + 0.5, (at as u32 / width) as f64 + 0.5);
            let ray = camera.unproject(pixel).expect("pinhole");
            let point = a * (ray * (f64::from(left.depth[at]) / ray.z));
            if !point.is_finite() {
                continue;
            }
            let in_b = b.inverse() * point;
            let Some(seen) = camera.project(in_b).filter(|p| camera.intrinsics.contains(*p)) else { continue };
            // Exactly along the ray of the point, not of a pixel's centre.
            let hit = snapshot.raycast(b.translation, point - b.translation).expect("something was seen there");
            if hit.distance < 0.999 {
                continue;
            }
            common += 1;
            same += usize::from((hit.semantic, hit.instance) == (left.semantic[at], left.instance[at]));
            let other = seen.y as usize * width as usize + seen.x as usize;
            if right.instance[other] == left.instance[at] && right.semantic[other] == left.semantic[at] {
                let step = |c: usize| f64::from(left.rgb[at * 3 + c].abs_diff(right.rgb[other * 3 + c]));
                difference += (step(0) + step(1) + step(2)) / 3.0;
            }
        }
    }
    assert!(common > 4000, "{common}");
    assert!(same as f64 > 0.995 * common as f64, "{same} of {common}");
    assert!(difference / (common as f64) < 12.0, "mean difference {}", difference / common as f64);
}
