//! Matching by distance and what follows from it along the recall axis.

use serde::{Deserialize, Serialize};

use super::DetectionClass;
use super::boxes::DetectionBox;

/// Recalls 0, 0.01, ... 1.
const STEPS: usize = 101;
/// Parts of the curve at or below this recall do not count, in steps.
const FIRST_STEP: usize = 11;
/// Precision below this counts as nothing.
const LEAST_PRECISION: f64 = 0.1;

/// The five errors of matched boxes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum TruePositiveError {
    /// Distance of centres in the ground plane, metres.
    #[serde(rename = "trans_err")]
    Translation,
    /// 1 - IoU of aligned boxes.
    #[serde(rename = "scale_err")]
    Scale,
    /// Difference of headings, radians.
    #[serde(rename = "orient_err")]
    Orientation,
    /// Difference of velocities, m/s.
    #[serde(rename = "vel_err")]
    Velocity,
    /// Share of wrong attributes.
    #[serde(rename = "attr_err")]
    Attribute,
}

impl TruePositiveError {
    /// All five in the benchmark's order.
    pub const ALL: [Self; 5] = [Self::Translation, Self::Scale, Self::Orientation, Self::Velocity, Self::Attribute];

    fn measure(self, found: &DetectionBox, truth: &DetectionBox, class: DetectionClass) -> f64 {
        match self {
            Self::Translation => found.center_distance(truth),
            Self::Scale => found.scale_error(truth),
            Self::Orientation => found.orientation_error(truth, class.yaw_period()),
            Self::Velocity => found.velocity_error(truth),
            Self::Attribute => found.attribute_error(truth),
        }
    }
}

/// Precision, confidence and errors of one class and threshold at 101 recalls.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MatchCurve {
    /// Share of predictions that match.
    pub precision: Vec<f64>,
    /// Score at which the recall is reached; 0 where it never is.
    pub confidence: Vec<f64>,
    /// Mean error of the matches down to that score, in the order of [`TruePositiveError::ALL`].
    pub errors: [Vec<f64>; 5],
}

/// The boxes of one class in one sample.
#[derive(Debug, Clone, Default)]
pub(super) struct ClassBoxes {
    pub(super) truth: Vec<DetectionBox>,
    /// With their places in the result file.
    pub(super) found: Vec<(u64, DetectionBox)>,
}

/// One prediction after matching.
struct Judged {
    score: f64,
    /// Errors of a match.
    errors: Option<[f64; 5]>,
}

impl MatchCurve {
    /// What a class without truth or without a single match gets.
    fn nothing() -> Self {
        Self { precision: vec![0.0; STEPS], confidence: vec![0.0; STEPS], errors: [0; 5].map(|_| vec![1.0; STEPS]) }
    }

    pub(super) fn of(samples: &[&ClassBoxes], class: DetectionClass, threshold_m: f64) -> Self {
        let truths: usize = samples.iter().map(|sample| sample.truth.len()).sum();
        let judged = judge(samples, class, threshold_m);
        let matches: Vec<(f64, [f64; 5])> = judged.iter().filter_map(|one| Some((one.score, one.errors?))).collect();
        if truths == 0 || matches.is_empty() {
            return Self::nothing();
        }
        let (mut hits, mut recalls, mut precisions) = (0, Vec::new(), Vec::new());
        for (place, one) in judged.iter().enumerate() {
            hits += usize::from(one.errors.is_some());
            recalls.push(hits as f64 / truths as f64);
            precisions.push(hits as f64 / (place + 1) as f64);
        }
        let scores: Vec<f64> = judged.iter().map(|one| one.score).collect();
        let at_recalls = |values: &[f64]| -> Vec<f64> {
            (0..STEPS).map(|step| interpolate(step as f64 / 100.0, &recalls, values, Some(0.0))).collect()
        };
        let (precision, confidence) = (at_recalls(&precisions), at_recalls(&scores));
        let ascending: Vec<f64> = matches.iter().rev().map(|(score, _)| *score).collect();
        let errors = [0, 1, 2, 3, 4].map(|kind| {
            let mut means = running_means(matches.iter().map(|(_, errors)| errors[kind]));
            means.reverse();
            confidence.iter().map(|score| interpolate(*score, &ascending, &means, None)).collect()
        });
        Self { precision, confidence, errors }
    }

    /// Mean precision beyond a recall of 0.1, of what exceeds 0.1.
    #[must_use]
    pub fn average_precision(&self) -> f64 {
        let counted = self.precision.get(FIRST_STEP..).unwrap_or_default();
        let above: f64 = counted.iter().map(|precision| (precision - LEAST_PRECISION).max(0.0)).sum();
        above / counted.len() as f64 / (1.0 - LEAST_PRECISION)
    }

    /// Mean of an error between a recall of 0.1 and the highest reached; 1 where 0.1 is not reached.
    #[must_use]
    pub fn mean_error(&self, error: TruePositiveError) -> f64 {
        let reached = self.confidence.iter().rposition(|score| *score != 0.0).unwrap_or(0);
        match self.errors[error as usize].get(FIRST_STEP..=reached.max(FIRST_STEP - 1)) {
            Some(counted) if !counted.is_empty() => counted.iter().sum::<f64>() / counted.len() as f64,
            _ => 1.0,
        }
    }
}

/// Every prediction by falling score, of equal scores the later one in the file first; each takes the nearest true box
/// that no earlier one has taken.
fn judge(samples: &[&ClassBoxes], class: DetectionClass, threshold_m: f64) -> Vec<Judged> {
    let mut order: Vec<(usize, u64, &DetectionBox)> = Vec::new();
    for (sample, boxes) in samples.iter().enumerate() {
        order.extend(boxes.found.iter().map(|(place, found)| (sample, *place, found)));
    }
    order.sort_by(|a, b| b.2.score.total_cmp(&a.2.score).then(b.1.cmp(&a.1)));
    let mut taken: Vec<Vec<bool>> = samples.iter().map(|boxes| vec![false; boxes.truth.len()]).collect();
    let mut judged = Vec::with_capacity(order.len());
    for (sample, _, found) in order {
        let free = samples[sample].truth.iter().zip(&mut taken[sample]).filter(|(_, taken)| !**taken);
        let nearest = free.map(|(truth, taken)| (found.center_distance(truth), truth, taken));
        let nearest = nearest.reduce(|best, next| if next.0 < best.0 { next } else { best });
        let errors = nearest.filter(|(distance, ..)| *distance < threshold_m).map(|(_, truth, taken)| {
            *taken = true;
            TruePositiveError::ALL.map(|error| error.measure(found, truth, class))
        });
        judged.push(Judged { score: found.score, errors });
    }
    judged
}

/// Means of the first, the first two, ... values; undefined ones are skipped. Without any defined one all are 1.
fn running_means(values: impl Iterator<Item = f64>) -> Vec<f64> {
    let (mut sum, mut count) = (0.0, 0_u32);
    let mut means = Vec::new();
    for value in values {
        if !value.is_nan() {
            sum += value;
            count += 1;
        }
        means.push(if count > 0 { sum / f64::from(count) } else { 0.0 });
    }
    if count == 0 {
        means.fill(1.0);
    }
    means
}

/// Piecewise linear through points with ascending places; before the first its value, after the last `beyond` or its value. Of
/// several points at one place the last one counts, as in NumPy's `interp`.
fn interpolate(place: f64, places: &[f64], values: &[f64], beyond: Option<f64>) -> f64 {
    let (Some(first), Some(last), Some(end)) = (values.first(), values.last(), places.last()) else { return 0.0 };
    let after = places.partition_point(|known| *known <= place);
    if place > *end {
        return beyond.unwrap_or(*last);
    }
    if after == 0 {
        return *first;
    }
    match (places.get(after), values.get(after)) {
        (Some(next), Some(value)) => {
            let (known, start) = (places[after - 1], values[after - 1]);
            if known == place { start } else { (value - start) / (next - known) * (place - known) + start }
        }
        _ => *last,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interpolation_as_numpy() {
        let at = |x| interpolate(x, &[0.1, 0.2, 0.2, 0.4], &[1.0, 2.0, 5.0, 7.0], Some(0.0));
        assert_eq!([at(0.0), at(0.1), at(0.2), at(0.4), at(0.5)], [1.0, 1.0, 5.0, 7.0, 0.0]);
        assert!((at(0.3) - 6.0).abs() < 1e-12 && (at(0.15) - 1.5).abs() < 1e-12);
        assert_eq!(interpolate(3.0, &[1.0], &[4.0], None), 4.0);
    }

    #[test]
    fn undefined_errors_are_skipped() {
        let nan = f64::NAN;
        assert_eq!(running_means([nan, 2.0, nan, 4.0].into_iter()), [0.0, 2.0, 2.0, 3.0]);
        assert_eq!(running_means([nan, nan].into_iter()), [1.0, 1.0]);
    }

    #[test]
    fn recall_below_a_tenth_is_worth_nothing() {
        let mut curve = MatchCurve::nothing();
        assert_eq!((curve.average_precision(), curve.mean_error(TruePositiveError::Scale)), (0.0, 1.0));
        curve.precision[..6].fill(1.0);
        curve.confidence[..6].fill(0.9);
        curve.errors[0].fill(0.2);
        assert_eq!((curve.average_precision(), curve.mean_error(TruePositiveError::Translation)), (0.0, 1.0));
        curve.confidence[..=FIRST_STEP].fill(0.9);
        assert_eq!(curve.mean_error(TruePositiveError::Translation), 0.2);
    }
}
