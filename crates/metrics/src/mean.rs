//! Collects one number per image, clip or sample in constant memory: mean, spread, histogram and the worst samples.

use serde::{Deserialize, Serialize};

use crate::ExactSum;

/// Mean and deviation; order and split over [merged](Mean::merge) collectors do not change a bit.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Mean {
    sum: ExactSum,
    squares: ExactSum,
    count: u64,
}

impl Mean {
    /// Adds one value.
    pub fn add(&mut self, value: f64) {
        self.sum.add(value);
        self.squares.add(value * value);
        self.count += 1;
    }

    /// Adds every value of another collector.
    pub fn merge(&mut self, other: &Self) {
        self.sum.merge(&other.sum);
        self.squares.merge(&other.squares);
        self.count += other.count;
    }

    /// Values seen.
    #[must_use]
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Their mean; `None` without any.
    #[must_use]
    pub fn mean(&self) -> Option<f64> {
        (self.count > 0).then(|| self.sum.value() / self.count as f64)
    }

    /// Their population deviation; `None` without any.
    #[must_use]
    pub fn deviation(&self) -> Option<f64> {
        let mean = self.mean()?;
        Some((self.squares.value() / self.count as f64 - mean * mean).max(0.0).sqrt())
    }
}

/// Counts of values in equal bins; values beyond the ends count in the end bins.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    low: f64,
    high: f64,
    counts: Vec<u64>,
}

impl Histogram {
    /// `bins` (at least one) between two ends.
    #[must_use]
    pub fn new(low: f64, high: f64, bins: usize) -> Self {
        Self { low, high, counts: vec![0; bins.max(1)] }
    }

    /// Counts a value; NaN is left out.
    pub fn add(&mut self, value: f64) {
        let place = (value - self.low) / (self.high - self.low) * self.counts.len() as f64;
        let last = self.counts.len() - 1;
        if !place.is_nan()
            && let Some(count) = self.counts.get_mut((place.max(0.0) as usize).min(last))
        {
            *count += 1;
        }
    }

    /// Adds the counts of another histogram with the same bins.
    ///
    /// # Panics
    /// When the bins differ.
    pub fn merge(&mut self, other: &Self) {
        assert_eq!((self.low, self.high, self.counts.len()), (other.low, other.high, other.counts.len()), "bins");
        self.counts.iter_mut().zip(&other.counts).for_each(|(a, b)| *a += b);
    }

    /// The two ends.
    #[must_use]
    pub fn range(&self) -> (f64, f64) {
        (self.low, self.high)
    }

    /// Values per bin, lowest first.
    #[must_use]
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }
}

/// A sample that stands out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Ranked {
    /// Its value.
    pub value: f64,
    /// Which sample.
    pub name: String,
}

/// The samples with the worst values, worst first; ties by name, so that order and shards do not matter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Worst {
    keep: usize,
    higher_is_better: bool,
    found: Vec<Ranked>,
}

impl Worst {
    /// Keeps this many.
    #[must_use]
    pub fn new(keep: usize, higher_is_better: bool) -> Self {
        Self { keep, higher_is_better, found: Vec::new() }
    }

    /// Considers a sample.
    pub fn add(&mut self, value: f64, name: &str) {
        let sign = if self.higher_is_better { 1.0 } else { -1.0 };
        let goodness = |ranked: &Ranked| sign * ranked.value;
        let new = Ranked { value, name: name.to_owned() };
        // NaN is the worst there is.
        let before = |a: &Ranked| match (a.value.is_nan(), value.is_nan()) {
            (true, false) => true,
            (false, true) => false,
            _ => (goodness(a), a.name.as_str()) < (goodness(&new), name),
        };
        let place = self.found.partition_point(before);
        if place < self.keep {
            self.found.insert(place, new);
            self.found.truncate(self.keep);
        }
    }

    /// Considers the samples of another collector.
    pub fn merge(&mut self, other: &Self) {
        other.found.iter().for_each(|ranked| self.add(ranked.value, &ranked.name));
    }

    /// Worst first.
    #[must_use]
    pub fn samples(&self) -> &[Ranked] {
        &self.found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_deviation_of_known_numbers() {
        let mut mean = Mean::default();
        assert_eq!((mean.mean(), mean.deviation()), (None, None));
        [2.0, 4.0, 4.0, 4.0, 5.0, 5.0, 7.0, 9.0].iter().for_each(|value| mean.add(*value));
        assert_eq!((mean.mean(), mean.deviation(), mean.count()), (Some(5.0), Some(2.0), 8));
    }

    #[test]
    fn bins_hold_everything_but_nan() {
        let mut histogram = Histogram::new(0.0, 10.0, 5);
        [-3.0, 0.0, 1.9, 2.0, 9.99, 10.0, 1e9, f64::NAN].iter().for_each(|value| histogram.add(*value));
        assert_eq!(histogram.counts(), [3, 1, 0, 0, 3]);
        histogram.merge(&histogram.clone());
        assert_eq!(histogram.counts(), [6, 2, 0, 0, 6]);
    }

    #[test]
    fn the_worst_are_the_same_in_any_order() {
        let values = [3.0, 1.0, f64::NAN, 1.0, 7.0, -2.0];
        let collect = |order: &[usize]| {
            let mut worst = Worst::new(4, true);
            order.iter().for_each(|i| worst.add(values[*i], &format!("s{i}")));
            worst
        };
        let names = |worst: &Worst| worst.samples().iter().map(|ranked| ranked.name.clone()).collect::<Vec<_>>();
        let whole = collect(&[0, 1, 2, 3, 4, 5]);
        assert_eq!(names(&whole), ["s2", "s5", "s1", "s3"]);
        let mut merged = collect(&[5, 3, 2]);
        merged.merge(&collect(&[4, 0, 1]));
        assert_eq!(names(&merged), names(&whole));
        let mut lower = Worst::new(1, false);
        [0.1, 0.9, 0.5].iter().for_each(|value| lower.add(*value, "x"));
        assert_eq!(lower.samples()[0].value, 0.9);
    }
}
