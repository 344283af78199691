//! The second release: one Parquet file per component and segment, joined on stamp and camera.

mod rows;

use std::collections::{BTreeMap, BTreeSet};

use geometry::{RigCamera, Rigid};
use rayon::prelude::*;

use super::cameras;
use super::config::WaymoConfig;
use super::raw::{RawBox, RawFrame, RawPicture};
use super::recent::Recent;
use super::select;
use crate::DataError;
use crate::store::{Store, StoredFile};

pub(crate) const CONTEXT: &str = "key.segment_context_name";
pub(crate) const STAMP: &str = "key.frame_timestamp_micros";
pub(crate) const CAMERA: &str = "key.camera_name";
pub(crate) const OBJECT: &str = "key.laser_object_id";

/// The literal name of a component's column.
pub(crate) fn column(component: &str, field: &str) -> String {
    format!("[{component}Component].{field}")
}

/// Calibration columns in the order of `CameraCalibration.intrinsic`.
pub(crate) const INTRINSIC: [&str; 9] = ["f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"];

/// A split's segments and the tables of the last ones used.
#[derive(Debug)]
pub(super) struct Segments {
    pub list: Vec<Segment>,
    tables: Recent<Tables>,
}

/// What is needed of a segment before a frame is read.
#[derive(Debug)]
pub(super) struct Segment {
    pub name: String,
    /// Its place among all segments of the split.
    pub number: usize,
    /// The wanted cameras in rig order.
    pub cameras: Vec<RigCamera>,
    /// Numbers of all calibrated cameras.
    calibrated: Vec<i64>,
    /// Wanted frames in order of time.
    frames: Vec<(i64, Rigid)>,
    /// Their places among all frames of the segment.
    pub frame_numbers: Vec<usize>,
    images: StoredFile,
    boxes: Option<StoredFile>,
    stats: Option<StoredFile>,
}

/// The rows of a segment by stamp.
#[derive(Debug)]
struct Tables {
    pictures: BTreeMap<i64, Vec<RawPicture>>,
    boxes: Option<BTreeMap<i64, Vec<RawBox>>>,
    texts: BTreeMap<i64, Option<String>>,
}

/// The components every segment must have; a segment that lacks one of them is an incomplete copy.
const NEEDED: [&str; 3] = ["vehicle_pose", "camera_calibration", "camera_image"];

/// Reads poses and calibration of all segments of a split.
pub(super) fn open(config: &WaymoConfig, store: &Store) -> Result<Segments, DataError> {
    let mut names = BTreeSet::new();
    for component in NEEDED {
        for entry in store.list(&config.inside(component))? {
            names.extend(entry.name.strip_suffix(".parquet").filter(|_| !entry.is_folder).map(ToOwned::to_owned));
        }
    }
    let names = names.into_iter().enumerate().map(|(number, name)| (name, number)).collect();
    let list = select(names, &config.scenes, &store.path(&config.inside("")))?
        .into_par_iter()
        .map(|(name, number)| Segment::open(config, store, name, number))
        .collect::<Result<_, _>>()?;
    Ok(Segments { list, tables: Recent::default() })
}

impl Segments {
    pub fn frame(&self, config: &WaymoConfig, index: usize, at: usize) -> Result<RawFrame, DataError> {
        let absent = || DataError::Config(format!("frame {at} of segment {index} does not exist"));
        let segment = self.list.get(index).ok_or_else(absent)?;
        let (micros, world_from_ego) = *segment.frames.get(at).ok_or_else(absent)?;
        let tables = self.tables.get(index, || segment.tables(config))?;
        Ok(RawFrame {
            micros,
            world_from_ego,
            cameras: segment.cameras.clone(),
            pictures: tables.pictures.get(&micros).cloned().unwrap_or_default(),
            boxes: tables.boxes.as_ref().map(|boxes| boxes.get(&micros).cloned().unwrap_or_default()),
            text: tables.texts.get(&micros).cloned().flatten(),
            path: match &segment.boxes {
                Some(boxes) => boxes.path().to_owned(),
                None => segment.images.path().to_owned(),
            },
        })
    }

    pub fn has_boxes(&self) -> bool {
        self.list.iter().any(|segment| segment.boxes.is_some())
    }

    pub fn has_text(&self) -> bool {
        self.list.iter().any(|segment| segment.stats.is_some())
    }
}

impl Segment {
    fn open(config: &WaymoConfig, store: &Store, name: String, number: usize) -> Result<Self, DataError> {
        let path = |component: &str| config.inside(&format!("{component}/{name}.parquet"));
        let [poses, calibration, images] = NEEDED.map(|component| store.file(&path(component), component));
        let (calibration, images) = (calibration?, images?);
        let mut frames = rows::read_poses(&name, poses?)?;
        let mut frame_numbers: Vec<usize> = (0..frames.len()).collect();
        frame_numbers.retain(|at| frames.get(*at).is_some_and(|frame| !config.excludes(frame.0)));
        frames.retain(|frame| !config.excludes(frame.0));
        let all = rows::read_calibration(&name, calibration.clone())?;
        let calibrated = all.iter().filter_map(|camera| cameras::number(&camera.channel)).collect();
        let wanted = all.into_iter().filter(|camera| config.wants(&camera.channel)).collect();
        let cameras = cameras::in_rig_order(wanted, calibration.path())?;
        let (boxes, stats) = (store.find(&path("lidar_box")), store.find(&path("stats")));
        Ok(Self { name, number, cameras, calibrated, frames, frame_numbers, images, boxes, stats })
    }

    pub fn len(&self) -> usize {
        self.frames.len()
    }

    fn tables(&self, config: &WaymoConfig) -> Result<Tables, DataError> {
        let boxes = self.boxes.clone().map(|file| self.read_boxes(config, file)).transpose()?;
        let texts = self.stats.clone().map(|file| self.read_texts(file)).transpose()?.unwrap_or_default();
        Ok(Tables { pictures: self.read_pictures(config)?, boxes, texts })
    }
}
