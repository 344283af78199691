//! The procedural world as a dataset: any number of scenes, any rig, exact boxes, pictures rendered when asked for.
//!
//! Nothing is stored: a frame is a pure function of the seed. Training and held-out sets differ by their seed only.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;

use geometry::glam::DVec3;
use geometry::{BevGrid, CameraRig, RigPreset, Rigid};
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};
use world::{ActorState, MapAreaKind, MapLineKind, World, WorldConfig};

use crate::local_map::LocalMapBuilder;
use crate::occupancy::OCC3D_GRID;
use crate::procedural_cache::SceneCache;
use crate::seeding::{Purpose, rng};
use crate::{
    Capabilities, DataError, FrameId, FrameOutline, ImageSource, LocalMap, MapKind, ObjectBox, ObjectClass,
    OccupancyGrid, OccupancyLabels, SceneDataset, SceneFrame, View, read_rig,
};

/// Time stamp of the first scene's beginning; an arbitrary instant of 2020.
const EPOCH_NS: i64 = 1_600_000_000_000_000_000;
/// Time between the beginnings of two scenes; longer than any scene lasts.
const SCENE_SPACING_NS: i64 = 1_000_000_000_000;

/// Most cells of an occupancy grid: that of the finest published labels has 164 million.
const MOST_CELLS: usize = 1 << 28;

/// Where the cameras come from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RigSource {
    /// A known vehicle.
    Preset(RigPreset),
    /// A JSON file holding a [`CameraRig`].
    File(PathBuf),
    /// The cameras themselves.
    Cameras(CameraRig),
}

impl RigSource {
    /// The cameras.
    ///
    /// # Errors
    /// A file that is not there or holds no usable cameras.
    pub fn load(&self) -> Result<CameraRig, DataError> {
        match self {
            Self::Preset(preset) => Ok(preset.rig()),
            Self::File(path) => read_rig(path),
            Self::Cameras(rig) => Ok(rig.clone()),
        }
    }
}

/// Settings of a [`Procedural`] dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ProceduralConfig {
    /// Name of the dataset in batches and errors.
    pub name: String,
    /// Everything follows from it.
    pub seed: u64,
    /// Number of scenes.
    pub scenes: usize,
    /// Frames of each scene, spread evenly over its duration.
    pub frames_per_scene: usize,
    /// Cameras.
    pub rig: RigSource,
    /// Channels to keep, in the rig's order; empty keeps all.
    pub cameras: Vec<String>,
    /// Every frame's rig is turned about the car's vertical axis by an angle uniform in ± this many degrees.
    pub yaw_jitter_deg: f64,
    /// Worlds kept in memory, about half a megabyte each. A shuffled set of more scenes generates most worlds anew for every frame, which
    /// costs as much as rendering about three 64×64 views.
    pub cached_scenes: usize,
    /// Cells of the occupancy labels, in the ego frame; those of Occ3D by default.
    pub occupancy: BevGrid,
    /// What the worlds hold.
    pub world: WorldConfig,
}

impl Default for ProceduralConfig {
    fn default() -> Self {
        Self {
            name: "procedural".into(),
            seed: 0,
            scenes: 64,
            frames_per_scene: 16,
            rig: RigSource::Preset(RigPreset::NuScenes),
            cameras: Vec::new(),
            yaw_jitter_deg: 0.0,
            cached_scenes: 256,
            occupancy: OCC3D_GRID,
            world: WorldConfig::default(),
        }
    }
}

/// Scenes of the procedural world seen by one rig.
#[derive(Debug)]
pub struct Procedural {
    config: ProceduralConfig,
    rig: CameraRig,
    cache: SceneCache<World>,
}

impl Procedural {
    /// Reads the rig; worlds are generated when their frames are asked for.
    ///
    /// # Errors
    /// [`DataError::Config`] for numbers without a meaning and unknown channels; [`DataError::Missing`], [`DataError::Json`] or
    /// [`DataError::Calibration`] for the rig's file.
    pub fn open(config: &ProceduralConfig) -> Result<Self, DataError> {
        let refuse = |why: String| Err(DataError::Config(format!("dataset {}: {why}", config.name)));
        for (name, value) in [
            ("scenes", config.scenes),
            ("frames_per_scene", config.frames_per_scene),
            ("cached_scenes", config.cached_scenes),
        ] {
            if value == 0 {
                return refuse(format!("{name} must be at least 1"));
            }
        }
        if !(0.0..=180.0).contains(&config.yaw_jitter_deg) {
            return refuse(format!("yaw_jitter_deg must lie in 0..=180, but is {}", config.yaw_jitter_deg));
        }
        if let Err(error) = config.occupancy.checked() {
            return refuse(format!("occupancy: {error}"));
        }
        let cells = config.occupancy.cells.iter().try_fold(1usize, |count, cells| count.checked_mul(*cells));
        if cells.is_none_or(|cells| cells > MOST_CELLS) {
            return refuse(format!("occupancy has more than {MOST_CELLS} cells"));
        }
        let mut rig = config.rig.load()?;
        if let Some(unknown) = config.cameras.iter().find(|name| rig.cameras.iter().all(|c| c.channel != **name)) {
            let known: Vec<&str> = rig.cameras.iter().map(|c| c.channel.as_str()).collect();
            return refuse(format!("the rig has no camera {unknown:?}, only {}", known.join(", ")));
        }
        if !config.cameras.is_empty() {
            rig.cameras.retain(|camera| config.cameras.contains(&camera.channel));
        }
        Ok(Self { config: config.clone(), rig, cache: SceneCache::new(config.cached_scenes) })
    }

    /// The cameras, without jitter.
    pub fn rig(&self) -> &CameraRig {
        &self.rig
    }

    /// Scene of a frame and seconds since the scene's beginning.
    pub fn instant(&self, index: usize) -> (usize, f64) {
        let per_scene = self.config.frames_per_scene;
        let share = ((index % per_scene) as f64 + 0.5) / per_scene as f64;
        (index / per_scene, share * self.config.world.duration_secs)
    }

    /// The world of a scene: maps, occupancy and whatever else a frame does not carry.
    pub fn world(&self, scene: usize) -> Arc<World> {
        self.cache.get_or_make(scene, || {
            let seed = rng(self.config.seed, Purpose::Scene, scene as u64, 0).next_u64();
            World::generate(seed, &self.config.world)
        })
    }

    /// Scene, time and world of a frame.
    fn moment(&self, index: usize) -> Result<(usize, f64, Arc<World>), DataError> {
        self.check_index(index)?;
        let (scene, time_secs) = self.instant(index);
        Ok((scene, time_secs, self.world(scene)))
    }

    fn check_index(&self, index: usize) -> Result<(), DataError> {
        if index < self.len() {
            return Ok(());
        }
        let (name, len) = (&self.config.name, self.len());
        Err(DataError::Config(format!("dataset {name} has {len} frames; there is no frame {index}")))
    }

    fn timestamp_ns(&self, index: usize) -> i64 {
        let (scene, time_secs) = self.instant(index);
        EPOCH_NS + scene as i64 * SCENE_SPACING_NS + (time_secs * 1e9).round() as i64
    }

    fn frame_rig(&self, index: usize) -> CameraRig {
        let most = self.config.yaw_jitter_deg.to_radians();
        let yaw = rng(self.config.seed, Purpose::Frame, index as u64, 0).random_range(-1.0..=1.0) * most;
        if most == 0.0 { self.rig.clone() } else { self.rig.rotated(yaw) }
    }
}

impl SceneDataset for Procedural {
    fn len(&self) -> usize {
        self.config.scenes * self.config.frames_per_scene
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let (scene, time_secs, world) = self.moment(index)?;
        let world_from_ego = world.world_from_ego(time_secs);
        let timestamp_ns = self.timestamp_ns(index);
        let snapshot = Arc::new(world.snapshot(time_secs));
        let view = |mounted: geometry::RigCamera| {
            let camera = mounted.camera().map_err(|e| {
                DataError::Config(format!("dataset {}, camera {}: {e}", self.config.name, mounted.channel))
            })?;
            let world_from_cam = world_from_ego * mounted.ego_from_cam;
            Ok(View {
                channel: mounted.channel,
                timestamp_ns,
                image: Some(ImageSource::Rendered { snapshot: snapshot.clone(), camera, world_from_cam }),
                mask: None,
                intrinsics: mounted.intrinsics,
                lens: mounted.lens,
                ego_from_cam: mounted.ego_from_cam,
                world_from_ego,
            })
        };
        let ego_from_world = world_from_ego.inverse();
        Ok(SceneFrame {
            id: FrameId {
                dataset: self.config.name.clone(),
                scene: format!("scene-{scene:04}"),
                frame: format!("{:04}", index % self.config.frames_per_scene),
            },
            timestamp_ns,
            world_from_ego,
            views: self.frame_rig(index).cameras.into_iter().map(view).collect::<Result<_, DataError>>()?,
            boxes: Some(world.actors_at(time_secs).iter().map(|actor| object_box(actor, &ego_from_world)).collect()),
            scene_text: Some(world.caption()),
        })
    }

    fn outline(&self, index: usize) -> Result<FrameOutline, DataError> {
        self.check_index(index)?;
        Ok(FrameOutline { timestamp_ns: self.timestamp_ns(index), rig: self.frame_rig(index), annotated: true })
    }

    fn box_classes(&self, index: usize) -> Result<Vec<ObjectClass>, DataError> {
        self.check_index(index)?;
        let (scene, time_secs) = self.instant(index);
        Ok(self.world(scene).actors_at(time_secs).iter().map(shared_class).collect())
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        let per_scene = self.config.frames_per_scene;
        (0..self.config.scenes).map(|scene| scene * per_scene..(scene + 1) * per_scene).collect()
    }

    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        let (_, time_secs, world) = self.moment(index)?;
        let mut local = LocalMapBuilder::new(&world.world_from_ego(time_secs), half_m)?;
        for line in &world.map().lines {
            let kind = match line.kind {
                MapLineKind::RoadDivider | MapLineKind::LaneDivider => MapKind::Divider,
                MapLineKind::Boundary => MapKind::Boundary,
                MapLineKind::Centerline => MapKind::Centerline,
                MapLineKind::StopLine => MapKind::StopLine,
                MapLineKind::Crossing => MapKind::Crossing,
            };
            local.add_line(kind, line.points.iter().map(|point| point.extend(0.0)));
        }
        for area in &world.map().areas {
            let kind = match area.kind {
                MapAreaKind::DrivableArea => MapKind::Boundary,
                MapAreaKind::Crossing => MapKind::Crossing,
                MapAreaKind::Walkway => MapKind::Walkway,
                MapAreaKind::StopLine => MapKind::StopLine,
                MapAreaKind::Carpark => MapKind::Carpark,
                // Parts of the drivable area.
                MapAreaKind::RoadSegment | MapAreaKind::Intersection => continue,
            };
            local.add_area(kind, &area.outer, &area.holes);
        }
        Ok(local.finish())
    }

    /// Exact: everything is seen, so there are no masks.
    fn occupancy(&self, index: usize) -> Result<OccupancyGrid, DataError> {
        let (_, time_secs, world) = self.moment(index)?;
        let grid = self.config.occupancy;
        let labels = world.occupancy(time_secs, &world.world_from_ego(time_secs), &grid);
        OccupancyGrid::new(grid, Rigid::IDENTITY, OccupancyLabels::NuScenes, labels)
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    fn capabilities(&self) -> Capabilities {
        Capabilities { boxes: true, map: true, occupancy: true, text: true, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        self.rig.len()
    }
}

/// Both lists begin with the ten nuScenes detection classes, in the same order.
fn shared_class(actor: &ActorState) -> ObjectClass {
    ObjectClass::ALL[actor.class.index()]
}

fn object_box(actor: &ActorState, ego_from_world: &Rigid) -> ObjectBox {
    let velocity = ego_from_world.transform_vector(DVec3::new(actor.velocity.x, actor.velocity.y, 0.0));
    let attributes = [(actor.parked, "parked"), (actor.with_rider, "with_rider")];
    ObjectBox {
        box3d: actor.world_box.transformed(ego_from_world),
        class: shared_class(actor),
        track: actor.id.to_string(),
        source_class: actor.class.name().into(),
        velocity: Some([velocity.x, velocity.y]),
        attributes: attributes.into_iter().filter(|a| a.0).map(|a| a.1.to_owned()).collect(),
        points: None,
        visibility: None,
        interpolated: false,
    }
}
