//! How many items of an epoch come from where.

use std::collections::BTreeMap;
use std::sync::Arc;

use rayon::prelude::*;

use super::walk::Walk;
use crate::permutation::Permutation;
use crate::seeding::{Purpose, rng};
use crate::{DataError, SceneDataset};

/// Frames that may share a block: those of a dataset, or those with one number of views.
pub(super) struct Group {
    /// Blocks per epoch; a block is one item, or one batch where batches are uniform.
    pub blocks: u64,
    /// Number of views where that is what its frames share, else 0.
    views: u64,
    pub parts: Vec<Part>,
}

/// The frames of one dataset in a group.
pub(super) struct Part {
    pub dataset: usize,
    /// Items per epoch.
    pub draws: u64,
    pub walk: Walk,
}

/// A part before its number of draws is known.
pub(super) struct Planned {
    pub dataset: usize,
    pub weight: f64,
    pub walk: Walk,
}

impl Group {
    /// The part that item `at` of the group's epoch comes from, and the item's number among those of the part.
    pub fn part(&self, epoch: u64, at: u64, seed: u64) -> (&Part, u64) {
        let mut rank = at;
        let mut chosen = 0;
        if self.parts.len() > 1 {
            let items = self.parts.iter().map(|part| part.draws).sum();
            rank = Permutation::new(items, &mut rng(seed, Purpose::BucketOrder, epoch, self.views)).apply(at);
            while rank >= self.parts[chosen].draws {
                rank -= self.parts[chosen].draws;
                chosen += 1;
            }
        }
        (&self.parts[chosen], rank)
    }
}

/// One group of each dataset.
pub(super) fn by_dataset(
    datasets: &[Arc<dyn SceneDataset>],
    weights: &[f64],
    draws: &[Option<Vec<f64>>],
) -> Vec<(u64, Vec<Planned>)> {
    let group = |(dataset, (weight, draws)): (usize, (&f64, &Option<Vec<f64>>))| {
        let walk = match draws {
            Some(draws) => Walk::weighted(None, draws, dataset as u64),
            None => Walk::even(None, datasets[dataset].len(), dataset as u64),
        };
        (0, vec![Planned { dataset, weight: *weight, walk }])
    };
    weights.iter().zip(draws).enumerate().map(group).collect()
}

/// One group of each number of views.
pub(super) fn by_views(
    datasets: &[Arc<dyn SceneDataset>],
    weights: &[f64],
    draws: &[Option<Vec<f64>>],
) -> Result<Vec<(u64, Vec<Planned>)>, DataError> {
    let mut groups: BTreeMap<u64, Vec<Planned>> = BTreeMap::new();
    for (dataset, weight) in weights.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
        let views_of = |frame: usize| Ok(datasets[dataset].outline(frame)?.rig.len() as u64);
        let views: Result<Vec<u64>, DataError> = (0..datasets[dataset].len()).into_par_iter().map(views_of).collect();
        let mut buckets: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
        for (frame, views) in views?.into_iter().enumerate() {
            buckets.entry(views).or_default().push(frame);
        }
        for (views, frames) in buckets {
            let stream = views << 32 | dataset as u64;
            let (mass, walk) = match &draws[dataset] {
                Some(draws) => {
                    let of_bucket: Vec<f64> = frames.iter().map(|frame| draws[*frame]).collect();
                    let mass = of_bucket.iter().sum();
                    // Frames that are never drawn make no part.
                    if mass <= 0.0 {
                        continue;
                    }
                    (mass, Walk::weighted(Some(frames), &of_bucket, stream))
                }
                None => (frames.len() as f64, Walk::even(Some(frames.clone()), frames.len(), stream)),
            };
            let weight = weight * mass / datasets[dataset].len() as f64;
            groups.entry(views).or_default().push(Planned { dataset, weight, walk });
        }
    }
    Ok(groups.into_iter().collect())
}

/// Gives every group its whole number of blocks and every part its whole number of items.
///
/// # Errors
/// [`DataError::Config`] where something of a positive weight would never be drawn.
pub(super) fn share_out(
    planned: Vec<(u64, Vec<Planned>)>,
    blocks: u64,
    block_len: u64,
) -> Result<Vec<Group>, DataError> {
    let weight = |group: &(u64, Vec<Planned>)| group.1.iter().map(|part| part.weight).sum::<f64>();
    let weights: Vec<f64> = planned.iter().map(weight).collect();
    let shares = largest_remainder(blocks, &weights);
    let mut groups = Vec::new();
    for ((views, parts), blocks) in planned.into_iter().zip(shares) {
        let weights: Vec<f64> = parts.iter().map(|part| part.weight).collect();
        let draws = largest_remainder(blocks * block_len, &weights);
        if let Some((part, _)) = parts.iter().zip(&draws).find(|(part, draws)| **draws == 0 && part.weight > 0.0) {
            let dataset = part.dataset;
            let which = if views > 0 { format!(" with {views} views") } else { String::new() };
            let why = format!("dataset {dataset} of the mixture{which} has so small a weight that it is never drawn");
            return Err(DataError::Config(why));
        }
        let part = |(part, draws): (Planned, u64)| Part { dataset: part.dataset, draws, walk: part.walk };
        groups.push(Group { blocks, views, parts: parts.into_iter().zip(draws).map(part).collect() });
    }
    Ok(groups)
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
