//! The neutral records every reader fills: one instant of one vehicle, without pixels until asked.

use std::ops::Range;
use std::sync::Arc;

use geometry::{BevGrid, Box3d, Camera, CameraRig, ImageEdit, Intrinsics, Lens, RigCamera, Rigid};
use image::RgbImage;

use crate::{DataError, ImageSource, ObjectClass, caption};

/// Where a frame comes from; kept through batches so that every error and every exported file can name it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FrameId {
    /// Name the dataset was opened under.
    pub dataset: String,
    /// Log, scene or segment.
    pub scene: String,
    /// Native frame token or stamp as text.
    pub frame: String,
}

/// All cameras of one vehicle at one instant.
#[derive(Debug, Clone)]
pub struct SceneFrame {
    /// Where it comes from.
    pub id: FrameId,
    /// Reference instant.
    pub timestamp_ns: i64,
    /// The car at the reference instant.
    pub world_from_ego: Rigid,
    /// Cameras in rig order; a missing picture is a view with `image: None`.
    pub views: Vec<View>,
    /// `None`: this frame is not annotated. `Some` of nothing: annotated, nothing there.
    pub boxes: Option<Vec<ObjectBox>>,
    /// The dataset's own words about the scene.
    pub scene_text: Option<String>,
}

/// One camera's picture and calibration.
#[derive(Debug, Clone)]
pub struct View {
    /// The channel's name in its dataset.
    pub channel: String,
    /// When this picture was taken.
    pub timestamp_ns: i64,
    /// Pixels, decoded on demand; `None` where the dataset lacks this picture.
    pub image: Option<ImageSource>,
    /// Pixels to ignore are zero.
    pub mask: Option<ImageSource>,
    /// Of the raw picture; pixel centres at +0.5.
    pub intrinsics: Intrinsics,
    /// Of the raw picture.
    pub lens: Lens,
    /// Mounting pose.
    pub ego_from_cam: Rigid,
    /// The car when this picture was taken.
    pub world_from_ego: Rigid,
}

impl View {
    /// A camera without a picture, at the place of a car, at time 0.
    #[must_use]
    pub fn of_camera(camera: &RigCamera, world_from_ego: Rigid) -> Self {
        Self {
            channel: camera.channel.clone(),
            timestamp_ns: 0,
            image: None,
            mask: None,
            intrinsics: camera.intrinsics,
            lens: camera.lens,
            ego_from_cam: camera.ego_from_cam,
            world_from_ego,
        }
    }

    /// The camera's pose in the ego frame of another instant, usually the frame's reference instant. Skipping this costs up to
    /// 0.4 m on real data, because the car moves between the exposures of its cameras.
    pub fn ref_ego_from_cam(&self, world_from_ref_ego: &Rigid) -> Rigid {
        world_from_ref_ego.inverse() * self.world_from_ego * self.ego_from_cam
    }

    /// The same camera with another picture in memory, such as a generated one: pinhole, the view's whole image plane at the size of
    /// `picture`. A mask does not outlive its picture.
    #[must_use]
    pub fn with_picture(&self, picture: RgbImage) -> Self {
        let size = picture.dimensions();
        let raw = &self.intrinsics;
        let intrinsics = ImageEdit::identity(raw.width, raw.height).resize(size.0, size.1).intrinsics(raw);
        let image = Some(ImageSource::Memory { picture: Arc::new(picture), size });
        Self { image, mask: None, intrinsics, lens: Lens::Pinhole, ..self.clone() }
    }

    /// The static part.
    pub fn rig_camera(&self) -> RigCamera {
        RigCamera {
            channel: self.channel.clone(),
            intrinsics: self.intrinsics,
            lens: self.lens,
            ego_from_cam: self.ego_from_cam,
        }
    }

    /// The projection model of the raw picture.
    ///
    /// # Errors
    /// Calibration that [`geometry::Camera::new`] refuses.
    pub fn camera(&self) -> Result<Camera, geometry::GeometryError> {
        Camera::new(self.intrinsics, self.lens)
    }
}

impl SceneFrame {
    /// The dataset's own words, or a sentence that counts what is annotated where it has none. Time of day and weather are unknown
    /// then and not mentioned.
    pub fn caption(&self) -> String {
        match &self.scene_text {
            Some(text) => text.clone(),
            None => caption::of_boxes(self.boxes.as_deref().unwrap_or_default()),
        }
    }

    /// The static part of the views, in order.
    pub fn rig(&self) -> CameraRig {
        CameraRig { cameras: self.views.iter().map(View::rig_camera).collect() }
    }
}

/// One annotated object.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectBox {
    /// Ego frame at the reference instant.
    pub box3d: Box3d,
    /// Shared taxonomy.
    pub class: ObjectClass,
    /// Identity over time.
    pub track: String,
    /// The dataset's own class name.
    pub source_class: String,
    /// m/s in ego axes, over ground; `None` where undefined.
    pub velocity: Option<[f64; 2]>,
    /// The dataset's own attribute names.
    pub attributes: Vec<String>,
    /// Lidar points inside.
    pub points: Option<u32>,
    /// The dataset's own visibility level.
    pub visibility: Option<u8>,
    /// True where the box was interpolated between annotations.
    pub interpolated: bool,
}

/// What is known of a frame without making it: enough to index clips and batches.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameOutline {
    /// Reference instant.
    pub timestamp_ns: i64,
    /// The static part of the views, in order.
    pub rig: CameraRig,
    /// Whether the frame has a list of boxes, be it empty.
    pub annotated: bool,
}

impl FrameOutline {
    /// Of a frame that exists already.
    pub fn of(frame: &SceneFrame) -> Self {
        Self { timestamp_ns: frame.timestamp_ns, rig: frame.rig(), annotated: frame.boxes.is_some() }
    }
}

/// What a map element means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MapKind {
    /// Painted line between lanes or roads.
    Divider,
    /// Pedestrian crossing.
    Crossing,
    /// Border of the drivable area.
    Boundary,
    /// Middle of a lane.
    Centerline,
    /// Line at which traffic stops.
    StopLine,
    /// Pavement.
    Walkway,
    /// Parking.
    Carpark,
}

/// A polyline of the map; the call that returns it states the frame.
#[derive(Debug, Clone, PartialEq)]
pub struct MapLine {
    /// Meaning.
    pub kind: MapKind,
    /// Metres.
    pub points: Vec<[f64; 3]>,
}

/// An area of the map; the call that returns it states the frame. An area of kind [`MapKind::Boundary`] is what that border encloses,
/// the drivable area.
#[derive(Debug, Clone, PartialEq)]
pub struct MapArea {
    /// Meaning.
    pub kind: MapKind,
    /// Outline, metres.
    pub outer: Vec<[f64; 2]>,
    /// Holes, metres.
    pub holes: Vec<Vec<[f64; 2]>>,
}

/// The map around a car: metres in the ego frame of a frame's reference instant, z of areas dropped.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LocalMap {
    /// Polylines, cut at the border of the asked square.
    pub lines: Vec<MapLine>,
    /// Areas that reach into the asked square, whole.
    pub areas: Vec<MapArea>,
}

/// Which classes the labels of an [`OccupancyGrid`] count. Label 255 ([`OccupancyGrid::IGNORED`]) is outside every set: nothing is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OccupancyLabels {
    /// Occ3D-nuScenes: 0 to 16, 17 is free. Also SurroundOcc, OpenOccupancy and the procedural world.
    NuScenes,
    /// Occ3D-Waymo: 0 to 14, 23 is free.
    Waymo,
}

/// Semantic occupancy of one instant.
#[derive(Debug, Clone, PartialEq)]
pub struct OccupancyGrid {
    /// Extent and cells, in the grid's own frame.
    pub grid: BevGrid,
    /// The grid's frame in the ego frame of the reference instant; not the identity for labels made in the lidar's frame or at
    /// another instant.
    pub ego_from_grid: Rigid,
    /// Meaning of the labels.
    pub label_set: OccupancyLabels,
    /// One label per cell in the grid's memory order (z, y, x).
    pub labels: Vec<u8>,
    /// True where a lidar saw the cell; `None` where the dataset does not say.
    pub lidar_mask: Option<Vec<bool>>,
    /// True where a camera saw the cell; `None` where the dataset does not say. Labels exist outside it, but losses and scores count
    /// only what was seen.
    pub camera_mask: Option<Vec<bool>>,
}

/// Optional parts a dataset can deliver. Asking for an absent one is [`DataError::Unsupported`], not an empty answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct Capabilities {
    /// Annotated boxes.
    pub boxes: bool,
    /// Vector map.
    pub map: bool,
    /// Occupancy labels.
    pub occupancy: bool,
    /// CAN bus.
    pub can_bus: bool,
    /// Masks of pixels to ignore.
    pub masks: bool,
    /// Scene descriptions.
    pub text: bool,
}

/// A dataset: an ordered list of frames. `len` never changes after opening and `frame` is pure: same index, same result.
pub trait SceneDataset: Send + Sync {
    /// Number of frames.
    fn len(&self) -> usize;

    /// True for a dataset without frames.
    fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// One frame, without pixels.
    ///
    /// # Errors
    /// Whatever is wrong with the frame's rows; never a substituted frame.
    fn frame(&self, index: usize) -> Result<SceneFrame, DataError>;

    /// The outline of a frame, equal to [`FrameOutline::of`] it. Readers that know it without making boxes override this: indexing asks
    /// for every frame.
    ///
    /// # Errors
    /// As [`SceneDataset::frame`].
    fn outline(&self, index: usize) -> Result<FrameOutline, DataError> {
        Ok(FrameOutline::of(&self.frame(index)?))
    }

    /// The classes of a frame's boxes, in any order and as often as they occur; none for a frame that is not annotated.
    ///
    /// # Errors
    /// As [`SceneDataset::frame`].
    fn box_classes(&self, index: usize) -> Result<Vec<ObjectClass>, DataError> {
        Ok(self.frame(index)?.boxes.into_iter().flatten().map(|found| found.class).collect())
    }

    /// Frame ranges of the scenes, in order; together all frames. Within a scene time ascends.
    fn scene_ranges(&self) -> Vec<Range<usize>>;

    /// The map within ±`half_m` metres of the car, along both axes of the ego frame.
    ///
    /// # Errors
    /// [`DataError::Unsupported`] for a dataset without maps; whatever is wrong with the map's files.
    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        let _ = (index, half_m);
        Err(self.unsupported("map"))
    }

    /// Occupancy labels of a frame.
    ///
    /// # Errors
    /// [`DataError::Unsupported`] for a dataset without occupancy; [`DataError::Missing`] for a frame without labels.
    fn occupancy(&self, index: usize) -> Result<OccupancyGrid, DataError> {
        let _ = index;
        Err(self.unsupported("occupancy"))
    }

    /// The name it was opened under.
    fn name(&self) -> &str;

    /// What a check should tell beside what the frames show: parts that were asked for and gave no frame, for example.
    fn notes(&self) -> Vec<String> {
        Vec::new()
    }

    /// The error for a part this dataset lacks.
    fn unsupported(&self, what: &'static str) -> DataError {
        DataError::Unsupported { dataset: self.name().to_owned(), what }
    }

    /// Which optional parts it has.
    fn capabilities(&self) -> Capabilities;

    /// The largest number of views any of its frames has.
    fn max_views(&self) -> usize;
}
