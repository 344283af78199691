//! A bounded random choice of feature rows, for metrics that compare samples in pairs.
//!
//! Every sample has a random rank that depends on the seed and its own name only, and the lowest ranks stay. So the
//! choice is the same for any order, batch size and split over merged collectors.

use std::collections::BTreeMap;

use crate::MetricError;

/// Keeps the features of at most `capacity` samples.
#[derive(Debug, Clone, PartialEq)]
pub struct FeaturePool {
    width: usize,
    capacity: usize,
    seed: u64,
    /// By rank; the name settles equal ranks.
    rows: BTreeMap<(u64, String), Vec<f32>>,
}

impl FeaturePool {
    /// For rows of `width` numbers.
    #[must_use]
    pub fn new(width: usize, capacity: usize, seed: u64) -> Self {
        Self { width, capacity, seed, rows: BTreeMap::new() }
    }

    /// Considers a sample. Names must differ; a name seen before replaces its row.
    ///
    /// # Errors
    /// [`MetricError::Width`] for a row of another length.
    pub fn add(&mut self, name: &str, row: &[f32]) -> Result<(), MetricError> {
        if row.len() != self.width {
            return Err(MetricError::Width { what: name.to_owned(), found: row.len(), expected: self.width });
        }
        let rank = rank(self.seed, name);
        let full = self.rows.len() >= self.capacity;
        if full && self.rows.last_key_value().is_none_or(|(last, _)| (rank, name) >= (last.0, last.1.as_str())) {
            return Ok(());
        }
        self.rows.insert((rank, name.to_owned()), row.to_vec());
        if self.rows.len() > self.capacity {
            self.rows.pop_last();
        }
        Ok(())
    }

    /// Considers every sample of another pool.
    ///
    /// # Errors
    /// [`MetricError::Width`] for a pool of other rows.
    pub fn merge(&mut self, other: &Self) -> Result<(), MetricError> {
        other.rows.iter().try_for_each(|((_, name), row)| self.add(name, row))
    }

    /// Samples kept.
    #[must_use]
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// True before the first sample.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The kept features `[N, D]` in the order of their ranks, which is random and fixed.
    #[must_use]
    pub fn rows(&self) -> FeatureRows {
        FeatureRows { width: self.width, values: self.rows.values().flatten().copied().collect() }
    }
}

/// Feature rows `[N, D]`.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureRows {
    width: usize,
    values: Vec<f32>,
}

impl FeatureRows {
    /// `values` holds whole rows of `width` numbers.
    ///
    /// # Errors
    /// [`MetricError::Width`] otherwise, [`MetricError::NotFinite`] for NaN and infinity.
    pub fn new(width: usize, values: Vec<f32>) -> Result<Self, MetricError> {
        if width == 0 || !values.len().is_multiple_of(width) {
            let what = "a table of features".to_owned();
            return Err(MetricError::Width { what, found: values.len(), expected: width });
        }
        if let Some(place) = values.iter().position(|value| !value.is_finite()) {
            return Err(MetricError::NotFinite { sample: place / width });
        }
        Ok(Self { width, values })
    }

    /// Numbers per row.
    #[must_use]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of rows.
    #[must_use]
    pub fn len(&self) -> usize {
        self.values.len().checked_div(self.width).unwrap_or(0)
    }

    /// True without rows.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The chosen rows; indices beyond the last are left out.
    #[must_use]
    pub fn select(&self, indices: &[usize]) -> Self {
        let rows = indices.iter().filter_map(|i| self.values.get(i * self.width..(i + 1) * self.width));
        Self { width: self.width, values: rows.flatten().copied().collect() }
    }

    /// The first `count` rows.
    #[must_use]
    pub fn first(&self, count: usize) -> Self {
        Self { width: self.width, values: self.values.iter().take(count * self.width).copied().collect() }
    }

    /// In f64, row by row.
    pub(crate) fn widened(&self) -> Vec<f64> {
        self.values.iter().map(|value| f64::from(*value)).collect()
    }
}

/// FNV-1a over seed and name, mixed by the finaliser of SplitMix64: even for names that differ in one letter.
fn rank(seed: u64, name: &str) -> u64 {
    let bytes = seed.to_le_bytes();
    let hash = bytes
        .iter()
        .chain(name.as_bytes())
        .fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3));
    let mixed = (hash ^ hash >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    mixed ^ mixed >> 31
}

#[cfg(test)]
mod tests {
    use super::*;

    fn collect(samples: impl Iterator<Item = usize>) -> FeaturePool {
        let mut pool = FeaturePool::new(2, 20, 7);
        samples.for_each(|i| pool.add(&format!("{i:04}"), &[i as f32, 0.5]).unwrap());
        pool
    }

    #[test]
    fn the_choice_depends_on_seed_and_names_only() {
        let whole = collect(0..300);
        assert_eq!(whole.len(), 20);
        assert_eq!(collect((0..300).rev()), whole);
        let mut merged = collect(100..300);
        merged.merge(&collect(0..100)).unwrap();
        assert_eq!(merged, whole);
        let mut other = FeaturePool::new(2, 20, 8);
        (0..300).for_each(|i| other.add(&format!("{i:04}"), &[i as f32, 0.5]).unwrap());
        assert_ne!(other.rows(), whole.rows());
        let chosen = whole.rows().widened();
        let mean = chosen.iter().step_by(2).sum::<f64>() / 20.0;
        assert!((90.0..210.0).contains(&mean), "a random choice of 0..300 has a mean near 150, got {mean}");
    }

    #[test]
    fn rows_of_another_length_are_refused() {
        assert!(FeaturePool::new(2, 5, 0).add("a", &[1.0]).is_err());
        assert!(FeatureRows::new(2, vec![0.0; 3]).is_err());
        assert!(FeatureRows::new(1, vec![0.0, f32::INFINITY]).is_err());
        let rows = FeatureRows::new(2, vec![0.0, 1.0, 2.0, 3.0]).unwrap();
        assert_eq!(rows.select(&[1, 9]).widened(), [2.0, 3.0]);
        assert_eq!((rows.len(), rows.first(1).len(), rows.first(7).len()), (2, 1, 2));
    }
}
