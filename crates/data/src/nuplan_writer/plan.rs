//! One log before anything is written: its frames in time order, its cameras, its pictures; and whether a reader could tell the frames apart.

use std::collections::BTreeMap;

use geometry::{Lens, RigCamera, Rigid};
use sha2::{Digest, Sha256};

use super::config::NuPlanWriterConfig;
use crate::nuplan::{Token, assign_lidar, default_box_window_ms, default_pairing_window_ms, pair, usual_name};
use crate::nuscenes_writer::scaled;
use crate::staging::check_names;
use crate::{DataError, SceneFrame, View};

/// Easting and northing that a UTM zone can hold, metres.
const UTM_EAST_M: std::ops::RangeInclusive<f64> = 0.0..=1_000_000.0;
const UTM_NORTH_M: std::ops::RangeInclusive<f64> = 0.0..=10_000_000.0;

/// A frame with its place in the log.
#[derive(Debug)]
pub(super) struct PlannedFrame<'a> {
    pub frame: &'a SceneFrame,
    pub time_us: i64,
    pub utm_from_ego: Rigid,
    /// Its lidar turn; a frame without boxes in a log that has some gets none, because a turn without boxes means that nothing is there.
    pub lidar: Option<Token>,
}

/// A row of the `image` table.
#[derive(Debug)]
pub(super) struct PlannedImage<'a> {
    pub token: Token,
    pub camera: usize,
    pub time_us: i64,
    pub frame: usize,
    pub view: &'a View,
    /// Below the folder of pictures.
    pub name: String,
}

/// One log.
#[derive(Debug)]
pub(super) struct Plan<'a> {
    pub name: String,
    pub frames: Vec<PlannedFrame<'a>>,
    /// As written: renamed and scaled.
    pub cameras: Vec<RigCamera>,
    /// In time order.
    pub images: Vec<PlannedImage<'a>>,
    pub annotated: bool,
}

/// Tokens that follow from the seed and a stable name.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tokens {
    pub seed: u64,
}

impl Tokens {
    pub fn of(self, table: &str, name: &str) -> Token {
        // The unit separator occurs in no name, so ("a", "bc") and ("ab", "c") differ.
        let digest: [u8; 32] = Sha256::digest(format!("rigscape/nuplan/{}\u{1f}{table}\u{1f}{name}", self.seed)).into();
        let mut token = [0; 8];
        token.iter_mut().zip(digest).for_each(|(to, from)| *to = from);
        Token(token)
    }

    /// The native token, if the text is one.
    pub fn kept(self, table: &str, text: &str, scope: &str) -> Token {
        Token::parse(text).unwrap_or_else(|| self.of(table, &format!("{scope}/{text}")))
    }
}

/// Microseconds, the layout's unit, rounded to the nearest.
fn micros(time_ns: i64) -> i64 {
    time_ns.saturating_add(500).div_euclid(1000)
}

/// The frames by log, logs in the order of their first frame.
pub(super) fn plan<'a>(frames: &'a [SceneFrame], config: &NuPlanWriterConfig) -> Result<Vec<Plan<'a>>, DataError> {
    let mut names: Vec<String> = Vec::new();
    let mut groups: BTreeMap<&str, Vec<&SceneFrame>> = BTreeMap::new();
    for frame in frames {
        let group = groups.entry(&frame.id.scene).or_default();
        match group.first() {
            None => names.push(frame.id.scene.clone()),
            Some(first) if first.id.dataset != frame.id.dataset => {
                let (one, other) = (&first.id.dataset, &frame.id.dataset);
                return refuse(format!("scene {} comes from {one} and from {other}", frame.id.scene));
            }
            Some(_) => {}
        }
        group.push(frame);
    }
    check_names("scene name", &names)?;
    names.into_iter().map(|name| plan_log(groups.remove(name.as_str()).unwrap_or_default(), name, config)).collect()
}

fn refuse<T>(text: String) -> Result<T, DataError> {
    Err(DataError::Config(text))
}

fn plan_log<'a>(
    mut group: Vec<&'a SceneFrame>,
    name: String,
    config: &NuPlanWriterConfig,
) -> Result<Plan<'a>, DataError> {
    group.sort_by_key(|frame| frame.timestamp_ns);
    let tokens = Tokens { seed: config.seed };
    let annotated = group.iter().any(|frame| frame.boxes.is_some());
    let mut plan = Plan { name, frames: Vec::new(), cameras: Vec::new(), images: Vec::new(), annotated };
    for frame in group {
        let time_us = micros(frame.timestamp_ns);
        let lidar = (frame.boxes.is_some() || !annotated)
            .then(|| tokens.kept("lidar_pc", &frame.id.frame, &format!("{}/{time_us}", plan.name)));
        let utm_from_ego = utm(&frame.world_from_ego, config, frame)?;
        plan.frames.push(PlannedFrame { frame, time_us, utm_from_ego, lidar });
        for view in &frame.views {
            let camera = plan.camera(view, frame, config)?;
            let (time_us, channel) = (micros(view.timestamp_ns), config.channel(&view.channel));
            let token = tokens.of("image", &format!("{}/{}/{channel}/{time_us}", plan.name, frame.id.frame));
            let file = usual_name(&plan.name, channel, token);
            plan.images.push(PlannedImage { token, camera, time_us, frame: plan.frames.len() - 1, view, name: file });
        }
    }
    plan.images.sort_by_key(|image| (image.time_us, image.camera));
    let channels: Vec<String> = plan.cameras.iter().map(|camera| camera.channel.clone()).collect();
    check_names("channel", &channels)?;
    plan.check_pairing()?;
    Ok(plan)
}

/// A pose moved into the UTM zone.
pub(super) fn utm(world_from_ego: &Rigid, config: &NuPlanWriterConfig, frame: &SceneFrame) -> Result<Rigid, DataError> {
    let [east, north] = config.utm_origin_m;
    let mut moved = *world_from_ego;
    moved.translation.x += east;
    moved.translation.y += north;
    let at = moved.translation;
    if UTM_EAST_M.contains(&at.x) && UTM_NORTH_M.contains(&at.y) && moved.rotation.is_finite() && at.z.is_finite() {
        return Ok(moved);
    }
    refuse(format!(
        "frame {} of {} lies at {at} m, outside every UTM zone; set utm_origin_m, to zero for poses that are UTM already",
        frame.id.frame, frame.id.scene
    ))
}

impl Plan<'_> {
    /// Position of a view's camera, which must be mounted and calibrated as in the frames before.
    fn camera(&mut self, view: &View, frame: &SceneFrame, config: &NuPlanWriterConfig) -> Result<usize, DataError> {
        let mut camera = view.rig_camera();
        camera.channel = config.channel(&view.channel).to_owned();
        if let Some(size) = config.image_size {
            camera.intrinsics = scaled(&camera.intrinsics, size);
        }
        let shown = || format!("camera {} in frame {} of {}", view.channel, frame.id.frame, frame.id.scene);
        if let Some(at) = self.cameras.iter().position(|known| known.channel == camera.channel) {
            if self.cameras.get(at) == Some(&camera) {
                return Ok(at);
            }
            return refuse(format!("{} has another calibration than before; the layout holds one per log", shown()));
        }
        if matches!(camera.lens, Lens::KannalaBrandt { .. }) {
            return refuse(format!("{} is a fisheye; the layout holds pinhole and Brown-Conrady lenses", shown()));
        }
        camera.camera().map_err(|error| DataError::Config(format!("{}: {error}", shown())))?;
        self.cameras.push(camera);
        Ok(self.cameras.len() - 1)
    }

    /// The layout names no frames: readers find them by time. Refuses what our reader, with its default windows, would group otherwise.
    fn check_pairing(&self) -> Result<(), DataError> {
        let rows: Vec<(usize, i64)> = self.images.iter().map(|image| (image.camera, image.time_us * 1000)).collect();
        let ns = |milliseconds: f64| (milliseconds * 1e6) as i64;
        let mut sets = pair(&rows, self.cameras.len(), ns(default_pairing_window_ms())).sets;
        let frames_of = |set: &crate::nuplan::Paired| -> Vec<usize> {
            set.pictures.iter().flatten().filter_map(|at| Some(self.images.get(*at)?.frame)).collect()
        };
        let mut seen = vec![0; self.frames.len()];
        for set in &sets {
            let frames = frames_of(set);
            let Some(first) = frames.first() else { continue };
            seen[*first] += 1;
            if frames.iter().any(|frame| frame != first) || seen[*first] > 1 {
                return self.indistinct(*first);
            }
        }
        let has_picture = |at: &usize| self.images.get(*at).is_some_and(|image| image.view.image.is_some());
        sets.retain(|set| set.pictures.iter().flatten().any(has_picture));
        let instants: Vec<i64> = sets.iter().map(|set| set.time_ns).collect();
        let turns: Vec<(i64, usize)> = self
            .frames
            .iter()
            .enumerate()
            .filter(|(_, frame)| frame.lidar.is_some())
            .map(|(at, frame)| (frame.time_us * 1000, at))
            .collect();
        let stamps: Vec<i64> = turns.iter().map(|turn| turn.0).collect();
        for (set, turn) in sets.iter().zip(assign_lidar(&instants, &stamps, ns(default_box_window_ms()))) {
            let Some(at) = frames_of(set).first().copied() else { continue };
            let own = self.frames.get(at).is_some_and(|frame| frame.lidar.is_some()).then_some(at);
            if turn.and_then(|turn| turns.get(turn)).map(|turn| turn.1) != own {
                return self.indistinct(at);
            }
        }
        Ok(())
    }

    fn indistinct(&self, frame: usize) -> Result<(), DataError> {
        let name = self.frames.get(frame).map_or("", |planned| planned.frame.id.frame.as_str());
        refuse(format!(
            "frame {name} of {} could not be told from its neighbours: the layout groups pictures by time, so frames must lie \
             further apart than {} ms, and a frame's instant no further than {} ms from the middle of its pictures",
            self.name,
            2.0 * default_pairing_window_ms(),
            default_box_window_ms()
        ))
    }
}
