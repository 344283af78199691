//! A scene's frames as a COLMAP model.

use std::collections::{BTreeMap, BTreeSet};

use geometry::{Camera, Rigid};

use super::config::WayveScenesWriterConfig;
use super::ground;
use crate::sample::in_frame;
use crate::wayvescenes::REFERENCE_CHANNEL;
use crate::{DataError, SceneFrame, View, colmap};

/// A picture to write.
#[derive(Debug)]
pub(super) struct Shot<'a> {
    pub(super) frame: &'a SceneFrame,
    /// Number of the frame in its scene.
    pub(super) frame_index: usize,
    pub(super) view: &'a View,
    /// Name of the camera in the layout.
    pub(super) channel: &'a str,
    /// The integer of its name.
    pub(super) stamp: i64,
    /// Metres.
    pub(super) world_from_cam: Rigid,
    pub(super) camera: Camera,
}

impl Shot<'_> {
    /// Below `images`.
    pub(super) fn name(&self) -> String {
        format!("{}/{}.jpeg", self.channel, self.stamp)
    }
}

/// All pictures of a scene; views without one are left out.
pub(super) fn shots<'a>(
    config: &'a WayveScenesWriterConfig,
    name: &str,
    frames: &[&'a SceneFrame],
) -> Result<Vec<Shot<'a>>, DataError> {
    let unit_ns = config.time_unit.nanoseconds().unwrap_or(1);
    let mut shots = Vec::new();
    let mut names = BTreeSet::new();
    for (frame_index, frame) in frames.iter().enumerate() {
        for view in frame.views.iter().filter(|view| view.image.is_some()) {
            let refuse =
                |why: String| in_frame(&frame.id, DataError::Config(format!("camera {}: {why}", view.channel)));
            let shot = Shot {
                frame,
                frame_index,
                view,
                channel: config.channel(&view.channel),
                stamp: view.timestamp_ns.div_euclid(unit_ns),
                world_from_cam: view.world_from_ego * view.ego_from_cam,
                camera: view.camera().map_err(|error| refuse(error.to_string()))?,
            };
            if shot.stamp < 0 {
                return Err(refuse(format!("the stamp {} ns cannot be written", view.timestamp_ns)));
            }
            if !names.insert(shot.name()) {
                return Err(refuse(format!("a second picture would be called {}", shot.name())));
            }
            shots.push(shot);
        }
    }
    if !shots.iter().any(|shot| shot.channel == REFERENCE_CHANNEL) {
        return Err(DataError::Config(format!(
            "scene {name} has no picture of {REFERENCE_CHANNEL}, which the layout needs; name one of its cameras so under `channels`"
        )));
    }
    Ok(shots)
}

/// Metres from the forward camera to the others: medians over the frames.
pub(super) fn distances(shots: &[Shot<'_>]) -> BTreeMap<String, f64> {
    let mut all: BTreeMap<String, Vec<f64>> = BTreeMap::new();
    for of_frame in shots.chunk_by(|a, b| a.frame_index == b.frame_index) {
        let Some(front) = of_frame.iter().find(|shot| shot.channel == REFERENCE_CHANNEL) else { continue };
        for shot in of_frame.iter().filter(|shot| shot.channel != REFERENCE_CHANNEL) {
            let distance = shot.world_from_cam.translation.distance(front.world_from_cam.translation);
            all.entry(shot.channel.to_owned()).or_default().push(distance);
        }
    }
    let median = |(channel, mut distances): (String, Vec<f64>)| {
        distances.sort_by(f64::total_cmp);
        Some((channel, crate::wayvescenes::median(&distances)?))
    };
    all.into_iter().filter_map(median).collect()
}

/// The sparse model: one camera per channel and calibration, one image per picture, points on the ground.
pub(super) fn model(config: &WayveScenesWriterConfig, shots: &[Shot<'_>]) -> Result<colmap::Model, DataError> {
    let mut model = colmap::Model::default();
    let mut camera_of: Vec<(&str, Camera)> = Vec::new();
    for (shot, id) in shots.iter().zip(1_u32..) {
        let key = (shot.channel, shot.camera);
        let known = camera_of.iter().position(|other| *other == key);
        if known.is_none() {
            camera_of.push(key);
            model.cameras.push(camera(shot, camera_of.len())?);
        }
        let camera_id = known.unwrap_or(camera_of.len() - 1) as u32 + 1;
        let cam_from_world = shot.world_from_cam.inverse();
        model.images.push(colmap::Image {
            id,
            rotation_wxyz: cam_from_world.wxyz(),
            translation: (cam_from_world.translation * config.units_per_metre).to_array(),
            camera_id,
            name: shot.name(),
            points: Vec::new(),
        });
    }
    ground::add_points(config, shots, &mut model);
    Ok(model)
}

fn camera(shot: &Shot<'_>, id: usize) -> Result<colmap::Camera, DataError> {
    let intrinsics = shot.camera.intrinsics;
    let model = colmap::CameraModel::of(&intrinsics, &shot.camera.lens).ok_or_else(|| {
        let why =
            format!("camera {} has a radial term of sixth order, which the layout's lenses lack", shot.view.channel);
        in_frame(&shot.frame.id, DataError::Config(why))
    })?;
    Ok(colmap::Camera { id: id as u32, width: intrinsics.width, height: intrinsics.height, model })
}
