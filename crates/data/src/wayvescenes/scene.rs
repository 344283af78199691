//! One scene: its COLMAP model turned into views on a car.

use std::collections::{BTreeMap, BTreeSet};

use geometry::{CameraRig, Intrinsics, Lens, RigCamera, Rigid};

use super::config::WayveScenesConfig;
use super::rig::{Measured, measure};
use super::scale::Baselines;
use super::sets::{self, Picture, Set};
use super::{REFERENCE_CHANNEL, metadata::Metadata};
use crate::store::Store;
use crate::{DataError, FrameId, ImageSource, SceneFrame, View, colmap};

/// Where a scene keeps its model.
pub(crate) const MODEL_FOLDER: &str = "colmap_sparse/rig";

/// A camera of a scene's rig.
#[derive(Debug)]
struct Slot {
    channel: String,
    /// Of its first picture, for sets in which it has none.
    intrinsics: Intrinsics,
    lens: Lens,
    ego_from_cam: Rigid,
    has_masks: bool,
}

/// The pictures of one instant.
#[derive(Debug)]
struct Instant {
    /// Stamp of the forward camera's picture, else of the first one, as in its name.
    name: String,
    time_ns: i64,
    world_from_ego: Rigid,
    /// One entry per slot.
    pictures: Vec<Option<Picture>>,
}

/// A scene with everything but its pixels.
#[derive(Debug)]
pub(super) struct Scene {
    pub name: String,
    pub measured: Measured,
    text: Option<String>,
    /// Chosen cameras, clockwise from the front.
    slots: Vec<Slot>,
    instants: Vec<Instant>,
}

impl Scene {
    /// Reads the model of a scene and lists its masks. No picture is opened.
    pub fn read(
        store: &Store,
        name: &str,
        config: &WayveScenesConfig,
        baselines: &Baselines,
        metadata: &Metadata,
    ) -> Result<Self, DataError> {
        let folder = format!("{name}/{MODEL_FOLDER}");
        let model = colmap::Model::read(store, &folder, colmap::Detail::WithoutTracks)?;
        let path = store.path(&format!("{folder}/images.bin"));
        let pictures = sets::pictures(&model, config.time_unit, &path)?;
        let sets = sets::sets(&pictures, (config.pairing_window_ms * 1e6) as i64);
        let measured = measure(&sets, &model.points, config.scale, baselines, &path)?;
        if measured.ground_points.is_none() {
            let height = measured.camera_height_m;
            tracing::warn!("{name} shows no ground; its forward camera is taken to be {height} m above it");
        }
        let masks = if config.masks { mask_folders(store, name)? } else { BTreeSet::new() };
        let slots = slots(&pictures, &measured, config, &masks);
        let mut scene =
            Self { name: name.to_owned(), text: metadata.text(name), instants: Vec::new(), slots, measured };
        let instants = sets.iter().filter_map(|set| scene.instant(set));
        let excluded = |instant: &Instant| config.exclude.contains(&format!("{name}/{}", instant.name));
        scene.instants = instants
            .filter(|instant| !config.require_all_views || instant.pictures.iter().all(Option::is_some))
            .filter(|instant| !excluded(instant))
            .collect();
        Ok(scene)
    }

    /// `None` for a set without a chosen camera.
    fn instant(&self, set: &Set) -> Option<Instant> {
        let (channel, anchor) = set.get_key_value(REFERENCE_CHANNEL).or_else(|| set.first_key_value())?;
        let ego_from_cam = self.measured.ego_from_cam.get(channel)?;
        let metric = |picture: &Picture| Picture {
            world_from_cam: self.measured.upright_metric(&picture.world_from_cam),
            ..picture.clone()
        };
        let pictures: Vec<Option<Picture>> = self.slots.iter().map(|slot| set.get(&slot.channel).map(metric)).collect();
        pictures.iter().any(Option::is_some).then(|| Instant {
            name: anchor.stamp.clone(),
            time_ns: anchor.time_ns,
            world_from_ego: metric(anchor).world_from_cam * ego_from_cam.inverse(),
            pictures,
        })
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.instants.len()
    }

    /// Number of views of each frame.
    pub fn views(&self) -> usize {
        self.slots.len()
    }

    /// Whether any chosen camera has masks.
    pub fn has_masks(&self) -> bool {
        self.slots.iter().any(|slot| slot.has_masks)
    }

    /// A frame; `None` beyond the last.
    pub fn frame(&self, store: &Store, dataset: &str, index: usize) -> Option<SceneFrame> {
        let instant = self.instants.get(index)?;
        let views = self.slots.iter().zip(&instant.pictures);
        Some(SceneFrame {
            id: FrameId { dataset: dataset.to_owned(), scene: self.name.clone(), frame: instant.name.clone() },
            timestamp_ns: instant.time_ns,
            world_from_ego: instant.world_from_ego,
            views: views.map(|(slot, picture)| self.view(store, slot, picture.as_ref(), instant)).collect(),
            boxes: None,
            scene_text: self.text.clone(),
        })
    }

    fn view(&self, store: &Store, slot: &Slot, picture: Option<&Picture>, instant: &Instant) -> View {
        let intrinsics = picture.map_or(slot.intrinsics, |picture| picture.intrinsics);
        let source = |path: String| ImageSource::File {
            file: store.expected(&path),
            size: (intrinsics.width, intrinsics.height),
        };
        let mask = picture.filter(|_| slot.has_masks);
        View {
            channel: slot.channel.clone(),
            timestamp_ns: picture.map_or(instant.time_ns, |picture| picture.time_ns),
            image: picture.map(|picture| source(format!("{}/images/{}", self.name, picture.name))),
            mask: mask.map(|picture| source(format!("{}/masks/{}/{}.png", self.name, slot.channel, picture.stamp))),
            intrinsics,
            lens: picture.map_or(slot.lens, |picture| picture.lens),
            ego_from_cam: slot.ego_from_cam,
            world_from_ego: picture
                .map_or(instant.world_from_ego, |picture| picture.world_from_cam * slot.ego_from_cam.inverse()),
        }
    }
}

/// Cameras that have a folder of masks; such a camera must have one for every picture.
fn mask_folders(store: &Store, scene: &str) -> Result<BTreeSet<String>, DataError> {
    let listed = store.list(&format!("{scene}/masks"))?;
    Ok(listed.into_iter().filter(|entry| entry.is_folder).map(|entry| entry.name).collect())
}

/// The chosen cameras, in the order of the whole rig.
fn slots(
    pictures: &BTreeMap<String, Vec<Picture>>,
    measured: &Measured,
    config: &WayveScenesConfig,
    masks: &BTreeSet<String>,
) -> Vec<Slot> {
    let first_picture = |(channel, rows): (&String, &Vec<Picture>)| {
        let (first, ego_from_cam) = (rows.first()?, *measured.ego_from_cam.get(channel)?);
        Some(RigCamera { channel: channel.clone(), intrinsics: first.intrinsics, lens: first.lens, ego_from_cam })
    };
    let rig = CameraRig { cameras: pictures.iter().filter_map(first_picture).collect() };
    let ordered = rig.clockwise_order().into_iter().filter_map(|at| rig.cameras.get(at));
    let chosen = ordered.filter(|camera| config.views.holds(&camera.channel));
    let slot = |camera: &RigCamera| Slot {
        channel: camera.channel.clone(),
        intrinsics: camera.intrinsics,
        lens: camera.lens,
        ego_from_cam: camera.ego_from_cam,
        has_masks: masks.contains(&camera.channel),
    };
    chosen.map(slot).collect()
}
