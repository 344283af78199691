//! Running mean and covariance of feature rows, in memory that does not grow with the number of rows.
//!
//! Blocks of rows are centred on their own mean before their products are taken, and joined by Chan, Golub & LeVeque,
//! "Updating Formulae and a Pairwise Algorithm for Computing Sample Variances", equation 2.1, so that features far from
//! zero lose no digits. Letters: N rows, D numbers per row.

use faer::linalg::matmul::triangular::{BlockStructure, matmul};
use faer::{Accum, MatMut, MatRef, Par};

use crate::MetricError;

/// Rows whose products are taken at once. Blocks follow the order of the rows, so batch sizes do not matter.
const BLOCK: usize = 64;

/// Collects rows.
///
/// The order of rows and the split over [merged](Moments::merge) collectors change the result by rounding only.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    width: usize,
    /// Rows of the blocks done.
    count: usize,
    mean: Vec<f64>,
    /// Sum of products of deviations from the mean, `[D, D]` column by column, lower triangle.
    scatter: Vec<f64>,
    /// Rows of the block that is not full, `[n, D]`.
    waiting: Vec<f32>,
}

/// Mean and covariance of a set of features, and how many there were.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureStatistics {
    /// Samples; `None` where a file of another program does not tell.
    pub count: Option<usize>,
    /// `[D]`.
    pub mean: Vec<f64>,
    /// `[D, D]`, symmetric, divisor `count - 1`.
    pub covariance: Vec<f64>,
}

impl FeatureStatistics {
    /// Numbers per sample.
    #[must_use]
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// Highest rank that a covariance of this many samples can have.
    #[must_use]
    pub fn highest_rank(&self) -> usize {
        self.width().min(self.count.map_or(usize::MAX, |count| count.saturating_sub(1)))
    }
}

impl Moments {
    /// For rows of D numbers.
    #[must_use]
    pub fn new(width: usize) -> Self {
        Self { width, count: 0, mean: vec![0.0; width], scatter: vec![0.0; width * width], waiting: Vec::new() }
    }

    /// Rows seen.
    #[must_use]
    pub fn count(&self) -> usize {
        self.count + self.waiting.len().checked_div(self.width).unwrap_or(0)
    }

    /// Adds rows `[N, D]`.
    ///
    /// # Errors
    /// [`MetricError::Width`] for rows of another length, [`MetricError::NotFinite`] for NaN and infinity; then none of
    /// the rows is taken.
    pub fn update(&mut self, rows: &[f32]) -> Result<(), MetricError> {
        if self.width == 0 || !rows.len().is_multiple_of(self.width) {
            let what = "a batch of features".to_owned();
            return Err(MetricError::Width { what, found: rows.len(), expected: self.width });
        }
        if let Some(place) = rows.iter().position(|value| !value.is_finite()) {
            return Err(MetricError::NotFinite { sample: self.count() + place / self.width });
        }
        for row in rows.chunks_exact(self.width) {
            self.waiting.extend_from_slice(row);
            if self.waiting.len() == BLOCK * self.width {
                self.close_block();
            }
        }
        Ok(())
    }

    /// Adds every row of another collector.
    ///
    /// # Errors
    /// [`MetricError::Width`] for a collector of other rows.
    pub fn merge(&mut self, mut other: Self) -> Result<(), MetricError> {
        if other.width != self.width {
            let what = "features of another shard".to_owned();
            return Err(MetricError::Width { what, found: other.width, expected: self.width });
        }
        self.close_block();
        other.close_block();
        self.scatter.iter_mut().zip(&other.scatter).for_each(|(sum, more)| *sum += more);
        self.join(other.count, &other.mean);
        Ok(())
    }

    /// Mean and covariance.
    ///
    /// # Errors
    /// [`MetricError::TooFew`] below two rows.
    pub fn statistics(&self, what: &str) -> Result<FeatureStatistics, MetricError> {
        let mut whole = self.clone();
        whole.close_block();
        if whole.count < 2 {
            return Err(MetricError::TooFew { what: what.to_owned(), found: whole.count, needed: 2 });
        }
        let (width, scale) = (self.width, 1.0 / (whole.count - 1) as f64);
        let covariance = (0..width * width).map(|at| {
            let (column, row) = (at / width, at % width);
            whole.scatter[row.min(column) * width + row.max(column)] * scale
        });
        Ok(FeatureStatistics { count: Some(whole.count), covariance: covariance.collect(), mean: whole.mean })
    }

    /// Takes the waiting rows in.
    fn close_block(&mut self) {
        let rows = std::mem::take(&mut self.waiting);
        let count = rows.len().checked_div(self.width).unwrap_or(0);
        if count == 0 {
            return;
        }
        let mut mean = vec![0.0; self.width];
        for row in rows.chunks_exact(self.width) {
            mean.iter_mut().zip(row).for_each(|(sum, value)| *sum += f64::from(*value));
        }
        mean.iter_mut().for_each(|sum| *sum /= count as f64);
        let centred: Vec<f64> = rows.iter().zip(mean.iter().cycle()).map(|(x, mean)| f64::from(*x) - mean).collect();
        self.add_products(&centred, count);
        self.join(count, &mean);
        // Its memory serves the next block.
        self.waiting = rows;
        self.waiting.clear();
    }

    /// `scatter += rowsᵀ · rows`, lower triangle.
    fn add_products(&mut self, rows: &[f64], count: usize) {
        let rows = MatRef::from_row_major_slice(rows, count, self.width);
        let scatter = MatMut::from_column_major_slice_mut(&mut self.scatter, self.width, self.width);
        let (lower, all) = (BlockStructure::TriangularLower, BlockStructure::Rectangular);
        matmul(scatter, lower, Accum::Add, rows.transpose(), all, rows, all, 1.0, Par::Seq);
    }

    /// Moves the mean and adds what the distance of the two means brings.
    fn join(&mut self, count: usize, mean: &[f64]) {
        if count == 0 {
            return;
        }
        let total = (self.count + count) as f64;
        let apart: Vec<f64> = mean.iter().zip(&self.mean).map(|(new, old)| new - old).collect();
        let weight = self.count as f64 * count as f64 / total;
        if weight > 0.0 {
            self.add_products(&apart.iter().map(|value| value * weight.sqrt()).collect::<Vec<_>>(), 1);
        }
        self.mean.iter_mut().zip(apart).for_each(|(old, apart)| *old += apart * count as f64 / total);
        self.count += count;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deterministic rows that are far from zero.
    fn rows(count: usize, width: usize, offset: f32) -> Vec<f32> {
        (0..count * width).map(|i| offset + ((i * i * 7 + i * 13) % 101) as f32 / 17.0).collect()
    }

    fn collect(rows: &[f32], width: usize, batch: usize) -> Moments {
        let mut moments = Moments::new(width);
        rows.chunks(batch * width).for_each(|batch| moments.update(batch).unwrap());
        moments
    }

    fn assert_close(a: &FeatureStatistics, b: &FeatureStatistics, relative: f64) {
        assert_eq!(a.count, b.count);
        let scale = b.covariance.iter().fold(0.0_f64, |most, value| most.max(value.abs()));
        let pairs = a.mean.iter().zip(&b.mean).chain(a.covariance.iter().zip(&b.covariance));
        for (a, b) in pairs {
            assert!((a - b).abs() <= relative * scale.max(b.abs()), "{a} against {b}");
        }
    }

    #[test]
    fn two_pass_formula_gives_the_same() {
        let (count, width) = (150, 5);
        let rows = rows(count, width, 0.0);
        let found = collect(&rows, width, 7).statistics("a").unwrap();
        let column = |d: usize| rows.iter().skip(d).step_by(width).map(|x| f64::from(*x));
        let mean: Vec<f64> = (0..width).map(|d| column(d).sum::<f64>() / count as f64).collect();
        let covariance = (0..width * width).map(|at| {
            let (i, j) = (at / width, at % width);
            let products = column(i).zip(column(j)).map(|(a, b)| (a - mean[i]) * (b - mean[j]));
            products.sum::<f64>() / (count - 1) as f64
        });
        let expected = FeatureStatistics { count: Some(count), covariance: covariance.collect(), mean: mean.clone() };
        assert_close(&found, &expected, 1e-13);
    }

    #[test]
    fn batch_sizes_change_no_bit_and_shards_only_rounding() {
        let (width, rows) = (6, rows(200, 6, 3.0));
        let whole = collect(&rows, width, 200).statistics("a").unwrap();
        for batch in [1, 3, 7, 64, 100] {
            assert_eq!(collect(&rows, width, batch).statistics("a").unwrap(), whole);
        }
        for split in [0, 1, 50, 64, 199, 200] {
            let mut merged = collect(&rows[split * width..], width, 5);
            merged.merge(collect(&rows[..split * width], width, 9)).unwrap();
            assert_close(&merged.statistics("a").unwrap(), &whole, 1e-13);
        }
    }

    #[test]
    fn an_offset_costs_no_digits() {
        let (width, near) = (4, rows(300, 4, 0.0));
        // Multiples of 2^-6 stay exact in f32 at 1e4.
        let near: Vec<f32> = near.iter().map(|x| (x * 64.0).round() / 64.0).collect();
        let far: Vec<f32> = near.iter().map(|x| x + 1e4).collect();
        let (near, far) = (collect(&near, width, 32), collect(&far, width, 32));
        let (near, mut far) = (near.statistics("a").unwrap(), far.statistics("a").unwrap());
        far.mean.iter_mut().for_each(|mean| *mean -= 1e4);
        assert_close(&far, &near, 1e-11);
    }

    #[test]
    fn broken_rows_are_refused_whole() {
        let mut moments = Moments::new(3);
        assert!(matches!(moments.update(&[0.0; 4]), Err(MetricError::Width { found: 4, expected: 3, .. })));
        let bad = [0.0, 1.0, 2.0, 3.0, f32::NAN, 5.0];
        assert_eq!(moments.update(&bad), Err(MetricError::NotFinite { sample: 1 }));
        moments.update(&bad[..3]).unwrap();
        assert!(matches!(moments.statistics("real"), Err(MetricError::TooFew { found: 1, needed: 2, .. })));
        assert!(moments.merge(Moments::new(2)).is_err());
        assert_eq!(moments.count(), 1);
    }
}
