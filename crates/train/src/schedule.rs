//! Learning rate over the steps: linear warm-up, then constant or a cosine down to a floor.

use serde::{Deserialize, Serialize};

/// Factor on the learning rate as a pure function of the step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Schedule {
    /// Steps of linear warm-up; the first step has `1 / warmup_steps`, not 0. With 0 there is none.
    pub warmup_steps: u64,
    /// What follows.
    pub shape: ScheduleShape,
}

/// Course of the learning rate after the warm-up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ScheduleShape {
    /// Stays at the base value.
    #[default]
    Constant,
    /// Half a cosine from the base value in the first step after the warm-up to `floor` times it at the end of the run.
    Cosine {
        /// Share of the base value that is left at the end, in `[0, 1]`.
        floor: f64,
    },
}

impl Schedule {
    /// Factor for `step` (from 0) of a run of `total_steps`.
    pub fn factor(&self, step: u64, total_steps: u64) -> f64 {
        if step < self.warmup_steps {
            return (step + 1) as f64 / self.warmup_steps as f64;
        }
        match self.shape {
            ScheduleShape::Constant => 1.0,
            ScheduleShape::Cosine { floor } => {
                let span = total_steps.saturating_sub(self.warmup_steps).max(1);
                let progress = ((step - self.warmup_steps) as f64 / span as f64).min(1.0);
                floor + (1.0 - floor) * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn warm_up_starts_above_zero_and_ends_at_one() {
        let schedule = Schedule { warmup_steps: 4, shape: ScheduleShape::Constant };
        let factors: Vec<f64> = (0..6).map(|step| schedule.factor(step, 6)).collect();
        assert_eq!(factors, [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]);
        assert_eq!(Schedule::default().factor(0, 10), 1.0);
    }

    #[test]
    fn cosine_passes_its_known_points() {
        let schedule = Schedule { warmup_steps: 2, shape: ScheduleShape::Cosine { floor: 0.1 } };
        for (step, expected) in [(0, 0.5), (1, 1.0), (2, 1.0), (6, 0.55), (10, 0.1), (99, 0.1)] {
            assert!((schedule.factor(step, 10) - expected).abs() < 1e-12, "step {step}");
        }
    }

    #[test]
    fn the_config_form_is_strict() {
        let schedule: Schedule = toml::from_str("warmup_steps = 5\nshape = { cosine = { floor = 0.2 } }").unwrap();
        assert_eq!(schedule, Schedule { warmup_steps: 5, shape: ScheduleShape::Cosine { floor: 0.2 } });
        assert!(toml::from_str::<Schedule>("warm_up = 5").is_err());
        assert!(toml::from_str::<Schedule>("shape = { cosine = { floor = 0.2, period = 3 } }").is_err());
    }
}
