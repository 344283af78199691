//! UniPC: a predictor and a corrector that shares its network evaluation, data prediction, orders 1 to 3.
//!
//! Paper: Zhao et al., "UniPC: A Unified Predictor-Corrector Framework", eq. 4 and 5, appendix on B(h).

use std::collections::VecDeque;

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use super::{Cancelled, FinalLevel, Oracle, index};
use crate::{Level, NoiseSchedule, Spacing, Target};

/// The paper's B(h).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SolverVariant {
    /// B(h) = h.
    Bh1,
    /// B(h) = eʰ − 1; the better one for guided sampling.
    #[default]
    Bh2,
}

/// Multistep sampler, deterministic.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UniPc {
    /// Network evaluations.
    pub steps: usize,
    /// 1, 2 or 3.
    #[serde(default = "two")]
    pub order: usize,
    /// B(h).
    #[serde(default)]
    pub variant: SolverVariant,
    /// Timesteps visited.
    #[serde(default = "linspace")]
    pub spacing: Spacing,
    /// Level after the last step.
    #[serde(default)]
    pub last: FinalLevel,
}

const fn two() -> usize {
    2
}

const fn linspace() -> Spacing {
    Spacing::Linspace
}

/// A clean sample that the network gave, and where.
struct Point<const D: usize> {
    clean: Tensor<D>,
    lambda: f64,
}

/// The step that is being corrected: where it began and with which order.
struct Prediction<const D: usize> {
    x: Tensor<D>,
    level: Level,
    order: usize,
}

impl UniPc {
    /// Descending timesteps.
    pub fn timesteps(&self, schedule: &NoiseSchedule) -> Vec<f64> {
        self.spacing.visits_before_end(self.steps, schedule.len())
    }

    pub(super) fn sample<const D: usize>(
        &self,
        schedule: &NoiseSchedule,
        target: Target,
        start: Tensor<D>,
        oracle: &mut Oracle<'_, D>,
    ) -> Result<Tensor<D>, Cancelled> {
        let timesteps = self.timesteps(schedule);
        let mut x = start;
        // Newest first.
        let mut points: VecDeque<Point<D>> = VecDeque::new();
        let mut predicted: Option<Prediction<D>> = None;
        for (step, timestep) in timesteps.iter().enumerate() {
            let level = schedule.level(index(*timestep));
            let next = timesteps.get(step + 1).map_or(self.last.level(schedule), |t| schedule.level(index(*t)));
            let clean = target.clean((oracle.denoise)(x.clone(), *timestep), x.clone(), level);
            if let Some(from) = predicted.take() {
                x = self.advance(from.x, from.level, level, from.order, &points, Some(&clean));
            }
            points.push_front(Point { clean, lambda: level.lambda() });
            points.truncate(self.order);
            // Lower orders at both ends: there are no older points yet, and the last steps are too long for high orders.
            let order = self.order.min(timesteps.len() - step).min(step + 1);
            predicted = Some(Prediction { x: x.clone(), level, order });
            x = self.advance(x, level, next, order, &points, None);
            oracle.report(step + 1, self.steps, &x)?;
        }
        Ok(x)
    }

    /// One step from `from` to `to`: eq. 5 without `arrived`, the clean sample found at `to`, and eq. 4 with it.
    /// `points[0]` belongs to `from`.
    fn advance<const D: usize>(
        &self,
        x: Tensor<D>,
        from: Level,
        to: Level,
        order: usize,
        points: &VecDeque<Point<D>>,
        arrived: Option<&Tensor<D>>,
    ) -> Tensor<D> {
        let h = to.lambda() - from.lambda();
        let growth = (-h).exp_m1();
        let scale = match self.variant {
            SolverVariant::Bh1 => -h,
            SolverVariant::Bh2 => growth,
        };
        let now = &points[0];
        let older: Vec<(f64, Tensor<D>)> = (points.iter().skip(1).take(order - 1))
            .map(|point| {
                let r = (point.lambda - now.lambda) / h;
                (r, (point.clean.clone() - now.clean.clone()) / r)
            })
            .collect();
        let mut places: Vec<f64> = older.iter().map(|(r, _)| *r).collect();
        let mut differences: Vec<Tensor<D>> = older.into_iter().map(|(_, difference)| difference).collect();
        if let Some(arrived) = arrived {
            places.push(1.0);
            differences.push(arrived.clone() - now.clean.clone());
        }
        let weights = weights(&places, -h, scale);
        let base = x * (to.sigma / from.sigma) - now.clean.clone() * (to.alpha * growth);
        differences
            .into_iter()
            .zip(weights)
            .fold(base, |sum, (difference, weight)| sum - difference * (to.alpha * scale * weight))
    }
}

/// Solves Σ_m weight_m · place_m^(k−1) = φ_k·k!/B for k = 1, 2, ...: the conditions under which the step has full order. A single
/// weight is ½, which is enough for its order (remark in the paper's appendix).
fn weights(places: &[f64], hh: f64, scale: f64) -> Vec<f64> {
    if places.len() <= 1 {
        return vec![0.5; places.len()];
    }
    let mut phi = hh.exp_m1() / hh - 1.0;
    let mut factorial = 1.0;
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for k in 1..=places.len() {
        let mut row: Vec<f64> = places.iter().map(|place| place.powi(k as i32 - 1)).collect();
        row.push(phi * factorial / scale);
        rows.push(row);
        factorial *= (k + 1) as f64;
        phi = phi / hh - 1.0 / factorial;
    }
    solve(rows)
}

/// Gauss–Jordan with row exchange on an augmented matrix of at most three rows.
fn solve(mut rows: Vec<Vec<f64>>) -> Vec<f64> {
    let n = rows.len();
    for column in 0..n {
        let best =
            (column..n).max_by(|a, b| rows[*a][column].abs().total_cmp(&rows[*b][column].abs())).unwrap_or(column);
        rows.swap(column, best);
        let pivot = rows[column].clone();
        for (_, row) in rows.iter_mut().enumerate().filter(|(number, _)| *number != column) {
            let factor = row[column] / pivot[column];
            row.iter_mut().zip(&pivot).for_each(|(value, p)| *value -= factor * p);
        }
    }
    (0..n).map(|i| rows[i][n] / rows[i][i]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_weights_are_those_of_the_closed_form() {
        // Specification 6.6, corrector of order 2.
        let (h, r) = (0.7_f64, -0.6);
        let e = (-h).exp_m1();
        let phi = e / -h - 1.0;
        let (b1, b2) = (phi / e, 2.0 * (phi / -h - 0.5) / e);
        let first = (b1 - b2) / (1.0 - r);
        let got = weights(&[r, 1.0], -h, e);
        assert!((got[0] - first).abs() < 1e-12 && (got[1] - (b1 - first)).abs() < 1e-12);
    }
}
