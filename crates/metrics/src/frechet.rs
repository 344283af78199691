//! Fréchet distance between two Gaussians: FID over pictures, FVD over clips.
//!
//! Heusel et al., "GANs Trained by a Two Time-Scale Update Rule Converge to a Local Nash Equilibrium", equation 6:
//! `‖μ₁ - μ₂‖² + tr Σ₁ + tr Σ₂ - 2 tr (Σ₁Σ₂)^½`. With factors `Σ = L Lᵀ` the last trace is the sum of the singular values
//! of `L₁ᵀ L₂`, which needs no square root of a singular matrix: covariances of fewer samples than features are exact too.

use faer::{Mat, MatRef, Side};

use crate::{FeatureStatistics, MetricError};

/// A distance and what it is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrechetDistance {
    /// The distance, at least 0.
    pub value: f64,
    /// `‖μ₁ - μ₂‖²`.
    pub mean_part: f64,
    /// `tr Σ₁ + tr Σ₂`, the scale of its rounding errors.
    pub trace_sum: f64,
    /// Ranks of the two covariances.
    pub ranks: [usize; 2],
}

/// The distance between two sets.
///
/// # Errors
/// [`MetricError::Width`] for sets of different features, [`MetricError::TooFew`] for a set of fewer than two samples,
/// [`MetricError::Eigen`] for a covariance that is not finite.
pub fn frechet_distance(a: &FeatureStatistics, b: &FeatureStatistics) -> Result<FrechetDistance, MetricError> {
    for (name, set) in [("the first set", a), ("the second set", b)] {
        if set.width() != a.width() || set.covariance.len() != set.width() * set.width() {
            return Err(MetricError::Width { what: name.to_owned(), found: set.width(), expected: a.width() });
        }
        if let Some(found) = set.count.filter(|count| *count < 2) {
            return Err(MetricError::TooFew { what: name.to_owned(), found, needed: 2 });
        }
    }
    let mean_part: f64 = a.mean.iter().zip(&b.mean).map(|(a, b)| (a - b).powi(2)).sum();
    let trace = |set: &FeatureStatistics| set.covariance.iter().step_by(set.width() + 1).sum::<f64>();
    let trace_sum = trace(a) + trace(b);
    let (factor_a, factor_b) = (factor(a)?, factor(b)?);
    let ranks = [factor_a.ncols(), factor_b.ncols()];
    let common: f64 = if ranks.contains(&0) {
        0.0
    } else {
        let cross = factor_a.transpose() * &factor_b;
        cross.singular_values().map_err(|_| not_finite(a.width()))?.iter().sum()
    };
    // Rounding may leave a value just below zero for equal sets.
    let value = (mean_part + trace_sum - 2.0 * common).max(0.0);
    Ok(FrechetDistance { value, mean_part, trace_sum, ranks })
}

/// L `[D, rank]` with `L Lᵀ` the covariance. Eigenvalues that are rounding errors of zero are left out.
fn factor(set: &FeatureStatistics) -> Result<Mat<f64>, MetricError> {
    let width = set.width();
    if set.covariance.iter().any(|value| !value.is_finite()) {
        return Err(not_finite(width));
    }
    let covariance = MatRef::from_column_major_slice(&set.covariance, width, width);
    let eigen = covariance.self_adjoint_eigen(Side::Lower).map_err(|_| not_finite(width))?;
    let values: Vec<f64> = eigen.S().column_vector().iter().copied().collect();
    let largest = values.iter().fold(0.0_f64, |most, value| most.max(*value));
    let least = largest * width as f64 * f64::EPSILON;
    let kept: Vec<usize> = (0..width).filter(|i| values[*i] > least).collect();
    let vectors = eigen.U();
    Ok(Mat::from_fn(width, kept.len(), |row, column| vectors[(row, kept[column])] * values[kept[column]].sqrt()))
}

fn not_finite(size: usize) -> MetricError {
    MetricError::Eigen { size, reason: "NaN or infinity".to_owned() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn diagonal(mean: &[f64], variances: &[f64]) -> FeatureStatistics {
        let width = mean.len();
        let mut covariance = vec![0.0; width * width];
        covariance.iter_mut().step_by(width + 1).zip(variances).for_each(|(place, value)| *place = *value);
        FeatureStatistics { count: Some(100), mean: mean.to_vec(), covariance }
    }

    #[test]
    fn gaussians_with_known_moments() {
        // Commuting covariances: Σ (√λ₁ - √λ₂)².
        let a = diagonal(&[1.0, 2.0, 0.0], &[4.0, 1.0, 0.0]);
        let b = diagonal(&[0.0, 0.0, 0.0], &[1.0, 9.0, 0.25]);
        let found = frechet_distance(&a, &b).unwrap();
        assert!((found.value - (5.0 + 1.0 + 4.0 + 0.25)).abs() < 1e-12, "{found:?}");
        assert_eq!((found.mean_part, found.ranks), (5.0, [2, 3]));
    }

    #[test]
    fn a_set_and_itself_are_not_apart() {
        let a = diagonal(&[3.0, -2.0], &[1e6, 1e-6]);
        assert!(frechet_distance(&a, &a).unwrap().value < 1e-9);
        let flat = diagonal(&[3.0, -2.0], &[0.0, 0.0]);
        assert_eq!(frechet_distance(&flat, &flat).unwrap().value, 0.0);
        assert_eq!(frechet_distance(&flat, &a).unwrap().value, 1e6 + 1e-6);
    }

    #[test]
    fn sets_that_cannot_be_compared_are_named() {
        let a = diagonal(&[0.0, 0.0], &[1.0, 1.0]);
        let wide = diagonal(&[0.0; 3], &[1.0; 3]);
        assert!(matches!(frechet_distance(&a, &wide), Err(MetricError::Width { found: 3, expected: 2, .. })));
        let lonely = FeatureStatistics { count: Some(1), ..a.clone() };
        assert!(matches!(frechet_distance(&a, &lonely), Err(MetricError::TooFew { found: 1, .. })));
        let broken = diagonal(&[0.0, 0.0], &[f64::NAN, 1.0]);
        assert!(matches!(frechet_distance(&a, &broken), Err(MetricError::Eigen { .. })));
    }
}
