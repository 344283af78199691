//! Waymo Open Dataset, perception: reader of both releases, TFRecord (v1) and Parquet (v2).
//!
//! A frame's boxes and pose belong to the middle of its lidar turn, 50 ms after the stamp that names it. Every picture keeps its own
//! pose and stamp; pictures are read with a rolling shutter of up to 50 ms, which is not modelled. The lens is Brown–Conrady and
//! stays in [`crate::View::lens`]. Label velocities are turned from world to ego axes. Cameras run from left to right, an open chain.
//! Format: `dataset.proto` and `label.proto` of <https://github.com/waymo-research/waymo-open-dataset>.

pub(crate) mod cameras;
mod clip;
pub(crate) mod components;
mod config;
mod head;
mod map;
mod proto;
pub(crate) mod raw;
mod recent;
mod records;

use std::ops::Range;
use std::path::Path;

pub use config::{WaymoConfig, WaymoOccupancy, WaymoRelease};

use crate::occupancy::Occ3dWaymo;
use crate::store::Store;
use crate::{Capabilities, DataError, LocalMap, OccupancyGrid, SceneDataset, SceneFrame};
use map::WorldMap;
use raw::RawFrame;
use recent::Recent;

/// An opened Waymo split. Records and rows are read when a frame is asked for, pictures when they are decoded.
#[derive(Debug)]
pub struct Waymo {
    config: WaymoConfig,
    segments: Segments,
    /// Segment of each range of frames.
    owners: Vec<usize>,
    ranges: Vec<Range<usize>>,
    max_views: usize,
    occupancy: Option<Occ3dWaymo>,
}

#[derive(Debug)]
enum Segments {
    V1 { list: Vec<records::Segment>, maps: Recent<WorldMap> },
    V2(components::Segments),
}

/// A 3D label projected by the publisher, for checks of a projection.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectedLabel {
    /// Camera.
    pub channel: String,
    /// Track of the 3D label, followed by a suffix of the camera.
    pub id: String,
    /// Middle of the rectangle around the projected corners, cut at the picture's border; px, centres at +0.5.
    pub center_px: [f64; 2],
    /// Width and height, px.
    pub size_px: [f64; 2],
}

impl Waymo {
    /// Finds the frames of a split. v1 reads the header and the first kilobytes of every record, v2 poses and calibration.
    ///
    /// # Errors
    /// Whatever is wrong with what was read, naming the file; [`DataError::Empty`] for a split without a frame.
    pub fn open(config: &WaymoConfig) -> Result<Self, DataError> {
        config.checked()?;
        let store = Store::open_all(&config.root)?;
        let segments = match config.release {
            WaymoRelease::V1 => Segments::V1 { list: records::open(config, &store)?, maps: Recent::default() },
            WaymoRelease::V2 => Segments::V2(components::open(config, &store)?),
        };
        let sizes = segments.sizes();
        let (mut owners, mut ranges, mut end) = (Vec::new(), Vec::new(), 0);
        for (owner, (frames, _)) in sizes.iter().enumerate().filter(|(_, size)| size.0 > 0) {
            owners.push(owner);
            ranges.push(end..end + frames);
            end += frames;
        }
        let max_views = sizes.iter().map(|size| size.1).max().unwrap_or(0);
        if ranges.is_empty() || max_views == 0 {
            let what = if ranges.is_empty() { "the split" } else { "the choice of cameras" };
            return Err(DataError::Empty { what: what.to_owned(), path: store.path(&config.inside("")) });
        }
        let labels = config.occupancy.as_ref().map(|set| Occ3dWaymo::open(set.root.clone(), set.voxels));
        Ok(Self { config: config.clone(), segments, owners, ranges, max_views, occupancy: labels.transpose()? })
    }

    /// Where the publisher sees the labels of a frame, if its files say so (v1 only).
    ///
    /// # Errors
    /// [`DataError::Unsupported`] for v2; whatever is wrong with the record.
    pub fn projected_lidar_labels(&self, index: usize) -> Result<Vec<ProjectedLabel>, DataError> {
        let (owner, at) = self.place(index)?;
        match &self.segments {
            Segments::V1 { list, .. } => self.v1(list, owner, index)?.projected(at),
            Segments::V2(_) => Err(self.unsupported("projected lidar labels")),
        }
    }

    /// Segment of a frame and its number there.
    fn place(&self, index: usize) -> Result<(usize, usize), DataError> {
        let range = self.ranges.partition_point(|range| range.end <= index);
        match (self.ranges.get(range), self.owners.get(range)) {
            (Some(frames), Some(owner)) => Ok((*owner, index - frames.start)),
            _ => Err(self.no_frame(index)),
        }
    }

    fn no_frame(&self, index: usize) -> DataError {
        DataError::Config(format!("frame {index} of {} does not exist, there are {}", self.config.name, self.len()))
    }

    fn v1<'a>(
        &self,
        list: &'a [records::Segment],
        owner: usize,
        index: usize,
    ) -> Result<&'a records::Segment, DataError> {
        list.get(owner).ok_or_else(|| self.no_frame(index))
    }

    fn raw(&self, index: usize) -> Result<(&str, RawFrame), DataError> {
        let (owner, at) = self.place(index)?;
        match &self.segments {
            Segments::V1 { list, .. } => {
                let segment = self.v1(list, owner, index)?;
                Ok((&segment.name, segment.frame(&self.config, at)?))
            }
            Segments::V2(segments) => {
                let frame = segments.frame(&self.config, owner, at)?;
                Ok((segments.list.get(owner).map_or("", |segment| &segment.name), frame))
            }
        }
    }
}

impl Segments {
    /// Frames and views of each segment.
    fn sizes(&self) -> Vec<(usize, usize)> {
        match self {
            Self::V1 { list, .. } => list.iter().map(|segment| (segment.len(), segment.views)).collect(),
            Self::V2(segments) => segments.list.iter().map(|s| (s.len(), s.cameras.len())).collect(),
        }
    }
}

impl Segments {
    /// Name, place in the split and places of the frames of a segment.
    fn numbers(&self, owner: usize) -> Option<(&str, usize, &[usize])> {
        match self {
            Self::V1 { list, .. } => list.get(owner).map(|s| (s.name.as_str(), s.number, s.frame_numbers.as_slice())),
            Self::V2(segments) => {
                segments.list.get(owner).map(|s| (s.name.as_str(), s.number, s.frame_numbers.as_slice()))
            }
        }
    }
}

impl SceneDataset for Waymo {
    fn len(&self) -> usize {
        self.ranges.last().map_or(0, |range| range.end)
    }

    fn frame(&self, index: usize) -> Result<SceneFrame, DataError> {
        let (scene, raw) = self.raw(index)?;
        raw.into_frame(&self.config, scene)
    }

    fn scene_ranges(&self) -> Vec<Range<usize>> {
        self.ranges.clone()
    }

    /// The map of a segment stands in its first frame and serves them all.
    fn local_map(&self, index: usize, half_m: f64) -> Result<LocalMap, DataError> {
        let (owner, at) = self.place(index)?;
        let Segments::V1 { list, maps } = &self.segments else { return Err(self.unsupported("map")) };
        let segment = self.v1(list, owner, index)?;
        let map = maps.get(owner, || segment.map())?;
        Ok(map.around(&segment.map_from_ego(at)?, half_m))
    }

    fn occupancy(&self, index: usize) -> Result<OccupancyGrid, DataError> {
        let (owner, at) = self.place(index)?;
        let (Some(labels), Some(set)) = (&self.occupancy, &self.config.occupancy) else {
            return Err(self.unsupported("occupancy"));
        };
        let (name, number, frames) = self.segments.numbers(owner).ok_or_else(|| self.no_frame(index))?;
        let frame = *frames.get(at).ok_or_else(|| self.no_frame(index))?;
        labels.read(set.scenes.get(name).copied().unwrap_or(number), frame)
    }

    fn name(&self) -> &str {
        &self.config.name
    }

    /// Of v1, what the release can hold: the frames of its test split have no boxes, those before 1.4.2 no map.
    fn capabilities(&self) -> Capabilities {
        let (boxes, map, text) = match &self.segments {
            Segments::V1 { .. } => (true, true, true),
            Segments::V2(segments) => (segments.has_boxes(), false, segments.has_text()),
        };
        let occupancy = self.occupancy.is_some();
        Capabilities { boxes, map, text, occupancy, ..Capabilities::default() }
    }

    fn max_views(&self) -> usize {
        self.max_views
    }
}

/// The chosen segments in the asked order; all of them where none is named.
fn select<T: Clone>(
    segments: Vec<(String, T)>,
    wanted: &[String],
    folder: &Path,
) -> Result<Vec<(String, T)>, DataError> {
    if wanted.is_empty() {
        return Ok(segments);
    }
    let find = |name: &String| {
        let found = segments.iter().find(|segment| segment.0 == *name).cloned();
        found.ok_or_else(|| DataError::Missing { what: format!("segment {name}"), path: folder.to_owned() })
    };
    wanted.iter().map(find).collect()
}
