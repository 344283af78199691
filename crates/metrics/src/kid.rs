//! Kernel Inception distance: the unbiased squared maximum mean discrepancy with the kernel `(x·y / D + 1)³`.
//!
//! Bińkowski et al., "Demystifying MMD GANs", equation 4 and section 4.

use faer::MatRef;
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use crate::{FeatureRows, MetricError};

/// Which subsets are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KidSubsets {
    /// How many.
    pub count: usize,
    /// Samples of each side in one; a smaller set is taken whole.
    pub size: usize,
    /// Of the choice.
    pub seed: u64,
}

impl Default for KidSubsets {
    fn default() -> Self {
        Self { count: 100, size: 1000, seed: 0 }
    }
}

/// Mean and population deviation over subsets.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Kid {
    /// Mean over subsets; may be below 0, the estimate is unbiased.
    pub mean: f64,
    /// Population deviation over subsets.
    pub deviation: f64,
    /// Samples of each side in a subset.
    pub subset_size: usize,
}

/// The distance over random subsets without repetition.
///
/// # Errors
/// As [`polynomial_mmd`].
pub fn kid(a: &FeatureRows, b: &FeatureRows, subsets: &KidSubsets) -> Result<Kid, MetricError> {
    let size = subsets.size.min(a.len()).min(b.len());
    let mut rng = ChaCha8Rng::seed_from_u64(subsets.seed);
    let mut values = Vec::with_capacity(subsets.count.max(1));
    for _ in 0..subsets.count.max(1) {
        let mut choose = |rows: &FeatureRows| rows.select(&sample(&mut rng, rows.len(), size).into_vec());
        let (a, b) = (choose(a), choose(b));
        values.push(polynomial_mmd(&a, &b)?);
    }
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let spread = values.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / values.len() as f64;
    Ok(Kid { mean, deviation: spread.sqrt(), subset_size: size })
}

/// The unbiased estimate over all pairs.
///
/// # Errors
/// [`MetricError::Width`] for different features, [`MetricError::TooFew`] below two samples on a side.
pub fn polynomial_mmd(a: &FeatureRows, b: &FeatureRows) -> Result<f64, MetricError> {
    if a.width() != b.width() {
        return Err(MetricError::Width { what: "the second set".into(), found: b.width(), expected: a.width() });
    }
    for (what, set) in [("the first set", a), ("the second set", b)] {
        if set.len() < 2 {
            return Err(MetricError::TooFew { what: what.to_owned(), found: set.len(), needed: 2 });
        }
    }
    let within = |set: &FeatureRows| {
        let (all, diagonal) = kernel_sums(set, set);
        (all - diagonal) / (set.len() * (set.len() - 1)) as f64
    };
    let between = kernel_sums(a, b).0 / (a.len() * b.len()) as f64;
    Ok(within(a) + within(b) - 2.0 * between)
}

/// Sum of the kernel over all pairs, and over pairs of equal position.
fn kernel_sums(a: &FeatureRows, b: &FeatureRows) -> (f64, f64) {
    let (values_a, values_b) = (a.widened(), b.widened());
    let a = MatRef::from_row_major_slice(&values_a, a.len(), a.width());
    let b = MatRef::from_row_major_slice(&values_b, b.len(), b.width());
    let products = a * b.transpose();
    let width = a.ncols() as f64;
    let (mut all, mut diagonal) = (0.0, 0.0);
    for (j, column) in products.col_iter().enumerate() {
        let kernel = |product: &f64| (product / width + 1.0).powi(3);
        all += column.iter().map(kernel).sum::<f64>();
        diagonal += column.iter().nth(j).map_or(0.0, kernel);
    }
    (all, diagonal)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rows(values: &[f32]) -> FeatureRows {
        FeatureRows::new(1, values.to_vec()).unwrap()
    }

    #[test]
    fn a_case_by_hand() {
        // k(0, 0) = 1, k(1, 1) = 8, k(0, 1) = 1, k(1, 2) = 27, k(0, 2) = 1.
        let found = polynomial_mmd(&rows(&[0.0, 1.0]), &rows(&[1.0, 2.0])).unwrap();
        let between = (1.0 + 1.0 + 8.0 + 27.0) / 4.0;
        assert!((found - (1.0 + 27.0 - 2.0 * between)).abs() < 1e-12);
    }

    #[test]
    fn subsets_follow_the_seed() {
        let a = rows(&(0..40).map(|i| i as f32 * 0.1).collect::<Vec<_>>());
        let b = rows(&(0..50).map(|i| i as f32 * 0.1 + 1.0).collect::<Vec<_>>());
        let with = |seed| kid(&a, &b, &KidSubsets { count: 10, size: 16, seed }).unwrap();
        assert_eq!(with(1), with(1));
        assert_ne!(with(1), with(2));
        assert!(with(1).deviation > 0.0 && with(1).subset_size == 16);
        let whole = kid(&a, &b, &KidSubsets { count: 3, size: 1000, seed: 0 }).unwrap();
        assert_eq!(whole.subset_size, 40);
    }

    #[test]
    fn lonely_samples_and_other_features_are_refused() {
        assert!(matches!(polynomial_mmd(&rows(&[0.0]), &rows(&[0.0, 1.0])), Err(MetricError::TooFew { .. })));
        let wide = FeatureRows::new(2, vec![0.0; 4]).unwrap();
        assert!(matches!(polynomial_mmd(&rows(&[0.0, 1.0]), &wide), Err(MetricError::Width { .. })));
    }
}
