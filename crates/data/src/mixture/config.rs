//! Settings of a mixture: how often each dataset, each frame, and in what company.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::class_balance::ClassBalance;
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
    /// Every batch holds frames with one number of views, of any dataset that has such: no padding even where the rigs of a dataset
    /// differ.
    SameViews,
}

/// How often the frames of a dataset are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum FrameSampling {
    /// All alike: every frame once before any frame twice.
    #[default]
    Uniform,
    /// Frames with rare classes more often. In a pass of n draws over n frames, of which n_c hold class c and C classes occur, a frame
    /// is drawn `1 - share + share · n / C · Σ 1 / n_c` times, summed over the classes it holds: each class gets the same number of
    /// draws. Whole numbers follow from pass to pass, each within one of that share. The numbers are found once, from the boxes of all
    /// frames; datasets without boxes are drawn alike.
    ClassBalanced {
        /// Share of the draws that go by class, 0 to 1. At 1, frames without boxes never come.
        #[serde(default = "default_share")]
        share: f64,
        /// Most draws of one frame in a pass, at least 1; what is cut off goes to the others in proportion.
        #[serde(default = "default_max_repeats")]
        max_repeats: f64,
    },
}

impl FrameSampling {
    /// Class-balanced with the default share and cap.
    pub fn class_balanced() -> Self {
        Self::ClassBalanced { share: default_share(), max_repeats: default_max_repeats() }
    }
}

/// Half by class: common scenes stay in the data.
const fn default_share() -> f64 {
    0.5
}

const fn default_max_repeats() -> f64 {
    10.0
}

/// Settings of a [`Mixture`].
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MixtureConfig {
    /// Share of each dataset.
    pub weights: MixtureWeights,
    /// Mixed or uniform batches.
    pub order: MixtureOrder,
    /// Share of each frame within its dataset.
    pub frames: FrameSampling,
}

impl MixtureWeights {
    /// One weight for each dataset.
    pub(super) fn of(&self, datasets: &[Arc<dyn SceneDataset>]) -> Result<Vec<f64>, DataError> {
        let weights = match self {
            Self::Proportional => datasets.iter().map(|d| d.len() as f64).collect(),
            Self::Balanced => vec![1.0; datasets.len()],
            Self::Explicit(weights) => weights.clone(),
        };
        if weights.len() != datasets.len() {
            return Err(DataError::Config(format!("{} weights for {} datasets", weights.len(), datasets.len())));
        }
        if weights.iter().any(|w| !w.is_finite() || *w < 0.0) || weights.iter().sum::<f64>() <= 0.0 {
            let why = format!("mixture weights must be finite, not negative and not all zero: {weights:?}");
            return Err(DataError::Config(why));
        }
        Ok(weights)
    }
}

impl FrameSampling {
    /// For each dataset, how often its frames are drawn in a pass; `None` for one that is drawn evenly.
    pub(super) fn expected_draws(
        &self,
        datasets: &[Arc<dyn SceneDataset>],
    ) -> Result<Vec<Option<Vec<f64>>>, DataError> {
        let Self::ClassBalanced { share, max_repeats } = *self else { return Ok(vec![None; datasets.len()]) };
        let balance = ClassBalance { share, max_repeats };
        balance.validate()?;
        if datasets.iter().all(|dataset| !dataset.capabilities().boxes) {
            let why = "frames are to be drawn by class, but no dataset of the mixture has boxes";
            return Err(DataError::Config(why.to_owned()));
        }
        datasets.iter().map(|dataset| balance.expected_draws(dataset.as_ref())).collect()
    }
}
