//! Do neighbouring views of one sample fit together? Mean confidence of matches between the halves that border each other.
//!
//! MVSC: "Scalable and Generalizable Autonomous Driving Scene Synthesis" (BEV-VAE), section 4.1; VMS: "Panacea", section 4.1.
//! Protocol `mvsc/v1`: pairs lie inside one sample and follow the rig's ring clockwise; an open chain has no pair across its gap.
//! The matcher sees the right half of a view first and the left half of its clockwise neighbour second, in this order always,
//! because LoFTR's result depends on the order of its inputs. A sample without any match counts 0.

use serde::{Deserialize, Serialize};

use crate::{ExactSum, ImageSize, Mean, MetricError};

/// Weights of red, green and blue in grey.
const GREY: [f32; 3] = [0.299, 0.587, 0.114];

/// Cells of the matcher's coarse grid, px: sides of the halves must be whole numbers of them.
const CELL: usize = 8;

/// Two grey pictures `[H, W/2]` in [0, 1] that show the same seam.
#[derive(Debug, Clone, PartialEq)]
pub struct Seam {
    /// Right half of the left view.
    pub left: Vec<f32>,
    /// Left half of its clockwise neighbour.
    pub right: Vec<f32>,
    /// Rows, px.
    pub height: usize,
    /// Columns of a half, px.
    pub width: usize,
}

/// Pairs (view, clockwise neighbour) of one sample, of views that are there, in the order of the views.
///
/// `right_of[i]` is the neighbour of view i as `geometry::Adjacency` tells it.
#[must_use]
pub fn seam_pairs(right_of: &[Option<usize>], present: &[bool]) -> Vec<(usize, usize)> {
    let there = |view: usize| present.get(view).copied().unwrap_or(false);
    let pairs = right_of.iter().enumerate().filter_map(|(view, right)| Some((view, (*right)?)));
    pairs.filter(|(view, right)| there(*view) && there(*right)).collect()
}

/// The halves of two neighbouring views `[3, H, W]` in [0, 1] that border each other.
///
/// # Errors
/// [`MetricError::SeamSize`] for sides that are no whole number of cells.
///
/// # Panics
/// When a length does not fit the size.
pub fn seam(view: &[f32], right: &[f32], size: ImageSize) -> Result<Seam, MetricError> {
    let ImageSize { channels, height, width } = size;
    assert!(channels == 3 && [view, right].iter().all(|image| image.len() == 3 * height * width), "RGB of {size:?}");
    if !height.is_multiple_of(CELL) || !width.is_multiple_of(2 * CELL) || height * width == 0 {
        return Err(MetricError::SeamSize { height, width });
    }
    let half = width / 2;
    let grey = |image: &[f32], first: usize| {
        let plane = height * width;
        let value = |at: usize| GREY.iter().enumerate().map(|(c, weight)| weight * image[c * plane + at]).sum::<f32>();
        (0..height * half).map(|at| value(at / half * width + first + at % half).clamp(0.0, 1.0)).collect()
    };
    Ok(Seam { left: grey(view, half), right: grey(right, 0), height, width: half })
}

/// Collects samples; order, batch size and split over [merged](ViewConsistency::merge) collectors do not change a bit.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ViewConsistency {
    samples: Mean,
    without_match: u64,
    matches: u64,
}

impl ViewConsistency {
    /// Adds a sample: the confidences of each of its pairs, in [0, 1]. Gives the sample's value.
    pub fn update<'a>(&mut self, pairs: impl IntoIterator<Item = &'a [f32]>) -> f64 {
        let (mut sum, mut count) = (ExactSum::default(), 0_u64);
        for confidence in pairs.into_iter().flatten() {
            sum.add(f64::from(*confidence));
            count += 1;
        }
        let value = if count > 0 { sum.value() / count as f64 } else { 0.0 };
        self.samples.add(value);
        self.matches += count;
        self.without_match += u64::from(count == 0);
        value
    }

    /// Adds every sample of another collector.
    pub fn merge(&mut self, other: &Self) {
        self.samples.merge(&other.samples);
        self.without_match += other.without_match;
        self.matches += other.matches;
    }

    /// Mean over samples, the VMS as a fraction; `None` without samples.
    #[must_use]
    pub fn mean(&self) -> Option<f64> {
        self.samples.mean()
    }

    /// Samples seen.
    #[must_use]
    pub fn samples(&self) -> u64 {
        self.samples.count()
    }

    /// Samples in which nothing matched.
    #[must_use]
    pub fn without_match(&self) -> u64 {
        self.without_match
    }

    /// Matches of all samples.
    #[must_use]
    pub fn matches(&self) -> u64 {
        self.matches
    }
}

/// MVSC: generated over real, over the same samples. `None` without samples or where nothing matches in the real ones.
#[must_use]
pub fn mvsc(generated: &ViewConsistency, real: &ViewConsistency) -> Option<f64> {
    let real = real.mean().filter(|mean| *mean > 0.0)?;
    Some(generated.mean()? / real)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairs_follow_the_ring_and_do_not_wrap_over_a_gap() {
        let closed = [1, 2, 0].map(Some);
        assert_eq!(seam_pairs(&closed, &[true; 3]), [(0, 1), (1, 2), (2, 0)]);
        assert_eq!(seam_pairs(&closed, &[true, false, true]), [(2, 0)]);
        assert_eq!(seam_pairs(&[Some(1), Some(2), None], &[true; 3]), [(0, 1), (1, 2)]);
        assert_eq!(seam_pairs(&[None, Some(0)], &[true; 2]), [(1, 0)]);
        assert!(seam_pairs(&[None], &[true]).is_empty());
    }

    #[test]
    fn halves_border_each_other() {
        let size = ImageSize { channels: 3, height: 8, width: 16 };
        let ramp: Vec<f32> = (0..3 * 8 * 16).map(|at| (at % 16) as f32 / 16.0).collect();
        let found = seam(&ramp, &ramp, size).unwrap();
        assert_eq!((found.height, found.width, found.left.len()), (8, 8, 64));
        assert!(
            (found.left[0] - 0.5).abs() < 1e-6 && found.right[0] == 0.0 && (found.right[7] - 7.0 / 16.0).abs() < 1e-6
        );
        let odd = ImageSize { width: 24, ..size };
        assert!(matches!(seam(&[0.0; 576], &[0.0; 576], odd), Err(MetricError::SeamSize { width: 24, .. })));
    }

    #[test]
    fn samples_count_alike_in_any_order() {
        let samples: [&[&[f32]]; 3] = [&[&[0.1, 0.3], &[0.8]], &[&[], &[]], &[&[0.7], &[0.2, 0.9, 0.4]]];
        let collect = |order: &[usize]| {
            let mut all = ViewConsistency::default();
            order.iter().for_each(|i| _ = all.update(samples[*i].iter().copied()));
            all
        };
        let whole = collect(&[0, 1, 2]);
        assert_eq!((whole.samples(), whole.without_match(), whole.matches()), (3, 1, 7));
        assert!((whole.mean().unwrap() - (0.4 + 0.0 + 0.55) / 3.0).abs() < 1e-7);
        assert_eq!(collect(&[2, 0, 1]), whole);
        let mut merged = collect(&[2]);
        merged.merge(&collect(&[1, 0]));
        assert_eq!(merged, whole);
        assert_eq!(mvsc(&whole, &whole), Some(1.0));
        assert_eq!(mvsc(&whole, &collect(&[1])), None);
    }
}
