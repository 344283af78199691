//! The mean picture of every camera: what a model that has learned nothing but the views' averages would draw, hence
//! the baseline that a reconstruction has to beat.

use std::collections::BTreeMap;

/// Fractional bits of the sums. Sums of integers do not depend on their order, and 2^-32 is far below an f32's
/// resolution at any visible value.
const FRACTION: f64 = (1_u64 << 32) as f64;

/// Running mean of the images of each view position, for instance keyed by camera name.
///
/// Holds 2^32 images per view. Order and split over [merged](MeanImages::merge) collectors do not change a bit.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MeanImages {
    views: BTreeMap<String, Sum>,
}

#[derive(Debug, Clone, PartialEq, Eq)]
struct Sum {
    images: u64,
    /// In units of 2^-32.
    values: Vec<u64>,
}

impl MeanImages {
    /// Adds one image of a view.
    ///
    /// # Panics
    /// When the view's earlier images had another number of values, or a value is NaN.
    pub fn update(&mut self, view: &str, image: &[f32]) {
        let addend = image.iter().map(|&value| {
            assert!(!value.is_nan(), "an image of {view} holds NaN");
            (f64::from(value.clamp(0.0, 1.0)) * FRACTION).round() as u64
        });
        self.add(view, 1, addend.collect());
    }

    /// Adds every image of another collector.
    ///
    /// # Panics
    /// When a view has another number of values there.
    pub fn merge(&mut self, other: Self) {
        for (view, sum) in other.views {
            self.add(&view, sum.images, sum.values);
        }
    }

    fn add(&mut self, view: &str, images: u64, values: Vec<u64>) {
        let Some(sum) = self.views.get_mut(view) else {
            self.views.insert(view.to_owned(), Sum { images, values });
            return;
        };
        assert_eq!(sum.values.len(), values.len(), "values of an image of {view}");
        sum.images += images;
        sum.values.iter_mut().zip(values).for_each(|(sum, value)| *sum += value);
    }

    /// Views seen so far, sorted.
    pub fn views(&self) -> impl Iterator<Item = &str> {
        self.views.keys().map(String::as_str)
    }

    /// Number of images of a view.
    #[must_use]
    pub fn images(&self, view: &str) -> u64 {
        self.views.get(view).map_or(0, |sum| sum.images)
    }

    /// Mean of the images of a view, in their memory order; `None` for a view never seen.
    #[must_use]
    pub fn mean(&self, view: &str) -> Option<Vec<f32>> {
        let sum = self.views.get(view)?;
        let scale = 1.0 / (FRACTION * sum.images as f64);
        Some(sum.values.iter().map(|&value| (value as f64 * scale) as f32).collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn means_are_kept_per_view() {
        let mut means = MeanImages::default();
        means.update("front", &[0.0, 1.0]);
        means.update("front", &[0.5, 2.0]);
        means.update("back", &[0.1, 0.2]);
        assert_eq!(means.mean("front"), Some(vec![0.25, 1.0]));
        assert_eq!(means.mean("back"), Some(vec![0.1, 0.2]));
        assert_eq!(means.mean("left"), None);
        assert_eq!((means.images("front"), means.images("left")), (2, 0));
        assert_eq!(means.views().collect::<Vec<_>>(), ["back", "front"]);
    }

    #[test]
    fn shards_merge_to_the_same_sums_in_any_order() {
        let image = |i: usize| [i as f32 / 37.0, 1.0 / (i + 1) as f32, (i as f32).sin().abs()];
        let collect = |range: std::ops::Range<usize>| {
            let mut means = MeanImages::default();
            range.for_each(|i| means.update(["a", "b"][i % 2], &image(i)));
            means
        };
        let mut merged = collect(20..37);
        merged.merge(collect(0..20));
        assert_eq!(merged, collect(0..37));
    }

    #[test]
    #[should_panic(expected = "values of an image of front")]
    fn another_size_is_refused() {
        let mut means = MeanImages::default();
        means.update("front", &[0.0]);
        means.update("front", &[0.0, 1.0]);
    }
}
