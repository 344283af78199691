//! A weighted blend of datasets as an endless list: item `k` of a run is a pure function of `k`, so a run continues from its position
//! alone.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use crate::permutation::Permutation;
use crate::seeding::{Purpose, rng};
use crate::{DataError, SceneDataset};

/// Share of each dataset in an epoch.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MixtureWeights {
    /// By number of frames: an epoch shows every frame once.
    #[default]
    Proportional,
    /// The same number of frames of each dataset.
    Balanced,
    /// Relative weights in the order of the datasets.
    Explicit(Vec<f64>),
}

/// How items of different datasets follow one another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MixtureOrder {
    /// Any batch may hold frames of several datasets.
    #[default]
    Shuffled,
    /// Every batch holds frames of one dataset, hence usually of one rig: no padding.
    Homogeneous,
}

/// Settings of a [`Mixture`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MixtureConfig {
    /// Share of each dataset.
    pub weights: MixtureWeights,
    /// Mixed or uniform batches.
    pub order: MixtureOrder,
}

/// Several datasets blended into one endless, shuffled list.
///
/// An epoch has as many items as there are frames. Each dataset is walked by its own keyed permutation, pass after pass, so that
/// within one pass no frame repeats, whatever its weight.
pub struct Mixture {
    datasets: Vec<Arc<dyn SceneDataset>>,
    /// Blocks per epoch of each dataset; a block is one item, or one batch when homogeneous.
    blocks: Vec<u64>,
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
    /// Blends the datasets. `batch_size` only matters for [`MixtureOrder::Homogeneous`].
    ///
    /// # Errors
    /// [`DataError::Config`] for no datasets, an empty dataset, weights that are negative, not finite, all zero or of another number
    /// than the datasets, and for a weight so small that its dataset would never be drawn.
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
            return refuse(format!("dataset {empty} of the mixture has no frames"));
        }
        let weights = match &config.weights {
            MixtureWeights::Proportional => datasets.iter().map(|d| d.len() as f64).collect(),
            MixtureWeights::Balanced => vec![1.0; datasets.len()],
            MixtureWeights::Explicit(weights) => weights.clone(),
        };
        if weights.len() != datasets.len() {
            return refuse(format!("{} weights for {} datasets", weights.len(), datasets.len()));
        }
        if weights.iter().any(|w| !w.is_finite() || *w < 0.0) || weights.iter().sum::<f64>() <= 0.0 {
            return refuse(format!("mixture weights must be finite, not negative and not all zero: {weights:?}"));
        }
        let block_len = match config.order {
            MixtureOrder::Shuffled => 1,
            MixtureOrder::Homogeneous => batch_size as u64,
        };
        let frames: u64 = datasets.iter().map(|d| d.len() as u64).sum();
        let blocks = largest_remainder(frames.div_ceil(block_len), &weights);
        if let Some(starved) = (0..blocks.len()).find(|i| blocks[*i] == 0 && weights[*i] > 0.0) {
            return refuse(format!("dataset {starved} of the mixture has so small a weight that it is never drawn"));
        }
        Ok(Self { datasets, blocks, block_len, seed })
    }

    /// Items per epoch.
    pub fn epoch_len(&self) -> u64 {
        self.epoch_blocks() * self.block_len
    }

    /// Items per epoch of each dataset; exact in every epoch.
    pub fn epoch_counts(&self) -> Vec<u64> {
        self.blocks.iter().map(|b| b * self.block_len).collect()
    }

    /// Items that follow one another from one dataset: 1, or the batch size of a homogeneous mixture.
    pub fn block_len(&self) -> u64 {
        self.block_len
    }

    /// The datasets in order.
    pub fn datasets(&self) -> &[Arc<dyn SceneDataset>] {
        &self.datasets
    }

    /// The largest number of views any frame has.
    pub fn max_views(&self) -> usize {
        self.datasets.iter().map(|d| d.max_views()).max().unwrap_or(0)
    }

    /// Dataset and frame of item `k` of the run; `k` counts on across epochs.
    pub fn item(&self, k: u64) -> (usize, usize) {
        let (block, within) = (k / self.block_len, k % self.block_len);
        let (epoch, slot) = (block / self.epoch_blocks(), block % self.epoch_blocks());
        let order = Permutation::new(self.epoch_blocks(), &mut rng(self.seed, Purpose::EpochOrder, epoch, 0));
        let mut rank = order.apply(slot);
        let mut dataset = 0;
        while rank >= self.blocks[dataset] {
            rank -= self.blocks[dataset];
            dataset += 1;
        }
        // The dataset's own count of items drawn so far: epoch after epoch without gaps.
        let drawn = (epoch * self.blocks[dataset] + rank) * self.block_len + within;
        let len = self.datasets[dataset].len() as u64;
        let (pass, offset) = (drawn / len, drawn % len);
        let walk = Permutation::new(len, &mut rng(self.seed, Purpose::FrameOrder, dataset as u64, pass));
        (dataset, walk.apply(offset) as usize)
    }

    fn epoch_blocks(&self) -> u64 {
        self.blocks.iter().sum()
    }
}

/// Whole numbers with the given sum, as close to the weights as possible: the floors, then one more for the largest remainders
/// (ties: the earlier).
fn largest_remainder(total: u64, weights: &[f64]) -> Vec<u64> {
    let sum: f64 = weights.iter().sum();
    let quotas: Vec<f64> = weights.iter().map(|w| total as f64 * w / sum).collect();
    let mut counts: Vec<u64> = quotas.iter().map(|q| q.floor() as u64).collect();
    let mut order: Vec<usize> = (0..weights.len()).collect();
    order.sort_by(|a, b| quotas[*b].fract().total_cmp(&quotas[*a].fract()));
    let missing = total.saturating_sub(counts.iter().sum());
    for i in order.into_iter().take(missing as usize) {
        counts[i] += 1;
    }
    counts
}
