//! How much of the generated set looks real, and how much of the real set is generated.
//!
//! Kynkäänniemi et al., "Improved Precision and Recall Metric for Assessing Generative Models", equations 1 and 2: a
//! set's manifold is the union of balls around its samples that reach to their k-th nearest neighbour.

use faer::MatRef;
use serde::Serialize;

use crate::{FeatureRows, MetricError};

/// Rows compared at once, so that memory grows with the number of rows and not with its square.
const BLOCK: usize = 256;

/// Both shares, in [0, 1].
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PrecisionRecall {
    /// Share of generated samples inside the real manifold.
    pub precision: f64,
    /// Share of real samples inside the generated manifold.
    pub recall: f64,
}

/// With balls to the `neighbours`-th nearest other sample (3 in the paper).
///
/// # Errors
/// [`MetricError::Width`] for different features, [`MetricError::TooFew`] for a set of no more than `neighbours` samples.
pub fn precision_recall(
    real: &FeatureRows,
    generated: &FeatureRows,
    neighbours: usize,
) -> Result<PrecisionRecall, MetricError> {
    if real.width() != generated.width() {
        let what = "the generated set".to_owned();
        return Err(MetricError::Width { what, found: generated.width(), expected: real.width() });
    }
    for (what, set) in [("the real set", real), ("the generated set", generated)] {
        if set.len() <= neighbours {
            return Err(MetricError::TooFew { what: what.to_owned(), found: set.len(), needed: neighbours + 1 });
        }
    }
    let (real, generated) = (Points::of(real), Points::of(generated));
    let precision = generated.share_inside(&real, &real.radii(neighbours));
    let recall = real.share_inside(&generated, &generated.radii(neighbours));
    Ok(PrecisionRecall { precision, recall })
}

/// Rows with their squared lengths.
struct Points {
    values: Vec<f64>,
    width: usize,
    squares: Vec<f64>,
}

impl Points {
    fn of(rows: &FeatureRows) -> Self {
        let values = rows.widened();
        let squares = values.chunks_exact(rows.width()).map(|row| row.iter().map(|x| x * x).sum()).collect();
        Self { values, width: rows.width(), squares }
    }

    /// Squared distances of the rows from `start` on to all of `others`, row by row.
    fn distances(&self, start: usize, others: &Self) -> Vec<Vec<f64>> {
        let end = (start + BLOCK).min(self.squares.len());
        let a =
            MatRef::from_row_major_slice(&self.values[start * self.width..end * self.width], end - start, self.width);
        let b = MatRef::from_row_major_slice(&others.values, others.squares.len(), self.width);
        let products = a * b.transpose();
        let row = |i: usize| {
            let pairs = products.row(i).iter().zip(&others.squares);
            pairs.map(|(product, square)| (self.squares[start + i] + square - 2.0 * product).max(0.0)).collect()
        };
        (0..end - start).map(row).collect()
    }

    /// Squared distance of each row to its k-th nearest other row.
    fn radii(&self, neighbours: usize) -> Vec<f64> {
        let mut radii = Vec::with_capacity(self.squares.len());
        for start in (0..self.squares.len()).step_by(BLOCK) {
            for (i, mut row) in self.distances(start, self).into_iter().enumerate() {
                // Rounding must not push the row itself behind a duplicate.
                row.swap_remove(start + i);
                let place = neighbours.saturating_sub(1).min(row.len().saturating_sub(1));
                radii.push(*row.select_nth_unstable_by(place, f64::total_cmp).1);
            }
        }
        radii
    }

    fn share_inside(&self, others: &Self, radii: &[f64]) -> f64 {
        let mut inside = 0;
        for start in (0..self.squares.len()).step_by(BLOCK) {
            let rows = self.distances(start, others);
            inside += rows.iter().filter(|row| row.iter().zip(radii).any(|(apart, radius)| apart <= radius)).count();
        }
        inside as f64 / self.squares.len() as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(values: impl Iterator<Item = f32>) -> FeatureRows {
        FeatureRows::new(1, values.collect()).unwrap()
    }

    #[test]
    fn a_narrow_set_is_precise_and_recalls_little() {
        let real = line((0..300).map(|i| i as f32));
        let narrow = line((0..300).map(|i| 100.0 + i as f32 * 0.125));
        let found = precision_recall(&real, &narrow, 3).unwrap();
        assert_eq!(found.precision, 1.0);
        // 100 to 137 lie between generated samples; the balls at the ends reach 0.375 further.
        assert_eq!(found.recall, 38.0 / 300.0);
        let swapped = precision_recall(&narrow, &real, 3).unwrap();
        assert_eq!((swapped.precision, swapped.recall), (found.recall, found.precision));
    }

    #[test]
    fn equal_and_distant_sets() {
        let real = line((0..10).map(|i| i as f32));
        let same = precision_recall(&real, &real, 3).unwrap();
        assert_eq!((same.precision, same.recall), (1.0, 1.0));
        let far = line((0..10).map(|i| 1000.0 + i as f32));
        let apart = precision_recall(&real, &far, 3).unwrap();
        assert_eq!((apart.precision, apart.recall), (0.0, 0.0));
        assert!(matches!(precision_recall(&real, &line([0.0; 3].into_iter()), 3), Err(MetricError::TooFew { .. })));
    }
}
