//! Looks at everything a training run would meet, for any dataset, and tells what is missing, broken or odd before the run does.

mod boxes;
mod frames;
mod memory;
mod rigs;
mod times;

use std::collections::{BTreeMap, BTreeSet};

use rand::RngExt;
use rayon::prelude::*;
use serde::{Serialize, Serializer};

pub use boxes::BoxReport;
pub use memory::{BatchMemory, batch_memory};
pub use rigs::{CameraReport, RigReport};
pub use times::{Gap, TimeReport};

use frames::{FrameFacts, Picture};
use rigs::Rigs;
use times::Times;

use crate::seeding::{Purpose, rng};
use crate::{Capabilities, DataError, ImageSource, SceneDataset};

/// How thorough a check is. Every frame is made and every picture is looked at in any case.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CheckOptions {
    /// Random pictures of each scene that are decoded completely; the others are checked for existence, size and end.
    pub decode: usize,
    /// Frames of each scene, spread evenly, whose map and occupancy labels are read.
    pub labels: usize,
    /// Seed of the choice of pictures.
    pub seed: u64,
}

impl Default for CheckOptions {
    fn default() -> Self {
        Self { decode: 2, labels: 1, seed: 0 }
    }
}

/// What a check found. Counts are over all scenes.
#[derive(Debug, Serialize)]
pub struct CheckReport {
    /// Name the dataset was opened under.
    pub name: String,
    /// Optional parts it offers.
    pub capabilities: Capabilities,
    /// Scenes looked at.
    pub scenes: usize,
    /// Frames they give.
    pub frames: usize,
    /// Pictures and masks in files, each counted once.
    pub pictures: usize,
    /// Views of those frames without a picture. No fault: cameras drop pictures.
    pub absent_views: usize,
    /// Views that are rendered when asked for.
    pub rendered_views: usize,
    /// Pictures decoded or rendered completely.
    pub decoded: usize,
    /// Largest picture, width and height, px.
    pub largest_picture: (u32, u32),
    /// Most views of a frame.
    pub max_views: usize,
    /// Annotated objects.
    pub boxes: BoxReport,
    /// The vehicles.
    pub rigs: Vec<RigReport>,
    /// Rhythm and holes.
    pub times: TimeReport,
    /// Frames whose map was read.
    pub maps_read: usize,
    /// Frames whose occupancy labels were read.
    pub occupancy_read: usize,
    /// Places without occupancy labels in any of a dozen frames.
    pub occupancy_absent: usize,
    /// What the dataset says about itself.
    pub notes: Vec<String>,
    /// Frames that cannot be made, in order.
    #[serde(serialize_with = "as_text")]
    pub unreadable_frames: Vec<DataError>,
    /// Files that are missing or broken, by scene, camera and time.
    #[serde(serialize_with = "as_text")]
    pub problems: Vec<DataError>,
    /// Oddities that do not stop a run.
    pub warnings: Vec<String>,
}

impl CheckReport {
    /// True when nothing is missing or broken.
    pub fn is_sound(&self) -> bool {
        self.unreadable_frames.is_empty() && self.problems.is_empty()
    }

    /// True when a run that uses every frame would not be stopped by the data: sound, and not empty.
    pub fn could_train(&self) -> bool {
        self.is_sound() && self.frames > 0 && self.pictures + self.rendered_views > 0
    }

    /// Number of files that do not exist.
    pub fn missing(&self) -> usize {
        self.problems.iter().filter(|problem| matches!(problem, DataError::Missing { .. })).count()
    }

    /// Number of files that exist but cannot be used.
    pub fn damaged(&self) -> usize {
        self.problems.len() - self.missing()
    }

    fn new(dataset: &dyn SceneDataset) -> Self {
        Self {
            name: dataset.name().to_owned(),
            capabilities: dataset.capabilities(),
            scenes: dataset.scene_ranges().len(),
            frames: dataset.len(),
            pictures: 0,
            absent_views: 0,
            rendered_views: 0,
            decoded: 0,
            largest_picture: (0, 0),
            max_views: dataset.max_views(),
            boxes: BoxReport::default(),
            rigs: Vec::new(),
            times: TimeReport::default(),
            maps_read: 0,
            occupancy_read: 0,
            occupancy_absent: 0,
            notes: dataset.notes(),
            unreadable_frames: Vec::new(),
            problems: Vec::new(),
            warnings: Vec::new(),
        }
    }

    /// Map and occupancy of one frame. Labels that are missing there are looked for in the frames behind it, up to `end`: most sets have
    /// them at key frames only.
    fn read_labels(&mut self, dataset: &dyn SceneDataset, index: usize, end: usize, absent: &mut Vec<DataError>) {
        if self.capabilities.map {
            match dataset.local_map(index, MAP_HALF_M) {
                Ok(_) => self.maps_read += 1,
                Err(error) => self.problems.push(error),
            }
        }
        if !self.capabilities.occupancy {
            return;
        }
        let mut first_missing = None;
        for index in (index..end).take(OCCUPANCY_TRIES) {
            match dataset.occupancy(index) {
                Ok(_) => return self.occupancy_read += 1,
                Err(error @ DataError::Missing { .. }) => _ = first_missing.get_or_insert(error),
                Err(error) => return self.problems.push(error),
            }
        }
        self.occupancy_absent += 1;
        absent.extend(first_missing);
    }

    /// A set that promises labels and delivers none was given the wrong folder; single holes are known in all of them.
    fn judge_occupancy(&mut self, absent: Vec<DataError>) {
        let count = absent.len();
        match absent.into_iter().next() {
            Some(first) if self.occupancy_read == 0 => self.problems.push(first),
            Some(first) => self.warnings.push(format!("no occupancy labels at {count} places, first {first}")),
            None => {}
        }
    }

    /// The pictures of one scene.
    fn look_at(&mut self, pictures: Vec<Picture>, decoded: &BTreeSet<usize>) {
        let looked: Vec<_> = pictures
            .par_iter()
            .enumerate()
            .map(|(at, picture)| if decoded.contains(&at) { picture.read() } else { picture.source.inspect() })
            .collect();
        let rendered = |picture: &&Picture| matches!(picture.source, ImageSource::Rendered { .. });
        let rendered = pictures.iter().filter(rendered).count();
        self.rendered_views += rendered;
        self.pictures += pictures.len() - rendered;
        self.decoded += decoded.len();
        self.problems.extend(looked.into_iter().filter_map(Result::err));
    }
}

/// Half side of the map that is read, metres.
const MAP_HALF_M: f64 = 50.0;
/// Frames in which occupancy labels are looked for: two key intervals at 12 Hz.
const OCCUPANCY_TRIES: usize = 12;

/// Opens nothing, reads every frame of an opened dataset and looks at its pictures; `decode` random pictures of each scene are decoded
/// completely. [`check_all`] is the same with more choices and without an end at the first unreadable frame.
///
/// # Errors
/// The first frame that cannot be read; broken pictures are listed in the report.
pub fn check(dataset: &dyn SceneDataset, decode: usize) -> Result<CheckReport, DataError> {
    let options = CheckOptions { decode, labels: 0, ..CheckOptions::default() };
    let mut report = check_all(dataset, &options, &mut |_, _| {});
    if report.unreadable_frames.is_empty() { Ok(report) } else { Err(report.unreadable_frames.swap_remove(0)) }
}

/// Reads every frame, looks at every picture and lists whatever is wrong. `progress` is told scenes done and scenes in all.
pub fn check_all(
    dataset: &dyn SceneDataset,
    options: &CheckOptions,
    progress: &mut dyn FnMut(usize, usize),
) -> CheckReport {
    let mut report = CheckReport::new(dataset);
    let (mut rigs, mut times, mut absent) = (Rigs::default(), Times::default(), Vec::new());
    for (scene, range) in dataset.scene_ranges().into_iter().enumerate() {
        let facts: Vec<_> = range.clone().into_par_iter().map(|index| FrameFacts::of(dataset, index)).collect();
        let mut pictures = BTreeMap::new();
        let mut stamps = Vec::new();
        for (index, facts) in range.clone().zip(facts) {
            match facts {
                Err(error) => report.unreadable_frames.push(error),
                Ok(facts) => {
                    report.absent_views += facts.absent_views;
                    report.largest_picture = facts.largest_picture(report.largest_picture);
                    report.boxes.add(&facts.boxes);
                    rigs.add(&facts, scene);
                    stamps.push((index, facts.timestamp_ns));
                    times.pictures(&facts);
                    pictures.extend(facts.pictures.into_iter().map(|picture| (picture.key.clone(), picture)));
                }
            }
        }
        times.scene(dataset, &stamps);
        let pictures: Vec<Picture> = pictures.into_values().collect();
        let chosen = choose(pictures.len(), options.decode, options.seed, scene);
        report.look_at(pictures, &chosen);
        for at in spread(range.len(), options.labels) {
            report.read_labels(dataset, range.start + at, range.end, &mut absent);
        }
        progress(scene + 1, report.scenes);
    }
    (report.rigs, report.warnings) = rigs.finish();
    report.times = times.finish(&mut report.warnings);
    report.judge_occupancy(absent);
    report
}

/// `count` different random positions below `len`.
fn choose(len: usize, count: usize, seed: u64, scene: usize) -> BTreeSet<usize> {
    if count >= len {
        return (0..len).collect();
    }
    let mut random = rng(seed, Purpose::Check, scene as u64, 0);
    let mut chosen = BTreeSet::new();
    while chosen.len() < count {
        chosen.insert(random.random_range(0..len));
    }
    chosen
}

/// `count` positions below `len`, each in the middle of its share.
fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    let count = count.min(len);
    (0..count).map(move |i| (2 * i + 1) * len / (2 * count))
}

fn as_text<S: Serializer>(errors: &[DataError], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_seq(errors.iter().map(ToString::to_string))
}

#[cfg(test)]
mod tests;
