//! From metres around the car to the pixels of a drawn picture, through the lens: straight lines become curves.

use data::View;
use geometry::glam::{DVec2, DVec3};
use geometry::{Camera, GeometryError, Rigid};

/// Longest piece of a line that is looked at as a whole, metres: finer than any part of it that a lens could show alone.
const STEP_M: f64 = 0.5;
/// Most pieces of one line.
const MOST_STEPS: usize = 400;
/// Halvings while looking for the end of what the lens shows.
const HALVINGS: usize = 24;
/// Largest deviation of a drawn piece from the true curve, px.
const FLATNESS_PX: f64 = 0.3;
/// Halvings of one piece.
const MOST_DEPTH: u32 = 8;

/// One camera and the size its picture is drawn at.
#[derive(Debug)]
pub(super) struct Projector {
    camera: Camera,
    cam_from_ego: Rigid,
    scale: DVec2,
}

impl Projector {
    /// `ego` is the frame's reference instant; the picture's own pose is respected.
    pub(super) fn new(view: &View, world_from_ego: &Rigid, drawn_px: DVec2) -> Result<Self, GeometryError> {
        let i = view.intrinsics;
        let scale = drawn_px / DVec2::new(f64::from(i.width), f64::from(i.height));
        let cam_from_ego = view.ref_ego_from_cam(world_from_ego).inverse();
        Ok(Self { camera: view.camera()?, cam_from_ego, scale })
    }

    /// The optical centre in ego.
    pub(super) fn center(&self) -> DVec3 {
        self.cam_from_ego.inverse().translation
    }

    /// A drawn pixel, perhaps outside the picture; `None` behind the camera and beyond the lens.
    pub(super) fn point(&self, ego: DVec3) -> Option<DVec2> {
        self.project(self.cam_from_ego * ego)
    }

    fn project(&self, cam: DVec3) -> Option<DVec2> {
        self.camera.project(cam).filter(|pixel| pixel.is_finite()).map(|pixel| pixel * self.scale)
    }

    /// The visible parts of a line through these points, each a row of pixels.
    pub(super) fn line(&self, ego: &[DVec3]) -> Vec<Vec<DVec2>> {
        let mut parts: Vec<Vec<DVec2>> = Vec::new();
        let mut open = false;
        for pair in ego.windows(2) {
            let [a, b] = pair else { continue };
            let (a, b) = (self.cam_from_ego * *a, self.cam_from_ego * *b);
            let steps = ((a.distance(b) / STEP_M).ceil() as usize).clamp(1, MOST_STEPS);
            for step in 0..steps {
                let at = |step: usize| a.lerp(b, step as f64 / steps as f64);
                open = self.piece(at(step), at(step + 1), open, &mut parts);
            }
        }
        parts
    }

    /// Adds a piece; true when its end is visible, so that the next piece goes on from it.
    fn piece(&self, a: DVec3, b: DVec3, open: bool, parts: &mut Vec<Vec<DVec2>>) -> bool {
        let (from, to) = (self.project(a), self.project(b));
        let (start, end) = match (from.is_some(), to.is_some()) {
            (false, false) => return false,
            (true, true) => (a, b),
            (true, false) => (a, self.last_visible(a, b)),
            (false, true) => (self.last_visible(b, a), b),
        };
        let (Some(from), Some(last)) = (self.project(start), self.project(end)) else { return false };
        if !(open && start == a) {
            parts.push(vec![from]);
        }
        if let Some(part) = parts.last_mut() {
            self.bend((start, from), (end, last), 0, part);
        }
        to.is_some()
    }

    /// The furthest visible point on the way from a visible to an invisible one.
    fn last_visible(&self, visible: DVec3, hidden: DVec3) -> DVec3 {
        let (mut near, mut far) = (0.0, 1.0);
        for _ in 0..HALVINGS {
            let middle = 0.5 * (near + far);
            if self.project(visible.lerp(hidden, middle)).is_some() { near = middle } else { far = middle }
        }
        visible.lerp(hidden, near)
    }

    /// Points behind the start up to the end, as many as the curve needs.
    fn bend(&self, start: (DVec3, DVec2), end: (DVec3, DVec2), depth: u32, out: &mut Vec<DVec2>) {
        let middle = start.0.lerp(end.0, 0.5);
        match self.project(middle) {
            Some(pixel) if depth < MOST_DEPTH && off_line(pixel, start.1, end.1) > FLATNESS_PX => {
                self.bend(start, (middle, pixel), depth + 1, out);
                self.bend((middle, pixel), end, depth + 1, out);
            }
            _ => out.push(end.1),
        }
    }
}

/// Distance of a point from the line through two others.
fn off_line(point: DVec2, a: DVec2, b: DVec2) -> f64 {
    let way = b - a;
    match way.try_normalize() {
        Some(along) => (point - a).perp_dot(along).abs(),
        None => (point - a).length(),
    }
}

#[cfg(test)]
mod tests {
    use geometry::{RigCamera, RigPreset};

    use super::*;

    /// The first camera of a rig on a car that moved `ahead_m` since the reference instant.
    fn projector(preset: RigPreset, ahead_m: f64) -> (Projector, RigCamera) {
        let camera = preset.rig().cameras.swap_remove(0);
        let world_from_ego = Rigid::from_yaw(0.7, DVec3::new(5e5, 4e6, 10.0));
        let view = View::of_camera(&camera, world_from_ego * Rigid::from_yaw(0.0, DVec3::new(ahead_m, 0.0, 0.0)));
        let drawn = DVec2::new(f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height)) * 0.5;
        (Projector::new(&view, &world_from_ego, drawn).unwrap(), camera)
    }

    #[test]
    fn the_pose_of_the_picture_counts() {
        let (still, camera) = projector(RigPreset::NuScenes, 0.0);
        let (moved, _) = projector(RigPreset::NuScenes, 0.4);
        let point = DVec3::new(12.0, 2.0, 0.0);
        let pixel = still.point(point).unwrap();
        let raw = camera.camera().unwrap().project(camera.ego_from_cam.inverse() * point).unwrap();
        assert!((pixel - 0.5 * raw).length() < 1e-5, "{pixel} {raw}");
        let nearer = moved.point(point).unwrap();
        assert!((nearer - still.point(point - DVec3::new(0.4, 0.0, 0.0)).unwrap()).length() < 1e-5);
        assert!((nearer - pixel).length() > 3.0);
        assert!((moved.center() - (camera.ego_from_cam.translation + DVec3::new(0.4, 0.0, 0.0))).length() < 1e-6);
    }

    #[test]
    fn lines_end_at_the_camera_plane_and_never_come_from_behind() {
        let (projector, _) = projector(RigPreset::NuScenes, 0.0);
        let parts = projector.line(&[DVec3::new(-30.0, 2.0, 0.0), DVec3::new(30.0, 2.0, 0.0)]);
        assert_eq!(parts.len(), 1);
        // Left of the car: from far outside the lower left corner towards the vanishing point.
        assert!(parts[0][0].x < -1e3 && parts[0][0].y > 1e3, "{}", parts[0][0]);
        assert!(parts[0].windows(2).all(|pair| pair[1].x >= pair[0].x && pair[1].y <= pair[0].y));
        assert!(projector.line(&[DVec3::new(-30.0, 2.0, 0.0), DVec3::new(-3.0, 2.0, 0.0)]).is_empty());
        let around = [DVec3::new(8.0, 1.0, 0.0), DVec3::new(-8.0, 1.0, 0.0), DVec3::new(9.0, -1.0, 0.0)];
        assert_eq!(projector.line(&around).len(), 2);
    }

    #[test]
    fn lines_bend_with_the_lens() {
        for (preset, bends) in
            [(RigPreset::NuScenes, false), (RigPreset::NuPlan, true), (RigPreset::WayveScenes101, true)]
        {
            let (projector, _) = projector(preset, 0.0);
            let (a, b) = (DVec3::new(9.0, -4.0, 3.5), DVec3::new(9.0, 4.0, 3.5));
            let parts = projector.line(&[a, b]);
            assert_eq!(parts.len(), 1, "{preset:?}");
            let (first, last) = (parts[0][0], parts[0][parts[0].len() - 1]);
            let bow = parts[0].iter().map(|point| off_line(*point, first, last)).fold(0.0, f64::max);
            assert_eq!(bow > 3.0, bends, "{preset:?} {bow}");
            for share in [0.1, 0.37, 0.5, 0.93] {
                let pixel = projector.point(a.lerp(b, share)).unwrap();
                let off = |pair: &[DVec2]| off_line(pixel, pair[0], pair[1]);
                let near = parts[0].windows(2).filter(|pair| (pair[0].x - pixel.x) * (pair[1].x - pixel.x) <= 0.0);
                assert!(near.map(off).fold(f64::INFINITY, f64::min) < 2.0 * FLATNESS_PX, "{preset:?}");
            }
        }
    }

    #[test]
    fn what_only_passes_through_the_view_is_drawn() {
        let (projector, _) = projector(RigPreset::NuPlan, 0.0);
        let parts = projector.line(&[DVec3::new(5.0, -60.0, 0.0), DVec3::new(5.0, 60.0, 0.0)]);
        assert_eq!(parts.len(), 1);
        assert!(parts[0].len() > 4);
    }
}
