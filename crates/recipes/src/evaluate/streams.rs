//! Metrics that look through a network: features of pictures, features of clips, matches at seams. All of them stream.

use std::collections::{BTreeMap, VecDeque};

use metrics::{ClipRule, FeaturePool, Moments, Protocol, Seam, ViewConsistency};
use rayon::prelude::*;

use super::network::{FeatureNetwork, Loaded, Pictures, SeamMatcher, WeightsUsed};

/// Which of the two sets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Side {
    /// What is compared with.
    Real,
    /// What is measured.
    Generated,
}

/// Most samples of a side that are kept for metrics of pairs.
pub const POOLED: usize = 10_000;

/// Features of one side.
#[derive(Debug, Clone)]
pub struct SideFeatures {
    /// Mean and covariance.
    pub moments: Moments,
    /// A bounded choice of rows.
    pub pool: FeaturePool,
}

impl SideFeatures {
    fn new(width: usize, seed: u64) -> Self {
        Self { moments: Moments::new(width), pool: FeaturePool::new(width, POOLED, seed) }
    }

    fn add(&mut self, names: &[String], rows: &[f32], width: usize) -> anyhow::Result<()> {
        self.moments.update(rows)?;
        for (name, row) in names.iter().zip(rows.chunks_exact(width.max(1))) {
            self.pool.add(name, row)?;
        }
        Ok(())
    }
}

/// Pictures of both sides through one network, shared by every protocol with the same pictures and features.
pub struct FeatureStream {
    /// The protocols it serves differ from this one in the metric only.
    pub protocol: Protocol,
    /// The network.
    pub loaded: Loaded<dyn FeatureNetwork>,
    /// How clips are cut; `None` for single pictures.
    pub clip: Option<ClipRule>,
    real: SideFeatures,
    generated: SideFeatures,
    waiting: BTreeMap<Side, (Vec<String>, Vec<f32>)>,
    cutters: BTreeMap<(Side, String), ClipCutter>,
    batch: usize,
}

impl FeatureStream {
    /// `batch` pictures go through the network at once.
    pub fn new(
        protocol: &Protocol,
        loaded: Loaded<dyn FeatureNetwork>,
        clip: Option<ClipRule>,
        batch: usize,
        seed: u64,
    ) -> Self {
        let width = loaded.network.width();
        Self {
            protocol: protocol.clone(),
            loaded,
            clip,
            real: SideFeatures::new(width, seed),
            generated: SideFeatures::new(width, seed),
            waiting: BTreeMap::new(),
            cutters: BTreeMap::new(),
            batch: batch.max(1),
        }
    }

    /// Features so far.
    pub fn side(&self, side: Side) -> &SideFeatures {
        match side {
            Side::Real => &self.real,
            Side::Generated => &self.generated,
        }
    }

    /// Forgets the frames of the scene before; clips do not cross scenes.
    pub fn next_scene(&mut self) {
        self.cutters.clear();
    }

    /// Takes a picture in, `input` as the network wants it.
    ///
    /// # Errors
    /// Whatever the network or its features report.
    pub fn add(&mut self, side: Side, channel: &str, name: String, input: Vec<f32>) -> anyhow::Result<()> {
        let Some(rule) = self.clip else {
            let (names, values) = self.waiting.entry(side).or_default();
            names.push(name);
            values.extend(input);
            return if names.len() >= self.batch { self.flush(side) } else { Ok(()) };
        };
        let cutter = self.cutters.entry((side, channel.to_owned())).or_insert_with(|| ClipCutter::new(rule));
        let Some(frames) = cutter.add(input) else { return Ok(()) };
        let row = self.rows(frames.len(), &frames.concat())?;
        let width = row.len();
        self.side_mut(side).add(&[name], &row, width)
    }

    /// Takes the pictures of the last batch in, which may not be full.
    ///
    /// # Errors
    /// As [`FeatureStream::add`].
    pub fn finish(&mut self) -> anyhow::Result<()> {
        [Side::Real, Side::Generated].into_iter().try_for_each(|side| self.flush(side))
    }

    fn side_mut(&mut self, side: Side) -> &mut SideFeatures {
        match side {
            Side::Real => &mut self.real,
            Side::Generated => &mut self.generated,
        }
    }

    fn flush(&mut self, side: Side) -> anyhow::Result<()> {
        let Some((names, values)) = self.waiting.remove(&side).filter(|(names, _)| !names.is_empty()) else {
            return Ok(());
        };
        let rows = self.rows(names.len(), &values)?;
        let width = self.loaded.network.width();
        self.side_mut(side).add(&names, &rows, width)
    }

    /// A part of the batch per thread: small networks keep cores busier side by side than inside one pass.
    fn rows(&self, count: usize, values: &[f32]) -> anyhow::Result<Vec<f32>> {
        let [height, width] = self.loaded.network.feature().size;
        let pictures = |count, values| self.loaded.network.features(Pictures { count, height, width, values });
        if self.clip.is_some() {
            return pictures(count, values);
        }
        let picture = 3 * height * width;
        let share = count.div_ceil(rayon::current_num_threads().max(1)).max(1);
        let parts = values.par_chunks(share * picture).map(|part| pictures(part.len() / picture, part));
        Ok(parts.collect::<anyhow::Result<Vec<Vec<f32>>>>()?.concat())
    }
}

/// Cuts the frames of one camera into clips.
#[derive(Debug, Clone)]
pub struct ClipCutter {
    rule: ClipRule,
    /// The last frames.
    frames: VecDeque<Vec<f32>>,
    seen: usize,
}

impl ClipCutter {
    /// At the beginning of a scene.
    pub fn new(rule: ClipRule) -> Self {
        Self { rule, frames: VecDeque::new(), seen: 0 }
    }

    /// Takes the next frame; gives a clip when one is complete, repeated frames included.
    pub fn add(&mut self, frame: Vec<f32>) -> Option<Vec<Vec<f32>>> {
        let extent = (self.rule.length.max(1) - 1) * self.rule.stride + 1;
        self.frames.push_back(frame);
        self.seen += 1;
        if self.frames.len() > extent {
            self.frames.pop_front();
        }
        let step = self.rule.step.unwrap_or(extent).max(1);
        let complete = self.seen >= extent && (self.seen - extent).is_multiple_of(step);
        let shown = self.frames.iter().step_by(self.rule.stride.max(1));
        complete.then(|| shown.flat_map(|frame| std::iter::repeat_n(frame.clone(), self.rule.repeat)).collect())
    }
}

/// Matches at the seams of both sides.
pub struct SeamStream {
    /// The matcher.
    pub matcher: Box<dyn SeamMatcher>,
    /// Its weights.
    pub weights: WeightsUsed,
    /// `None` for LoFTR with its outdoor weights.
    pub stand_in: Option<String>,
    /// Over real samples.
    pub real: ViewConsistency,
    /// Over generated samples.
    pub generated: ViewConsistency,
    /// Pairs of views that were matched.
    pub pairs: u64,
}

impl SeamStream {
    /// With a matcher.
    pub fn new(loaded: Loaded<dyn SeamMatcher>) -> Self {
        Self {
            matcher: loaded.network,
            weights: loaded.weights,
            stand_in: loaded.stand_in,
            real: ViewConsistency::default(),
            generated: ViewConsistency::default(),
            pairs: 0,
        }
    }

    /// Takes the seams of one sample in.
    ///
    /// # Errors
    /// Whatever the matcher reports.
    pub fn add(&mut self, side: Side, seams: &[Seam]) -> anyhow::Result<()> {
        let confidences = self.matcher.confidences(seams)?;
        let all = match side {
            Side::Real => &mut self.real,
            Side::Generated => &mut self.generated,
        };
        all.update(confidences.iter().map(Vec::as_slice));
        self.pairs += seams.len() as u64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn clips(rule: ClipRule, frames: usize) -> Vec<Vec<u32>> {
        let mut cutter = ClipCutter::new(rule);
        let cut = (0..frames).filter_map(|at| cutter.add(vec![at as f32]));
        cut.map(|clip| clip.iter().map(|frame| frame[0] as u32).collect()).collect()
    }

    #[test]
    fn clips_follow_length_stride_step_and_repetition() {
        let rule = ClipRule { length: 3, stride: 1, step: None, repeat: 1, count_condition_frames: false };
        assert_eq!(clips(rule, 7), [[0, 1, 2], [3, 4, 5]]);
        assert_eq!(clips(ClipRule { step: Some(1), ..rule }, 4), [[0, 1, 2], [1, 2, 3]]);
        assert_eq!(clips(ClipRule { stride: 2, ..rule }, 9), [[0, 2, 4]]);
        assert_eq!(clips(ClipRule { length: 2, repeat: 2, ..rule }, 2), [[0, 0, 1, 1]]);
        assert!(clips(rule, 2).is_empty());
    }
}
