//! The vehicles of a dataset: cameras around the car, and whether their numbers can be those of a car.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};

use geometry::glam::DVec3;
use geometry::{CameraRig, GeometryError, Lens, RigCamera};
use serde::Serialize;

use super::frames::FrameFacts;

/// Largest angle between the front camera's axis and the car's, degrees.
const MOST_FRONT_DEG: f64 = 5.0;
/// Where cameras of road vehicles are mounted, metres in ego (lorries included).
const LOWEST: DVec3 = DVec3::new(-4.0, -1.6, 0.2);
const HIGHEST: DVec3 = DVec3::new(6.0, 1.6, 4.0);
/// Horizontal angles of view of driving cameras, degrees.
const FOV_DEG: [f64; 2] = [15.0, 220.0];

/// Vehicles with the same cameras: channels, picture sizes and kinds of lens.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RigReport {
    /// Frames with these cameras.
    pub frames: usize,
    /// Scenes with these cameras.
    pub scenes: usize,
    /// Different sets of calibration numbers among them.
    pub calibrations: usize,
    /// True when neighbouring views overlap all the way around the car.
    pub closed: bool,
    /// In rig order: a closed ring clockwise from the front, an open chain from its left to its right end. Numbers of the first
    /// calibration.
    pub cameras: Vec<CameraReport>,
}

/// One camera on the car.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraReport {
    /// The channel's name in its dataset.
    pub channel: String,
    /// Picture width, px.
    pub width: u32,
    /// Picture height, px.
    pub height: u32,
    /// `pinhole`, `brown_conrady` or `kannala_brandt`.
    pub lens: &'static str,
    /// Horizontal focal length, px.
    pub fx: f64,
    /// Vertical focal length, px.
    pub fy: f64,
    /// Direction of the optical axis, degrees from straight ahead, left positive.
    pub azimuth_deg: f64,
    /// Angle above the horizon, degrees.
    pub elevation_deg: f64,
    /// Horizontal angle of view with the lens's distortion, degrees.
    pub hfov_deg: f64,
    /// Overlap with the next camera clockwise, degrees; negative for a gap. `None` for a camera alone.
    pub overlap_deg: Option<f64>,
    /// Optical centre, metres in ego.
    pub position_m: [f64; 3],
}

/// What tells rigs apart in a report.
type Family = Vec<(String, u32, u32, &'static str)>;

#[derive(Debug)]
struct Seen {
    first: CameraRig,
    frames: usize,
    scenes: BTreeSet<usize>,
    calibrations: BTreeSet<u64>,
}

/// The rigs met so far.
#[derive(Debug, Default)]
pub(super) struct Rigs {
    order: Vec<Family>,
    seen: BTreeMap<Family, Seen>,
    warnings: Warnings,
}

/// Each text once, with the number of calibrations it was said of.
#[derive(Debug, Default)]
struct Warnings(Vec<(String, usize, String)>);

impl Warnings {
    /// `what` groups, `example` is shown of the first.
    fn add(&mut self, what: String, example: String) {
        match self.0.iter_mut().find(|known| known.0 == what) {
            Some(known) => known.1 += 1,
            None => self.0.push((what, 1, example)),
        }
    }
}

impl Rigs {
    pub(super) fn add(&mut self, facts: &FrameFacts, scene: usize) {
        let rig = &facts.rig;
        let family: Family = rig
            .cameras
            .iter()
            .map(|c| (c.channel.clone(), c.intrinsics.width, c.intrinsics.height, lens_name(&c.lens)))
            .collect();
        if !self.seen.contains_key(&family) {
            self.order.push(family.clone());
        }
        let seen = self.seen.entry(family).or_insert_with(|| Seen {
            first: rig.clone(),
            frames: 0,
            scenes: BTreeSet::new(),
            calibrations: BTreeSet::new(),
        });
        seen.frames += 1;
        seen.scenes.insert(scene);
        if seen.calibrations.insert(fingerprint(rig)) {
            judge(rig, &mut self.warnings);
        }
    }

    /// The rigs in order of their first frame, and what is odd about them.
    pub(super) fn finish(self) -> (Vec<RigReport>, Vec<String>) {
        let mut warnings: Vec<String> = self
            .warnings
            .0
            .into_iter()
            .map(|(what, count, example)| match count {
                1 => format!("{what}: {example}"),
                _ => format!("{what} in {count} calibrations, first {example}"),
            })
            .collect();
        let mut reports = Vec::new();
        for seen in self.order.iter().filter_map(|family| self.seen.get(family)) {
            match report(seen) {
                Ok(report) => reports.push(report),
                Err(error) => warnings.push(format!("a rig whose views cannot be ordered: {error}")),
            }
        }
        (reports, warnings)
    }
}

fn lens_name(lens: &Lens) -> &'static str {
    match lens {
        Lens::Pinhole => "pinhole",
        Lens::BrownConrady { .. } => "brown_conrady",
        Lens::KannalaBrandt { .. } => "kannala_brandt",
    }
}

/// The same for equal numbers.
fn fingerprint(rig: &CameraRig) -> u64 {
    let mut hasher = DefaultHasher::new();
    for camera in &rig.cameras {
        let (i, pose) = (camera.intrinsics, camera.ego_from_cam);
        let lens: Vec<f64> = match camera.lens {
            Lens::Pinhole => Vec::new(),
            Lens::BrownConrady { k, p } => [&k[..], &p[..]].concat(),
            Lens::KannalaBrandt { k } => k.to_vec(),
        };
        let numbers = [i.fx, i.fy, i.cx, i.cy].into_iter().chain(pose.translation.to_array()).chain(pose.wxyz());
        numbers.chain(lens).for_each(|number| number.to_bits().hash(&mut hasher));
    }
    hasher.finish()
}

fn report(seen: &Seen) -> Result<RigReport, GeometryError> {
    let rig = &seen.first;
    let order = rig.rig_order()?;
    let next = order.iter().cycle().skip(1);
    let mut cameras = Vec::with_capacity(order.len());
    for (at, next) in order.iter().zip(next) {
        let Some(camera) = rig.cameras.get(*at) else { continue };
        let overlap = if order.len() > 1 { Some(rig.overlap(*at, *next)?.to_degrees()) } else { None };
        cameras.push(camera_report(camera, overlap)?);
    }
    Ok(RigReport {
        frames: seen.frames,
        scenes: seen.scenes.len(),
        calibrations: seen.calibrations.len(),
        closed: rig.adjacency()?.closed,
        cameras,
    })
}

fn camera_report(camera: &RigCamera, overlap_deg: Option<f64>) -> Result<CameraReport, GeometryError> {
    let (left, right) = camera.horizontal_span()?;
    let i = camera.intrinsics;
    Ok(CameraReport {
        channel: camera.channel.clone(),
        width: i.width,
        height: i.height,
        lens: lens_name(&camera.lens),
        fx: i.fx,
        fy: i.fy,
        azimuth_deg: camera.azimuth().to_degrees(),
        elevation_deg: axis(camera).z.clamp(-1.0, 1.0).asin().to_degrees(),
        hfov_deg: (left - right).to_degrees(),
        overlap_deg,
        position_m: camera.ego_from_cam.translation.to_array(),
    })
}

fn axis(camera: &RigCamera) -> DVec3 {
    camera.ego_from_cam.transform_vector(DVec3::Z)
}

/// Says what no car has. None of it stops a run: made rigs may look where they like.
fn judge(rig: &CameraRig, warnings: &mut Warnings) {
    let turn = |camera: &RigCamera| axis(camera).x.clamp(-1.0, 1.0).acos().to_degrees();
    let front = rig.cameras.iter().min_by(|a, b| turn(a).total_cmp(&turn(b)));
    if let Some(front) = front.filter(|front| turn(front) > MOST_FRONT_DEG) {
        let text = format!("{} looks {:.1}° beside the car's x axis", front.channel, turn(front));
        warnings.add("no camera looks straight ahead".to_owned(), text);
    }
    for camera in &rig.cameras {
        let mut odd = |what: &str, text: String| warnings.add(format!("{}: {what}", camera.channel), text);
        let (at, i) = (camera.ego_from_cam.translation, camera.intrinsics);
        if at.cmplt(LOWEST).any() || at.cmpgt(HIGHEST).any() {
            odd("stands outside a car", format!("at x {:.2}, y {:.2}, z {:.2} m in ego", at.x, at.y, at.z));
        }
        let down = camera.ego_from_cam.transform_vector(DVec3::Y).z;
        if down > -0.5 {
            odd("does not stand upright", format!("its picture rows run along z {down:.2} of the car instead of -1"));
        }
        let fov = camera.horizontal_span().map_or(0.0, |(left, right)| (left - right).to_degrees());
        if !(FOV_DEG[0]..=FOV_DEG[1]).contains(&fov) {
            odd("strange angle of view", format!("{fov:.1}° with fx {:.1} px at {} px width", i.fx, i.width));
        }
        if !(0.8..=1.25).contains(&(i.fx.abs() / i.fy.abs())) {
            odd("focal lengths differ", format!("fx {:.1}, fy {:.1} px", i.fx, i.fy));
        }
        let inside = (0.0..=f64::from(i.width)).contains(&i.cx) && (0.0..=f64::from(i.height)).contains(&i.cy);
        if !inside {
            odd("principal point outside the picture", format!("({:.1}, {:.1}) px", i.cx, i.cy));
        }
    }
}
