//! nuScenes: reader of the native tables.
//!
//! Every picture keeps its own ego pose and stamp, rigs are per scene, and cameras are ordered clockwise from the front by their
//! calibration. Channel names stay inside this folder. Format: <https://www.nuscenes.org/nuscenes#data-format>, as checked on real files.

mod annotations;
mod blocks;
mod boxes;
mod can_bus;
mod config;
mod expansions;
mod export;
mod json;
pub mod map;
mod occupancy;
mod pictures;
mod rows;
mod sets;
mod tables;
mod token;

use std::ops::Range;

use geometry::{CameraRig, GeometryError, Lens, PoseTrack, RigCamera, Rigid};

pub use crate::check::CheckReport;
pub use crate::taxonomy::ClassRule;
pub use boxes::WorldBox;
pub use can_bus::{CanBus, CanMessage, CanSignal, CanState};
pub use config::{BoxMode, FrameChoice, NuScenesConfig, PictureTime};
pub use export::{NewPictures, NuScenesExportConfig, NuScenesExportManifest, export_nuscenes};

use annotations::Annotations;
use expansions::Expansions;
use occupancy::Attached;
use pictures::Pictures;
use sets::{PictureSet, SceneRig, Slot};
use tables::Base;

use crate::{
    Capabilities, DataError, FrameId, FrameOutline, ImageSource, LocalMap, ObjectBox, ObjectClass, OccupancyGrid,
    SceneDataset, SceneFrame, View,
};

/// A lidar key row whose pose is further from its sample's stamp than this does not belong to that instant (interpolated tables).
const SAME_INSTANT_NS: i64 = 1_000_000;

/// An opened nuScenes-layout dataset. Tables are in memory, pictures are opened on demand.
#[derive(Debug)]
pub struct NuScenes {
    config: NuScenesConfig,
    base: Base,
    pictures: Pictures,
    annotations: Option<Annotations>,
    expansions: Expansions,
    occupancy: Option<Attached>,
    rigs: Vec<SceneRig>,
    sets: Vec<PictureSet>,
    ranges: Vec<Range<usize>>,
}

/// A scene of an opened dataset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneInfo {
    /// Name, as in the split lists.
    pub name: String,
    /// City district whose map it lies on.
    pub location: String,
    /// Recording it was cut from.
    pub logfile: String,
    /// Its frames.
    pub frames: Range<usize>,
}

impl NuScenes {
    /// Reads and checks the 13 tables of the chosen scenes. No picture is opened.
    ///
    /// # Errors
    /// Every broken table, with the file and the row: see [`DataError`]. A split without a scene in these tables is
    /// [`DataError::Empty`]; `all` may be empty.
    pub fn open(config: &NuScenesConfig) -> Result<Self, DataError> {
        config.checked()?;
        let occupancy = config.occupancy.as_ref().map(Attached::open).transpose()?;
        let base = tables::read_base(config)?;
        let (pictures, annotations) =
            rayon::join(|| pictures::read_pictures(config, &base), || annotations::read_annotations(config, &base));
        let (pictures, annotations) = (pictures?, annotations?);
        let (rigs, sets, ranges) = sets::group(config, &base, &pictures)?;
        let expansions = Expansions::find(&base.tables.store)?;
        let config = config.clone();
        Ok(Self { config, base, pictures, annotations, expansions, occupancy, rigs, sets, ranges })
    }

    /// Where it was opened.
    pub const fn roots(&self) -> &crate::store::Roots {
        &self.config.root
    }

    /// The scenes in frame order.
    pub fn scenes(&self) -> Vec<SceneInfo> {
        let info = |(scene, frames): (&tables::Scene, &Range<usize>)| SceneInfo {
            name: scene.name.to_string(),
            location: scene.location.to_string(),
            logfile: scene.logfile.to_string(),
            frames: frames.clone(),
        };
        self.base.scenes.iter().zip(&self.ranges).map(info).collect()
    }

    /// The boxes of a frame with their full rotation, in the world frame. `None`: not annotated.
    ///
    /// # Errors
    /// An index beyond the last frame.
    pub fn world_boxes(&self, index: usize) -> Result<Option<Vec<WorldBox>>, DataError> {
        let set = self.set(index)?;
        Ok(self.boxes_of(set, set.time_ns))
    }

    /// The boxes at the exposure of one picture by the official rule, which goes by the picture's sample: a key picture has the boxes
    /// of its sample, any other picture those between that sample and the one before. `None` without annotations or picture, and where `mode` defines none.
    ///
    /// # Errors
    /// An index beyond the last frame.
    pub fn picture_boxes(&self, index: usize, view: usize, mode: BoxMode) -> Result<Option<Vec<WorldBox>>, DataError> {
        let set = self.set(index)?;
        let picture = set.pictures.get(view).copied().flatten().map(|row| &self.pictures.rows[row as usize]);
        let (Some(annotations), Some(picture)) = (&self.annotations, picture) else { return Ok(None) };
        let sample = picture.sample as usize;
        if picture.is_key {
            return Ok(Some(boxes::at_sample(annotations, &self.base, sample)));
        }
        Ok(boxes::before_sample(annotations, &self.base, sample, picture.time_ns, mode))
    }

    fn set(&self, index: usize) -> Result<&PictureSet, DataError> {
        self.sets.get(index).ok_or_else(|| {
            DataError::Config(format!(
                "frame {index} of {} does not exist, there are {}",
                self.config.name,
                self.sets.len()
            ))
        })
    }

    fn boxes_of(&self, set: &PictureSet, time_ns: i64) -> Option<Vec<WorldBox>> {
        let annotations = self.annotations.as_ref()?;
        if let Some(sample) = set.sample {
            return Some(boxes::at_sample(annotations, &self.base, sample as usize));
        }
        let (after, mode) = self.sample_behind(set, time_ns)?;
        boxes::before_sample(annotations, &self.base, after, time_ns, mode)
    }

    /// The sample at or behind an instant between samples, and how to find boxes there; nothing is defined behind the last one.
    fn sample_behind(&self, set: &PictureSet, time_ns: i64) -> Option<(usize, BoxMode)> {
        let FrameChoice::AllPictures { boxes: mode, .. } = self.config.frames else { return None };
        let samples = self.base.scenes[set.scene as usize].samples.clone();
        let after =
            samples.start + self.base.samples[samples.clone()].partition_point(|sample| sample.time_ns < time_ns);
        (after < samples.end).then_some((after, mode))
    }

    /// Whether [`NuScenes::boxes_of`] gives a list.
    fn has_boxes(&self, set: &PictureSet, time_ns: i64) -> bool {
        let first = self.base.scenes[set.scene as usize].samples.start;
        let between =
            || self.sample_behind(set, time_ns).is_some_and(|(after, mode)| after > first || mode == BoxMode::Devkit);
        self.annotations.is_some() && (set.sample.is_some() || between())
    }

    fn rig_camera(&self, slot: &Slot, picture: Option<u32>) -> Result<RigCamera, DataError> {
        let picture = picture.map(|row| &self.pictures.rows[row as usize]);
        let (sensor, size) = picture.map_or((slot.sensor, slot.size), |picture| (picture.sensor, picture.size));
        let (intrinsics, ego_from_cam) = sets::intrinsics(&self.base, sensor, size)
            .ok_or_else(|| DataError::Config("a picture without a camera".to_owned()))?;
        let channel = self.base.channels[slot.channel as usize].to_string();
        Ok(RigCamera { channel, intrinsics, lens: Lens::Pinhole, ego_from_cam })
    }

    /// The car at an instant. Where no pose row follows (or precedes) within the allowed gap, the nearest row and its own stamp, so that
    /// stamp and pose always agree and nothing is extrapolated.
    fn pose_near(&self, scene: u32, time_ns: i64) -> Result<(i64, Rigid), DataError> {
        let rows = &self.rigs[scene as usize].pose_rows;
        let pose = |row: &u32| self.pictures.poses[*row as usize];
        let next = rows.partition_point(|row| pose(row).time_ns < time_ns);
        let around = &rows[next.saturating_sub(1)..(next + 1).min(rows.len())];
        let gap_ns = (self.config.max_pose_gap_ms * 1e6) as i64;
        let track =
            PoseTrack::new(around.iter().map(|row| (pose(row).time_ns, pose(row).world_from_ego)).collect(), gap_ns);
        track.at(time_ns).map(|world_from_ego| (time_ns, world_from_ego)).or_else(|source| {
            let nearest = around.iter().map(pose).min_by_key(|pose| (pose.time_ns - time_ns).abs());
            match nearest.filter(|pose| (pose.time_ns - time_ns).abs() <= gap_ns) {
                Some(pose) => Ok((pose.time_ns, pose.world_from_ego)),
                None => Err(self.no_pose(scene, source)),
            }
        })
    }

    fn no_pose(&self, scene: u32, source: GeometryError) -> DataError {
        let row = format!("of {}", self.base.scenes[scene as usize].name);
        DataError::Calibration { row, source, path: self.base.path("ego_pose") }
    }

    /// Reference instant and pose of a set: the lidar's own pose row at a sample, else between the rows around.
    fn reference(&self, set: &PictureSet) -> Result<(i64, Rigid), DataError> {
        let lidar = set.sample.and_then(|sample| self.pictures.lidar[sample as usize].as_ref());
        let lidar = lidar.map(|row| self.pictures.poses[row.pose as usize]);
        match lidar.filter(|pose| (pose.time_ns - set.time_ns).abs() <= SAME_INSTANT_NS) {
            Some(pose) => Ok((set.time_ns, pose.world_from_ego)),
            None => self.pose_near(set.scene, set.time_ns),
        }
    }

    fn view(&self, set: &PictureSet, slot: &Slot, picture: Option<u32>, reference: &Rigid) -> Result<View, DataError> {
        let RigCamera { channel, intrinsics, lens, ego_from_cam } = self.rig_camera(slot, picture)?;
        let picture = picture.map(|row| &self.pictures.rows[row as usize]);
        let (timestamp_ns, world_from_ego) = match picture {
            Some(picture) => (picture.time_ns, self.pictures.poses[picture.pose as usize].world_from_ego),
            // When it would have been taken; its pose only places the camera, so the reference pose serves where no row is near.
            None => {
                let expected_ns = set.time_ns + slot.offset_ns;
                (expected_ns, self.pose_near(set.scene, expected_ns).map_or(*reference, |found| found.1))
            }
        };
        let image = picture.map(|picture| ImageSource::File {
            file: self.base.tables.store.expected(&self.pictures.file_name(picture, &self.base)),
            size: picture.size,
        });
        Ok(View { channel, timestamp_ns, image, mask: None, intrinsics, lens, ego_from_cam, world_from_ego })
    }
}

/// Opens the tables, looks at every picture of every frame (existence, size, end) and decodes `decode` random pictures of each scene
/// completely.
///
/// # Errors
/// Broken tables and poses; broken pictures are listed in the report.
pub fn check(config: &NuScenesConfig, decode: usize) -> Result<CheckReport, DataError> {
    crate::check(&NuScenes::open(config)?, decode)
}

impl SceneDataset for NuScenes {
    fn len(&self) -> usize {
        self.sets.len()
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let set = self.set(index)?;
        let (timestamp_ns, world_from_ego) = self.reference(set)?;
        let slots = self.rigs[set.scene as usize].slots.iter().zip(&set.pictures);
        let views = slots.map(|(slot, picture)| self.view(set, slot, *picture, &world_from_ego));
        let boxes = self.boxes_of(set, timestamp_ns);
        let boxes = boxes.map(|boxes| boxes.iter().map(|b| b.in_ego(&world_from_ego)).collect::<Vec<ObjectBox>>());
        let scene = &self.base.scenes[set.scene as usize];
        Ok(SceneFrame {
            id: FrameId {
                dataset: self.config.name.clone(),
                scene: scene.name.to_string(),
                frame: set.name(&self.base),
            },
            timestamp_ns,
            world_from_ego,
            views: views.collect::<Result<_, _>>()?,
            boxes,
            scene_text: (!scene.description.is_empty()).then(|| scene.description.to_string()),
        })
    }

    fn outline(&self, index: usize) -> Result<FrameOutline, DataError> {
        let set = self.set(index)?;
        let (timestamp_ns, _) = self.reference(set)?;
        let slots = self.rigs[set.scene as usize].slots.iter().zip(&set.pictures);
        let cameras = slots.map(|(slot, picture)| self.rig_camera(slot, *picture)).collect::<Result<_, _>>()?;
        Ok(FrameOutline { timestamp_ns, rig: CameraRig { cameras }, annotated: self.has_boxes(set, timestamp_ns) })
    }

    fn box_classes(&self, index: usize) -> Result<Vec<ObjectClass>, DataError> {
        let set = self.set(index)?;
        let boxes = self.boxes_of(set, self.reference(set)?.0);
        Ok(boxes.into_iter().flatten().map(|found| found.class).collect())
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.ranges.clone()
    }

    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        self.map_around(index, half_m)
    }

    fn occupancy(&self, index: usize) -> Result<OccupancyGrid, DataError> {
        self.occupancy_of(self.set(index)?)
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities {
            boxes: self.annotations.is_some(),
            map: self.expansions.has_maps,
            occupancy: self.occupancy.is_some(),
            can_bus: self.expansions.has_can_bus,
            masks: false,
            text: true,
        }
    }

    fn max_views(&self) -> usize {
        self.rigs.iter().map(|rig| rig.slots.len()).max().unwrap_or(0)
    }
}
