//! How much of an actor the pictures of a sample show.
//!
//! Seen pixels carry the actor's instance id. Hidden ones are those whose ray would enter the actor's box behind what the picture
//! shows there. The box is larger than the actor, so half-hidden actors come out a little less visible than they are.

use std::collections::BTreeMap;

use geometry::{Box3d, Camera, Rigid};
use glam::{DVec2, DVec3};
use world::{ActorState, Rendering};

/// Pixels looked at along the longer side of a box: enough for the four coarse levels.
const SAMPLES_PER_SIDE: f64 = 48.0;
/// Nearer corners cannot be projected; such a box is looked for in the whole picture.
const NEAR_M: f64 = 0.1;

/// Pixels of one actor, summed over pictures.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Sight {
    pub(super) seen: f64,
    pub(super) hidden: f64,
}

impl Sight {
    /// The table's token: levels up to 40, 60, 80 and 100 %. An actor outside all pictures counts as invisible.
    pub(super) fn token(self) -> &'static str {
        let share = if self.seen > 0.0 { self.seen / (self.seen + self.hidden) } else { 0.0 };
        match share {
            s if s < 0.4 => "1",
            s if s < 0.6 => "2",
            s if s < 0.8 => "3",
            _ => "4",
        }
    }
}

/// Adds what one picture shows of the actors near it, by actor id.
pub(super) fn look(
    actors: &[ActorState],
    camera: &Camera,
    world_from_cam: &Rigid,
    picture: &Rendering,
    range_m: f64,
) -> BTreeMap<u32, Sight> {
    let cam_from_world = world_from_cam.inverse();
    let mut sights = BTreeMap::new();
    for actor in actors {
        if actor.world_box.center.distance(world_from_cam.translation) > range_m {
            continue;
        }
        let sight = look_for(actor, camera, &cam_from_world, picture);
        if sight != Sight::default() {
            sights.insert(actor.id, sight);
        }
    }
    sights
}

fn look_for(actor: &ActorState, camera: &Camera, cam_from_world: &Rigid, picture: &Rendering) -> Sight {
    let mut sight = Sight::default();
    let Some((low, high)) = pixel_bounds(&actor.world_box, camera, cam_from_world) else {
        return sight;
    };
    let box_from_cam =
        Rigid::from_yaw(actor.world_box.yaw, actor.world_box.center).inverse() * cam_from_world.inverse();
    let side = (high - low).max_element().max(1.0);
    let stride = (side / SAMPLES_PER_SIDE).ceil().max(1.0) as usize;
    let area = (stride * stride) as f64;
    let (columns, rows) = (low.x as u32..high.x.ceil() as u32, low.y as u32..high.y.ceil() as u32);
    for row in rows.step_by(stride) {
        for column in columns.clone().step_by(stride) {
            let pixel = row as usize * picture.width as usize + column as usize;
            if picture.instance[pixel] == actor.id + 1 {
                sight.seen += area;
                continue;
            }
            let i = &camera.intrinsics;
            let centre = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
            let ray = DVec3::new((centre.x - i.cx) / i.fx, (centre.y - i.cy) / i.fy, 1.0);
            let entry = entry_depth(&actor.world_box, &box_from_cam, ray);
            if entry.is_some_and(|entry| f64::from(picture.depth[pixel]) < entry) {
                sight.hidden += area;
            }
        }
    }
    sight
}

/// Pixels that can show the box, clipped to the picture; `None` if there are none.
fn pixel_bounds(world_box: &Box3d, camera: &Camera, cam_from_world: &Rigid) -> Option<(DVec2, DVec2)> {
    let corners = world_box.corners().map(|corner| *cam_from_world * corner);
    let size = DVec2::new(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height));
    if corners.iter().all(|corner| corner.z < NEAR_M) {
        return None;
    }
    if corners.iter().any(|corner| corner.z < NEAR_M) {
        return Some((DVec2::ZERO, size));
    }
    let pixels = corners.iter().filter_map(|corner| camera.project(*corner));
    let (low, high) = pixels.fold((DVec2::INFINITY, DVec2::NEG_INFINITY), |(a, b), p| (a.min(p), b.max(p)));
    let (low, high) = (low.max(DVec2::ZERO), high.min(size));
    low.cmplt(high).all().then_some((low, high))
}

/// Depth at which a ray from the camera (z = 1 per unit) enters the box.
fn entry_depth(world_box: &Box3d, box_from_cam: &Rigid, ray: DVec3) -> Option<f64> {
    let origin = box_from_cam.translation;
    let direction = box_from_cam.transform_vector(ray);
    let half = world_box.size * 0.5;
    let (mut enter, mut leave) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        // A ray parallel to a pair of faces gives infinities of the right signs, or NaN on the face itself, which `max` ignores.
        let (a, b) = ((-half[axis] - origin[axis]) / direction[axis], (half[axis] - origin[axis]) / direction[axis]);
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    (enter < leave).then_some(enter)
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::{Intrinsics, Lens};
    use world::ActorClass;

    fn scene(instance_of: impl Fn(u32) -> u32, depth: f32) -> Sight {
        let intrinsics = Intrinsics { fx: 50.0, fy: 50.0, cx: 50.0, cy: 50.0, width: 100, height: 100 };
        let camera = Camera::new(intrinsics, Lens::Pinhole).unwrap();
        // Looking along world z: a cube of 2 m whose front face lies 9 m ahead, 11 pixels wide.
        let actor = ActorState {
            id: 4,
            class: ActorClass::Car,
            world_box: Box3d { center: DVec3::new(0.0, 0.0, 10.0), size: DVec3::splat(2.0), yaw: 0.0 },
            velocity: DVec2::ZERO,
            parked: true,
            with_rider: false,
        };
        let picture = Rendering {
            width: 100,
            height: 100,
            rgb: vec![0; 30_000],
            depth: vec![depth; 10_000],
            semantic: vec![0; 10_000],
            instance: (0..10_000).map(|i| instance_of(i % 100)).collect(),
        };
        look(&[actor], &camera, &Rigid::IDENTITY, &picture, 80.0).remove(&4).unwrap_or_default()
    }

    #[test]
    fn levels_follow_the_visible_share() {
        assert_eq!(scene(|_| 5, 9.0).token(), "4");
        assert_eq!(scene(|column| if column < 50 { 5 } else { 9 }, 3.0).token(), "2");
        assert_eq!(scene(|_| 9, 3.0).token(), "1");
        // Nothing of it, but nothing in front of it either: the box is empty there.
        assert_eq!(scene(|_| 0, 50.0), Sight::default());
    }
}
