//! Frames that hold rare classes, drawn more often.
//!
//! The idea of class-balanced grouping and sampling (Zhu et al., "Class-balanced Grouping and Sampling for Point Cloud 3D Object
//! Detection", 2019, section 3.1): every class is given the same number of draws, and the draws of a class are spread evenly over the
//! frames that hold it. There the frames are copied at random until the numbers fit; here each frame has an expected number of draws,
//! and the passes keep to it exactly.

use rayon::prelude::*;

use crate::{DataError, ObjectClass, SceneDataset};

/// Settings of class-balanced draws.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct ClassBalance {
    /// Share of the draws that go by class, 0 to 1; the others are spread evenly over all frames.
    pub share: f64,
    /// Most draws of one frame in a pass.
    pub max_repeats: f64,
}

impl ClassBalance {
    pub fn validate(&self) -> Result<(), DataError> {
        if !(0.0..=1.0).contains(&self.share) {
            return Err(DataError::Config(format!("class_balanced.share must lie in 0..=1, but is {}", self.share)));
        }
        if !self.max_repeats.is_finite() || self.max_repeats < 1.0 {
            let found = self.max_repeats;
            return Err(DataError::Config(format!("class_balanced.max_repeats must be at least 1, but is {found}")));
        }
        Ok(())
    }

    /// How often each frame of a dataset is drawn in a pass of as many draws as it has frames: numbers that add up to that count.
    /// `None` for a dataset that has no boxes: its frames count alike.
    ///
    /// # Errors
    /// A frame that cannot be read.
    pub fn expected_draws(&self, dataset: &dyn SceneDataset) -> Result<Option<Vec<f64>>, DataError> {
        if !dataset.capabilities().boxes {
            return Ok(None);
        }
        let held: Result<Vec<u32>, DataError> = (0..dataset.len())
            .into_par_iter()
            .map(|index| Ok(dataset.box_classes(index)?.iter().fold(0, |set, class| set | 1 << class.index())))
            .collect();
        Ok(self.spread(&held?))
    }

    /// The draws by the set of classes of each frame, bit c for class c.
    fn spread(&self, held: &[u32]) -> Option<Vec<f64>> {
        let classes = 0..ObjectClass::ALL.len();
        let frames_with = |class: usize| held.iter().filter(|set| **set >> class & 1 == 1).count();
        let counts: Vec<usize> = classes.clone().map(frames_with).collect();
        let occurring = counts.iter().filter(|count| **count > 0).count();
        if occurring == 0 {
            return None;
        }
        let draws_per_class = held.len() as f64 / occurring as f64;
        let by_class = |set: &u32| -> f64 {
            let of_set = classes.clone().filter(|class| set >> class & 1 == 1);
            of_set.map(|class| draws_per_class / counts[class] as f64).sum()
        };
        let mut draws: Vec<f64> = held.iter().map(|set| 1.0 - self.share + self.share * by_class(set)).collect();
        cap(&mut draws, self.max_repeats);
        Some(draws)
    }
}

/// Lowers what is above `most` (at least the mean) to it and raises the rest in proportion, so that the sum stays.
fn cap(draws: &mut [f64], most: f64) {
    let sum: f64 = draws.iter().sum();
    let mut capped = vec![false; draws.len()];
    loop {
        let mut changed = false;
        for (draw, capped) in draws.iter_mut().zip(&mut capped) {
            if !*capped && *draw > most {
                (*draw, *capped, changed) = (most, true, true);
            }
        }
        let free: f64 = draws.iter().zip(&capped).filter(|(_, capped)| !**capped).map(|(draw, _)| draw).sum();
        let fixed: f64 = draws.iter().zip(&capped).filter(|(_, capped)| **capped).map(|(draw, _)| draw).sum();
        if !changed || free <= 0.0 {
            return;
        }
        let scale = (sum - fixed) / free;
        draws.iter_mut().zip(&capped).filter(|(_, capped)| !**capped).for_each(|(draw, _)| *draw *= scale);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const ALL: ClassBalance = ClassBalance { share: 1.0, max_repeats: 1e9 };

    #[test]
    fn every_class_gets_the_same_number_of_draws() {
        // Six frames with a car, two of them with a bus, one with a bicycle, one with nothing.
        let held = [0b1, 0b1, 0b101, 0b101, 0b1, 0b1, 0b100_0000, 0];
        let draws = ALL.spread(&held).unwrap();
        let per_class = 8.0 / 3.0;
        let (car, bus) = (per_class / 6.0, per_class / 2.0);
        let want = [car, car, car + bus, car + bus, car, car, per_class, 0.0];
        assert!(draws.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-12), "{draws:?}");
        let half = ClassBalance { share: 0.5, ..ALL }.spread(&held).unwrap();
        assert!(half.iter().zip(want).all(|(got, want)| (got - 0.5 - 0.5 * want).abs() < 1e-12), "{half:?}");
        assert!(ALL.spread(&[0, 0]).is_none());
        assert_eq!(ClassBalance { share: 0.0, ..ALL }.spread(&held).unwrap(), [1.0; 8]);
    }

    #[test]
    fn a_cap_keeps_the_sum() {
        let held = [0b1, 0b1, 0b101, 0b101, 0b1, 0b1, 0b100_0000, 0];
        for max_repeats in [1.0, 1.2, 1.9, 2.5] {
            let draws = ClassBalance { max_repeats, share: 0.9 }.spread(&held).unwrap();
            assert!((draws.iter().sum::<f64>() - 8.0).abs() < 1e-9, "{draws:?}");
            assert!(draws.iter().all(|draw| *draw <= max_repeats + 1e-9 && *draw > 0.0), "{draws:?}");
        }
    }
}
