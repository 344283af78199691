//! A weighted blend of datasets as an endless list: item `k` of a run is a pure function of `k`, so a run continues from its position
//! alone.

mod class_balance;
mod clip_starts;
mod config;
mod plan;
mod walk;

use std::sync::Arc;

pub use config::{FrameSampling, MixtureConfig, MixtureOrder, MixtureWeights};

use clip_starts::ClipStarts;
use plan::{Group, by_dataset, by_views, share_out};

use crate::permutation::Permutation;
use crate::seeding::{Purpose, rng};
use crate::{Clips, DataError, SceneDataset};

/// Several datasets blended into one endless, shuffled list.
///
/// An epoch has as many items as there are frames. Each dataset is walked by its own keyed permutation, pass after pass, so that
/// within one pass no frame repeats (unless draws are class-balanced), whatever the dataset's weight.
pub struct Mixture {
    datasets: Vec<Arc<dyn SceneDataset>>,
    /// For a mixture of clips, those of each dataset.
    clips: Vec<Arc<Clips>>,
    groups: Vec<Group>,
    /// Items per block.
    block_len: u64,
    seed: u64,
}

impl std::fmt::Debug for Mixture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let lens: Vec<usize> = self.datasets.iter().map(|d| d.len()).collect();
        f.debug_struct("Mixture").field("frames", &lens).field("epoch_counts", &self.epoch_counts()).finish()
    }
}

impl Mixture {
    /// Blends the datasets. `batch_size` only matters where batches are uniform.
    ///
    /// # Errors
    /// [`DataError::Config`] for no datasets, an empty dataset, weights that are negative, not finite, all zero or of another number
    /// than the datasets, and for a weight so small that its dataset would never be drawn; for class-balanced draws without any boxes;
    /// errors of frames where draws or batches depend on them.
    pub fn new(
        datasets: Vec<Arc<dyn SceneDataset>>,
        config: &MixtureConfig,
        batch_size: usize,
        seed: u64,
    ) -> Result<Self, DataError> {
        let refuse = |why: String| Err(DataError::Config(why));
        if datasets.is_empty() {
            return refuse("a mixture needs at least one dataset".into());
        }
        if batch_size == 0 {
            return refuse("the batch size must be at least 1".into());
        }
        if let Some(empty) = datasets.iter().position(|d| d.is_empty()) {
            return refuse(format!("dataset {empty} of the mixture has no frames or clips"));
        }
        let weights = config.weights.of(&datasets)?;
        let draws = config.frames.expected_draws(&datasets)?;
        let block_len = match config.order {
            MixtureOrder::Shuffled => 1,
            MixtureOrder::Homogeneous | MixtureOrder::SameViews => batch_size as u64,
        };
        let planned = match config.order {
            MixtureOrder::Shuffled | MixtureOrder::Homogeneous => by_dataset(&datasets, &weights, &draws),
            MixtureOrder::SameViews => by_views(&datasets, &weights, &draws)?,
        };
        let frames: u64 = datasets.iter().map(|d| d.len() as u64).sum();
        let groups = share_out(planned, frames.div_ceil(block_len), block_len)?;
        Ok(Self { datasets, clips: Vec::new(), groups, block_len, seed })
    }

    /// Blends clips: an item is a clip, and what [`Mixture::new`] says about frames holds for them. A clip counts for the views of its
    /// first frame and the classes of all its frames.
    ///
    /// The clips of one batch have one length. Datasets whose clips differ in length therefore need [`MixtureOrder::Homogeneous`].
    ///
    /// # Errors
    /// As [`Mixture::new`], and [`DataError::Config`] for clips of different lengths in any other order.
    pub fn of_clips(
        clips: Vec<Arc<Clips>>,
        config: &MixtureConfig,
        batch_size: usize,
        seed: u64,
    ) -> Result<Self, DataError> {
        let mut lengths: Vec<usize> = clips.iter().map(|clips| clips.config().frames).collect();
        lengths.sort_unstable();
        lengths.dedup();
        if lengths.len() > 1 && config.order != MixtureOrder::Homogeneous {
            return Err(DataError::Config(format!(
                "clips of {lengths:?} frames cannot share a batch; set mixture.order to \"homogeneous\""
            )));
        }
        let starts = clips.iter().map(|clips| Arc::new(ClipStarts(clips.clone())) as Arc<dyn SceneDataset>).collect();
        Ok(Self { clips, ..Self::new(starts, config, batch_size, seed)? })
    }

    /// True for a mixture of clips.
    pub fn has_clips(&self) -> bool {
        !self.clips.is_empty()
    }

    /// Frames of item `k`: 1, or the length of the clip it is.
    pub fn item_frames(&self, k: u64) -> usize {
        if self.clips.is_empty() { 1 } else { self.clips[self.item(k).0].config().frames }
    }

    /// Dataset number, dataset and frame index of frame `at` of item `k`.
    ///
    /// # Errors
    /// [`DataError::Config`] where the item has fewer frames.
    pub(crate) fn item_frame(&self, k: u64, at: usize) -> Result<(usize, &dyn SceneDataset, usize), DataError> {
        let (number, index) = self.item(k);
        let none = || DataError::Config(format!("item {k} of the mixture has no frame {at}"));
        match self.clips.get(number) {
            Some(clips) => {
                let frame = clips.frame_indices(index)?.get(at).copied().ok_or_else(none)?;
                Ok((number, clips.dataset().as_ref(), frame))
            }
            None if at == 0 => Ok((number, self.datasets[number].as_ref(), index)),
            None => Err(none()),
        }
    }

    /// Items per epoch.
    pub fn epoch_len(&self) -> u64 {
        self.epoch_blocks() * self.block_len
    }

    /// Items per epoch of each dataset; exact in every epoch.
    pub fn epoch_counts(&self) -> Vec<u64> {
        let mut counts = vec![0; self.datasets.len()];
        self.groups.iter().flat_map(|group| &group.parts).for_each(|part| counts[part.dataset] += part.draws);
        counts
    }

    /// Items that follow one another from one group: 1, or the batch size where batches are uniform.
    pub fn block_len(&self) -> u64 {
        self.block_len
    }

    /// The datasets in order; those of clips have one frame for each clip, its first.
    pub fn datasets(&self) -> &[Arc<dyn SceneDataset>] {
        &self.datasets
    }

    /// The largest number of views any frame has.
    pub fn max_views(&self) -> usize {
        self.datasets.iter().map(|d| d.max_views()).max().unwrap_or(0)
    }

    /// Dataset and frame (or clip) of item `k` of the run; `k` counts on across epochs.
    pub fn item(&self, k: u64) -> (usize, usize) {
        let (block, within) = (k / self.block_len, k % self.block_len);
        let (epoch, slot) = (block / self.epoch_blocks(), block % self.epoch_blocks());
        let order = Permutation::new(self.epoch_blocks(), &mut rng(self.seed, Purpose::EpochOrder, epoch, 0));
        let mut rank = order.apply(slot);
        let mut group = 0;
        while rank >= self.groups[group].blocks {
            rank -= self.groups[group].blocks;
            group += 1;
        }
        let group = &self.groups[group];
        let (part, nth) = group.part(epoch, rank * self.block_len + within, self.seed);
        // The part's own count of items drawn so far: epoch after epoch without gaps.
        (part.dataset, part.walk.frame(epoch * part.draws + nth, self.seed))
    }

    fn epoch_blocks(&self) -> u64 {
        self.groups.iter().map(|group| group.blocks).sum()
    }
}
