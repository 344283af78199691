//! Guard against NaN and infinity: a bad update is skipped and counted, too many in a row end the run.

use serde::{Deserialize, Serialize};

use crate::TrainError;

/// Counts updates that were skipped because a number was not finite.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NonFiniteGuard {
    in_a_row: u32,
    total: u64,
}

/// What the guard says about one update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GuardVerdict {
    /// All numbers are finite: do the update.
    Proceed,
    /// Leave parameters, optimizer and moving average as they are.
    Skip,
}

impl NonFiniteGuard {
    /// Skipped updates since the start of the run.
    pub fn total(&self) -> u64 {
        self.total
    }

    /// Judges one update. `culprit` names the gradient or scalar that is not finite, `None` when all are.
    ///
    /// # Errors
    /// [`TrainError::NonFinite`] when this is the `stop_after`-th skipped update in a row (never for 0).
    pub fn judge(&mut self, step: u64, culprit: Option<&str>, stop_after: u32) -> Result<GuardVerdict, TrainError> {
        let Some(culprit) = culprit else {
            self.in_a_row = 0;
            return Ok(GuardVerdict::Proceed);
        };
        self.in_a_row += 1;
        self.total += 1;
        if stop_after > 0 && self.in_a_row >= stop_after {
            return Err(TrainError::NonFinite { culprit: culprit.to_string(), step, in_a_row: self.in_a_row });
        }
        tracing::warn!(step, culprit, in_a_row = self.in_a_row, "not finite, this update is skipped");
        Ok(GuardVerdict::Skip)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_good_update_ends_the_row_and_the_error_names_step_and_culprit() {
        let mut guard = NonFiniteGuard::default();
        assert_eq!(guard.judge(0, Some("loss"), 3).unwrap(), GuardVerdict::Skip);
        assert_eq!(guard.judge(1, Some("loss"), 3).unwrap(), GuardVerdict::Skip);
        assert_eq!(guard.judge(2, None, 3).unwrap(), GuardVerdict::Proceed);
        for step in 3..5 {
            assert_eq!(guard.judge(step, Some("grad w"), 3).unwrap(), GuardVerdict::Skip);
        }
        let error = guard.judge(5, Some("grad w"), 3).unwrap_err().to_string();
        assert!(error.contains("step 5") && error.contains("grad w") && error.contains('3'), "{error}");
        assert_eq!(guard.total(), 5);
    }
}
