//! From boxes of all samples to the detection score.

use std::collections::BTreeMap;

use serde::Serialize;

use super::boxes::{DetectionBox, TrueBox};
use super::curve::{ClassBoxes, MatchCurve, TruePositiveError};
use super::filter::{Rack, keep_evaluated};
use super::{DISTANCE_THRESHOLDS_M, DetectionClass, ERROR_THRESHOLD, MOST_BOXES};
use crate::MetricError;

/// Weight of mAP against each of the five errors.
const PRECISION_WEIGHT: f64 = 5.0;

/// Collects samples. Shards [merge](DetectionTally::merge) exactly: boxes are kept and matched at the end.
#[derive(Debug, Clone, Default)]
pub struct DetectionTally {
    /// By sample name and class.
    samples: BTreeMap<String, BTreeMap<DetectionClass, ClassBoxes>>,
    given: [u64; 2],
    kept: [u64; 2],
}

/// What one class comes to.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClassScore {
    /// The class.
    pub class: DetectionClass,
    /// Average precision per threshold of [`DISTANCE_THRESHOLDS_M`].
    pub average_precision: [f64; 4],
    /// The five errors at 2 m; `None` where the class does not define one.
    pub errors: [Option<f64>; 5],
    /// The curves behind, per threshold.
    #[serde(skip)]
    pub curves: Vec<MatchCurve>,
    /// True boxes that were evaluated.
    pub true_boxes: usize,
    /// Predictions that were evaluated.
    pub predictions: usize,
}

impl ClassScore {
    /// Mean over the thresholds.
    #[must_use]
    pub fn mean_average_precision(&self) -> f64 {
        self.average_precision.iter().sum::<f64>() / self.average_precision.len() as f64
    }
}

/// The score and its parts.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DetectionScore {
    /// Mean over classes and thresholds.
    pub mean_average_precision: f64,
    /// Mean over the classes that define them: translation m, scale, orientation rad, velocity m/s, attribute.
    pub errors: [f64; 5],
    /// nuScenes detection score.
    pub nds: f64,
    /// Class by class.
    pub classes: Vec<ClassScore>,
    /// Samples.
    pub samples: usize,
    /// True boxes and predictions given.
    pub boxes_given: [u64; 2],
    /// True boxes and predictions evaluated.
    pub boxes_evaluated: [u64; 2],
}

impl DetectionTally {
    /// Adds a sample: its truth, the predictions for it with their places in the whole result file, the car's position in the frame of
    /// the boxes and the bicycle racks around it.
    ///
    /// # Errors
    /// [`MetricError::Detection`] for more than 500 predictions, for a score that is no number and for a sample that was there before.
    pub fn update(
        &mut self,
        sample: &str,
        truth: &[TrueBox],
        found: &[(u64, DetectionBox)],
        ego: [f64; 3],
        racks: &[Rack],
    ) -> Result<(), MetricError> {
        if found.len() > MOST_BOXES {
            let count = found.len();
            return Err(MetricError::Detection(format!(
                "sample {sample} has {count} predictions, {MOST_BOXES} are allowed; keep those with the highest scores"
            )));
        }
        if let Some((place, _)) = found.iter().find(|(_, found)| !found.score.is_finite()) {
            return Err(MetricError::Detection(format!("prediction {place} of sample {sample} has no finite score")));
        }
        if self.samples.contains_key(sample) {
            return Err(MetricError::Detection(format!("sample {sample} comes twice")));
        }
        let mut classes: BTreeMap<DetectionClass, ClassBoxes> = BTreeMap::new();
        for one in truth.iter().filter(|one| keep_evaluated(&one.found, ego, Some(one.points), racks)) {
            classes.entry(one.found.class).or_default().truth.push(one.found.clone());
            self.kept[0] += 1;
        }
        for one in found.iter().filter(|(_, one)| keep_evaluated(one, ego, None, racks)) {
            classes.entry(one.1.class).or_default().found.push(one.clone());
            self.kept[1] += 1;
        }
        self.given[0] += truth.len() as u64;
        self.given[1] += found.len() as u64;
        self.samples.insert(sample.to_owned(), classes);
        Ok(())
    }

    /// Adds the samples of another collector.
    ///
    /// # Errors
    /// [`MetricError::Detection`] for a sample that both hold.
    pub fn merge(&mut self, other: Self) -> Result<(), MetricError> {
        if let Some(twice) = other.samples.keys().find(|name| self.samples.contains_key(*name)) {
            return Err(MetricError::Detection(format!("sample {twice} comes twice")));
        }
        self.samples.extend(other.samples);
        for side in [0, 1] {
            self.given[side] += other.given[side];
            self.kept[side] += other.kept[side];
        }
        Ok(())
    }

    /// The score.
    ///
    /// # Errors
    /// [`MetricError::TooFew`] without samples.
    pub fn score(&self) -> Result<DetectionScore, MetricError> {
        if self.samples.is_empty() {
            return Err(MetricError::TooFew { what: "the detection result".to_owned(), found: 0, needed: 1 });
        }
        let classes: Vec<ClassScore> = DetectionClass::ALL.into_iter().map(|class| self.class_score(class)).collect();
        let mean_average_precision =
            classes.iter().map(ClassScore::mean_average_precision).sum::<f64>() / classes.len() as f64;
        let errors = [0, 1, 2, 3, 4].map(|kind| {
            let defined: Vec<f64> = classes.iter().filter_map(|class| class.errors[kind]).collect();
            defined.iter().sum::<f64>() / defined.len() as f64
        });
        let goodness: f64 = errors.iter().map(|error| 1.0 - error.min(1.0)).sum();
        Ok(DetectionScore {
            mean_average_precision,
            errors,
            nds: (PRECISION_WEIGHT * mean_average_precision + goodness) / (PRECISION_WEIGHT + errors.len() as f64),
            classes,
            samples: self.samples.len(),
            boxes_given: self.given,
            boxes_evaluated: self.kept,
        })
    }

    fn class_score(&self, class: DetectionClass) -> ClassScore {
        let samples: Vec<&ClassBoxes> = self.samples.values().filter_map(|classes| classes.get(&class)).collect();
        let curves = DISTANCE_THRESHOLDS_M.map(|threshold| MatchCurve::of(&samples, class, threshold));
        let errors = TruePositiveError::ALL
            .map(|error| class.has_error(error).then(|| curves[ERROR_THRESHOLD].mean_error(error)));
        ClassScore {
            class,
            average_precision: curves.each_ref().map(MatchCurve::average_precision),
            errors,
            curves: curves.into(),
            true_boxes: samples.iter().map(|sample| sample.truth.len()).sum(),
            predictions: samples.iter().map(|sample| sample.found.len()).sum(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car(x: f64, score: f64) -> DetectionBox {
        DetectionBox {
            class: DetectionClass::Car,
            center: [x, 0.0, 0.0],
            size: [2.0, 4.0, 1.5],
            rotation: [1.0, 0.0, 0.0, 0.0],
            velocity: [1.0, 0.0],
            attribute: "vehicle.moving".to_owned(),
            score,
        }
    }

    #[test]
    fn one_match_by_hand() {
        let mut tally = DetectionTally::default();
        let truth = [TrueBox { found: car(10.0, 0.0), points: 3 }];
        let found = DetectionBox { velocity: [1.0, 0.25], attribute: "vehicle.parked".to_owned(), ..car(10.75, 0.9) };
        tally.update("a", &truth, &[(0, found)], [0.0; 3], &[]).unwrap();
        let score = tally.score().unwrap();
        let class = &score.classes[0];
        assert!(class.average_precision[0] == 0.0 && (class.average_precision[1] - 1.0).abs() < 1e-12);
        let errors: Vec<f64> = class.errors.iter().map(|error| error.unwrap()).collect();
        for (error, want) in errors.iter().zip([0.75, 0.0, 0.0, 0.25, 1.0]) {
            assert!((error - want).abs() < 1e-12, "{errors:?}");
        }
        assert!((score.mean_average_precision - 0.075).abs() < 1e-12);
        assert_eq!(score.classes[8].errors[2..], [None; 3], "a cone has neither heading, velocity nor attribute");
        assert_eq!(score.classes[9].errors[3..], [None; 2]);
    }

    #[test]
    fn no_predictions_and_broken_ones() {
        let mut tally = DetectionTally::default();
        assert!(matches!(tally.score(), Err(MetricError::TooFew { .. })));
        tally.update("a", &[TrueBox { found: car(3.0, 0.0), points: 1 }], &[], [0.0; 3], &[]).unwrap();
        let score = tally.score().unwrap();
        assert_eq!((score.nds, score.errors, score.boxes_evaluated), (0.0, [1.0; 5], [1, 0]));
        let many = vec![(0, car(1.0, 0.5)); 501];
        for (name, found) in [("b", many), ("b", vec![(0, car(1.0, f64::NAN))]), ("a", vec![])] {
            assert!(matches!(tally.update(name, &[], &found, [0.0; 3], &[]), Err(MetricError::Detection(_))));
        }
        assert!(tally.clone().merge(tally).is_err());
    }
}
