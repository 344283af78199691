//! Bird's-eye-view segmentation: intersection over union summed over the whole set, not a mean of per-image values.
//!
//! Zhou & Krähenbühl, "Cross-view Transformers for Real-time Map-view Semantic Segmentation", section 5.

use serde::{Deserialize, Serialize};

/// Cells found, wrongly found and missed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Overlap {
    /// Cells of both.
    pub both: u64,
    /// Predicted cells that are not in the truth.
    pub only_predicted: u64,
    /// Cells of the truth that are not predicted.
    pub only_true: u64,
}

impl Overlap {
    /// Counts one cell.
    pub fn add(&mut self, predicted: bool, truth: bool) {
        match (predicted, truth) {
            (true, true) => self.both += 1,
            (true, false) => self.only_predicted += 1,
            (false, true) => self.only_true += 1,
            (false, false) => {}
        }
    }

    /// Adds the counts of another part of the set.
    pub fn merge(&mut self, other: &Self) {
        self.both += other.both;
        self.only_predicted += other.only_predicted;
        self.only_true += other.only_true;
    }

    /// In [0, 1]; `None` where neither side has a cell.
    #[must_use]
    pub fn iou(&self) -> Option<f64> {
        let union = self.both + self.only_predicted + self.only_true;
        (union > 0).then(|| self.both as f64 / union as f64)
    }
}

/// One class over a range of thresholds on its probability.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SegmentationIou {
    thresholds: Vec<f64>,
    overlaps: Vec<Overlap>,
}

impl SegmentationIou {
    /// A cell is predicted where its probability reaches the threshold.
    #[must_use]
    pub fn new(thresholds: &[f64]) -> Self {
        Self { thresholds: thresholds.to_vec(), overlaps: vec![Overlap::default(); thresholds.len()] }
    }

    /// Adds a raster of probabilities; cells that do not count are left out.
    ///
    /// # Panics
    /// When the rasters differ in size.
    pub fn update(&mut self, probabilities: &[f64], truth: &[bool], counts: Option<&[bool]>) {
        assert_eq!(probabilities.len(), truth.len(), "cells of prediction and truth");
        assert!(counts.is_none_or(|counts| counts.len() == truth.len()), "cells of the mask");
        for (overlap, threshold) in self.overlaps.iter_mut().zip(&self.thresholds) {
            for (at, (probability, truth)) in probabilities.iter().zip(truth).enumerate() {
                if counts.is_none_or(|counts| counts[at]) {
                    overlap.add(probability >= threshold, *truth);
                }
            }
        }
    }

    /// Adds another part of the set.
    ///
    /// # Panics
    /// When the thresholds differ.
    pub fn merge(&mut self, other: &Self) {
        assert_eq!(self.thresholds, other.thresholds, "thresholds");
        self.overlaps.iter_mut().zip(&other.overlaps).for_each(|(a, b)| a.merge(b));
    }

    /// Threshold and counts, in the order given.
    pub fn overlaps(&self) -> impl Iterator<Item = (f64, &Overlap)> {
        self.thresholds.iter().copied().zip(&self.overlaps)
    }

    /// The best IoU over the thresholds (`miou/cvt`); `None` where neither side ever has a cell.
    #[must_use]
    pub fn best(&self) -> Option<f64> {
        self.overlaps.iter().filter_map(Overlap::iou).reduce(f64::max)
    }
}

/// Mean of the classes that occur, and how many do not.
#[must_use]
pub fn mean_iou(classes: &[Option<f64>]) -> (Option<f64>, usize) {
    let found: Vec<f64> = classes.iter().copied().flatten().collect();
    let mean = (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64);
    (mean, classes.len() - found.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_summed_before_they_are_divided() {
        let mut iou = SegmentationIou::new(&[0.5, 0.9]);
        iou.update(&[0.5, 0.4, 0.95, 0.0], &[true, true, true, false], None);
        iou.update(&[0.95, 0.95, 0.0, 0.0], &[true, false, false, false], Some(&[true, true, true, false]));
        let found: Vec<Option<f64>> = iou.overlaps().map(|(_, overlap)| overlap.iou()).collect();
        assert_eq!(found, [Some(3.0 / 5.0), Some(2.0 / 5.0)]);
        assert_eq!(iou.best(), Some(0.6));
        let mut twice = iou.clone();
        twice.merge(&iou);
        assert_eq!(twice.best(), iou.best());
    }

    #[test]
    fn classes_that_never_occur_are_left_out_and_counted() {
        let mut empty = SegmentationIou::new(&[0.5]);
        empty.update(&[0.0; 3], &[false; 3], None);
        assert_eq!(mean_iou(&[empty.best(), Some(0.5), Some(0.7)]), (Some(0.6), 1));
        assert_eq!(mean_iou(&[None]), (None, 1));
    }
}
