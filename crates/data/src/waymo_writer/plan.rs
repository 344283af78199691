//! Which frames become which segment, and whether the layout can hold them.

use std::collections::BTreeMap;

use geometry::{Lens, RigCamera};

use super::config::WaymoWriterConfig;
use crate::staging::check_names;
use crate::waymo::raw::HALF_TURN_US;
use crate::{DataError, SceneFrame};

/// One segment to write.
#[derive(Debug)]
pub(super) struct Scene<'a> {
    pub name: &'a str,
    pub frames: &'a [SceneFrame],
    /// Native stamps of the frames, µs, ascending.
    pub micros: Vec<i64>,
    /// The rig by camera number.
    pub cameras: BTreeMap<i8, RigCamera>,
    pub annotated: bool,
}

/// # Errors
/// [`DataError::Config`], naming the scene.
pub(super) fn plan<'a>(config: &WaymoWriterConfig, frames: &'a [SceneFrame]) -> Result<Vec<Scene<'a>>, DataError> {
    let groups = frames.chunk_by(|a, b| a.id.scene == b.id.scene);
    let scenes = groups.map(|frames| scene(config, frames)).collect::<Result<Vec<_>, _>>()?;
    if scenes.is_empty() {
        return Err(DataError::Config("there are no frames to write".to_owned()));
    }
    check_names("scene name", &scenes.iter().map(|scene| scene.name.to_owned()).collect::<Vec<_>>())?;
    Ok(scenes)
}

fn scene<'a>(config: &WaymoWriterConfig, frames: &'a [SceneFrame]) -> Result<Scene<'a>, DataError> {
    let name = frames.first().map_or("", |frame| frame.id.scene.as_str());
    let refuse = |what: String| Err(DataError::Config(format!("scene {name} {what}")));
    let micros: Vec<i64> = frames.iter().map(|frame| frame.timestamp_ns.div_euclid(1000) - HALF_TURN_US).collect();
    if let Some(at) = micros.windows(2).position(|pair| pair[1] <= pair[0]) {
        return refuse(format!("has frames that are not a microsecond apart or out of order, from frame {at} on"));
    }
    let annotated = frames.iter().filter(|frame| frame.boxes.is_some()).count();
    if annotated != 0 && annotated != frames.len() {
        return refuse(format!("is annotated in {annotated} of {} frames; the layout cannot say which", frames.len()));
    }
    let mut cameras: BTreeMap<i8, RigCamera> = BTreeMap::new();
    for camera in frames.iter().flat_map(|frame| frame.views.iter().map(crate::View::rig_camera)) {
        let number = config.camera(&camera.channel)?;
        if matches!(camera.lens, Lens::KannalaBrandt { .. }) {
            return refuse(format!("has a fisheye, {}; the layout holds Brown-Conrady lenses only", camera.channel));
        }
        match cameras.get(&number) {
            None => _ = cameras.insert(number, camera),
            Some(known) if *known == camera => {}
            Some(known) if known.channel == camera.channel => {
                return refuse(format!("changes the calibration of {} under way", camera.channel));
            }
            Some(known) => return refuse(format!("gives {} and {} one camera", known.channel, camera.channel)),
        }
    }
    if cameras.is_empty() {
        return refuse("has no cameras".to_owned());
    }
    Ok(Scene { name, frames, micros, cameras, annotated: annotated > 0 })
}
