//! Clips: several frames of one scene at a steady rate, for models of video.
//!
//! Only outlines of the frames are looked at when clips are indexed; pictures and boxes are made when a clip is asked for.

use std::ops::Range;
use std::sync::Arc;

use geometry::Rigid;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{DataError, FrameOutline, SceneDataset, SceneFrame};

/// Frames of one scene with the same rig, ascending in time.
#[derive(Debug, Clone)]
pub struct Clip {
    /// The frames.
    pub frames: Vec<SceneFrame>,
    /// Nominal rate, Hz.
    pub rate_hz: f64,
}

impl Clip {
    /// How the car moved from each frame to the next, between their reference instants: entry k maps points of frame k's ego frame to
    /// that of frame k + 1. One entry less than frames.
    pub fn ego_from_previous_ego(&self) -> Vec<Rigid> {
        let motion = |pair: &[SceneFrame]| pair[1].world_from_ego.inverse() * pair[0].world_from_ego;
        self.frames.windows(2).map(motion).collect()
    }

    /// Seconds since the first frame, one entry per frame.
    pub fn elapsed_secs(&self) -> Vec<f64> {
        let since = |first: i64| self.frames.iter().map(move |frame| (frame.timestamp_ns - first) as f64 * 1e-9);
        self.frames.first().map(|first| since(first.timestamp_ns).collect()).unwrap_or_default()
    }
}

/// Which frames make up a clip.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ClipMode {
    /// Consecutive frames, however uneven their steps.
    #[default]
    Native,
    /// For each instant of an even grid that begins at the first frame, the frame nearest to it (of two, the earlier). Where one is
    /// further away than half a grid step, or would serve twice, there is no clip.
    Grid,
}

/// Settings of [`Clips`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ClipConfig {
    /// Frames T of a clip.
    pub frames: usize,
    /// Rate, Hz. In [`ClipMode::Native`] it is that of the dataset and only names what is there.
    pub rate_hz: f64,
    /// Which frames make up a clip.
    pub mode: ClipMode,
    /// Frames of the dataset between the beginnings of two clips: 1 for every possible clip, T (at the native rate) for clips that do
    /// not overlap. Where no clip begins at a frame, the next frame is tried.
    pub stride: usize,
    /// Longest time between two frames of a clip, ms; a longer one is a gap, and no clip crosses it. By default one and a half steps of
    /// the rate, or for a grid whatever its instants allow.
    pub max_gap_ms: Option<f64>,
    /// Only clips whose frames are all annotated.
    pub require_boxes: bool,
}

impl Default for ClipConfig {
    fn default() -> Self {
        Self { frames: 8, rate_hz: 12.0, mode: ClipMode::Native, stride: 1, max_gap_ms: None, require_boxes: false }
    }
}

/// How far native steps may lie from the nominal one, as a factor: exposures that follow a faster lidar are uneven.
const NATIVE_TOLERANCE: f64 = 1.5;

/// All clips of a dataset, ordered by scene and time of their first frame.
pub struct Clips {
    dataset: Arc<dyn SceneDataset>,
    config: ClipConfig,
    /// Frame indices of all clips, T each.
    frames: Vec<usize>,
}

impl std::fmt::Debug for Clips {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Clips")
            .field("dataset", &self.dataset.name())
            .field("config", &self.config)
            .field("len", &self.len())
            .finish()
    }
}

impl Clips {
    /// Finds all clips. There may be none.
    ///
    /// # Errors
    /// [`DataError::Config`] for settings without a meaning, frames of a scene that do not ascend in time, and native frames that follow
    /// one another much faster than the rate says; whatever [`SceneDataset::outline`] returns.
    pub fn new(dataset: Arc<dyn SceneDataset>, config: ClipConfig) -> Result<Self, DataError> {
        config.validate()?;
        let outline = |range| Scene::outline(dataset.as_ref(), range, &config);
        let scenes: Result<Vec<Scene>, DataError> = dataset.scene_ranges().into_par_iter().map(outline).collect();
        let scenes = scenes?;
        check_rate(&scenes, &config, dataset.name())?;
        let frames = scenes.par_iter().flat_map_iter(|scene| scene.clips(&config)).collect();
        Ok(Self { dataset, config, frames })
    }

    /// Number of clips.
    pub fn len(&self) -> usize {
        self.frames.len() / self.config.frames
    }

    /// True where no clip fits.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Settings.
    pub fn config(&self) -> &ClipConfig {
        &self.config
    }

    /// The dataset of the frames.
    pub fn dataset(&self) -> &Arc<dyn SceneDataset> {
        &self.dataset
    }

    /// Indices of a clip's frames in the dataset, ascending.
    ///
    /// # Errors
    /// [`DataError::Config`] for an index beyond the last clip.
    pub fn frame_indices(&self, index: usize) -> Result<&[usize], DataError> {
        self.frames.chunks_exact(self.config.frames).nth(index).ok_or_else(|| {
            let (name, len) = (self.dataset.name(), self.len());
            DataError::Config(format!("dataset {name} has {len} clips; there is no clip {index}"))
        })
    }

    /// A clip, without pixels. Pure: same index, same clip.
    ///
    /// # Errors
    /// As [`Clips::frame_indices`]; whatever is wrong with a frame.
    pub fn clip(&self, index: usize) -> Result<Clip, DataError> {
        let frames = self.frame_indices(index)?.iter().map(|frame| self.dataset.frame(*frame));
        Ok(Clip { frames: frames.collect::<Result<_, _>>()?, rate_hz: self.config.rate_hz })
    }
}

impl ClipConfig {
    fn validate(&self) -> Result<(), DataError> {
        for (name, value) in [("frames", self.frames), ("stride", self.stride)] {
            if value == 0 {
                return Err(DataError::Config(format!("clips.{name} must be at least 1")));
            }
        }
        for (name, value) in [("rate_hz", Some(self.rate_hz)), ("max_gap_ms", self.max_gap_ms)] {
            if let Some(value) = value.filter(|value| !value.is_finite() || *value <= 0.0) {
                return Err(DataError::Config(format!("clips.{name} must be positive, but is {value}")));
            }
        }
        Ok(())
    }

    fn step_ns(&self) -> f64 {
        1e9 / self.rate_hz
    }

    fn max_gap_ns(&self) -> f64 {
        let steps = match self.mode {
            ClipMode::Native => NATIVE_TOLERANCE,
            ClipMode::Grid => 2.0,
        };
        self.max_gap_ms.map_or(steps * self.step_ns(), |ms| ms * 1e6)
    }
}

/// A dataset of several times the rate would silently give "native" clips of a fraction of the length that was asked for.
fn check_rate(scenes: &[Scene], config: &ClipConfig, name: &str) -> Result<(), DataError> {
    if config.mode == ClipMode::Grid || config.frames == 1 {
        return Ok(());
    }
    let steps = scenes.iter().flat_map(|scene| scene.times_ns.windows(2)).map(|pair| (pair[1] - pair[0]) as f64);
    let steps: Vec<f64> = steps.filter(|step| *step <= NATIVE_TOLERANCE * config.step_ns()).collect();
    let mean_ns = steps.iter().sum::<f64>() / steps.len() as f64;
    if mean_ns * NATIVE_TOLERANCE < config.step_ns() {
        let (found, asked) = (1e9 / mean_ns, config.rate_hz);
        return Err(DataError::Config(format!(
            "dataset {name} has {found:.1} Hz, not the {asked} Hz of clips.rate_hz; take mode \"grid\""
        )));
    }
    Ok(())
}

/// What clips of one scene depend on.
struct Scene {
    range: Range<usize>,
    times_ns: Vec<i64>,
    /// Number of the stretch of frames with one rig.
    stretch: Vec<u32>,
    /// True for frames that no clip may hold.
    barred: Vec<bool>,
}

impl Scene {
    fn outline(dataset: &dyn SceneDataset, range: Range<usize>, config: &ClipConfig) -> Result<Self, DataError> {
        let mut scene = Self { range, times_ns: Vec::new(), stretch: Vec::new(), barred: Vec::new() };
        let mut previous: Option<FrameOutline> = None;
        let mut stretch = 0;
        for index in scene.range.clone() {
            let outline = dataset.outline(index)?;
            if let Some(previous) = &previous {
                if outline.timestamp_ns <= previous.timestamp_ns {
                    let name = dataset.name();
                    return Err(DataError::Config(format!(
                        "frame {index} of {name} is not later than the frame before it in its scene"
                    )));
                }
                stretch += u32::from(outline.rig != previous.rig);
            }
            scene.times_ns.push(outline.timestamp_ns);
            scene.stretch.push(stretch);
            scene.barred.push(config.require_boxes && !outline.annotated);
            previous = Some(outline);
        }
        Ok(scene)
    }

    /// Frame indices of all clips.
    fn clips(&self, config: &ClipConfig) -> Vec<usize> {
        let mut clips = Vec::new();
        let mut start = 0;
        while start < self.times_ns.len() {
            let found = match config.mode {
                ClipMode::Native => Some((start..start + config.frames).collect()),
                ClipMode::Grid => self.grid(start, config),
            };
            match found.filter(|frames| self.is_whole(frames, config)) {
                Some(frames) => {
                    clips.extend(frames.iter().map(|frame| self.range.start + frame));
                    start += config.stride;
                }
                None => start += 1,
            }
        }
        clips
    }

    /// Whether these frames exist and nothing lies between them that a clip must not cross.
    fn is_whole(&self, frames: &[usize], config: &ClipConfig) -> bool {
        let (Some(first), Some(last)) = (frames.first(), frames.last()) else { return false };
        let same_rig = self.stretch.get(*first) == self.stretch.get(*last);
        let step = |pair: &[usize]| (self.times_ns[pair[1]] - self.times_ns[pair[0]]) as f64;
        *last < self.times_ns.len()
            && same_rig
            && frames.iter().all(|frame| !self.barred[*frame])
            && frames.windows(2).all(|pair| pair[0] < pair[1] && step(pair) <= config.max_gap_ns())
    }

    /// The frames nearest to the instants of a grid.
    fn grid(&self, start: usize, config: &ClipConfig) -> Option<Vec<usize>> {
        let step_ns = config.step_ns();
        let instant = |k: usize| {
            let want = self.times_ns[start].checked_add((k as f64 * step_ns).round() as i64)?;
            let after = self.times_ns.partition_point(|time| *time < want);
            let near = [after.checked_sub(1), Some(after)].into_iter().flatten().filter(|at| *at < self.times_ns.len());
            let off = |at: &usize| (self.times_ns[*at] - want).abs();
            near.min_by_key(off).filter(|at| off(at) as f64 <= 0.5 * step_ns)
        };
        (0..config.frames).map(instant).collect()
    }
}
