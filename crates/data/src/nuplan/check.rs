//! A look at every picture before training starts.

use super::NuPlan;
use super::config::NuPlanConfig;
use crate::DataError;
use crate::check::{CheckReport, check as check_dataset};

/// What a check of the chosen logs found.
#[derive(Debug)]
pub struct NuPlanCheck {
    /// The logs with pictures.
    pub report: CheckReport,
    /// Logs of the split without a single picture. No fault: the release is like that.
    pub logs_without_pictures: Vec<String>,
}

/// Opens the databases, looks at every picture of every frame (existence, size, end), reads every frame's boxes and decodes `decode`
/// random pictures of each log completely.
///
/// # Errors
/// Broken databases and poses; broken pictures are listed in the report.
pub fn check(config: &NuPlanConfig, decode: usize) -> Result<NuPlanCheck, DataError> {
    let dataset = NuPlan::open(config)?;
    let report = check_dataset(&dataset, decode)?;
    Ok(NuPlanCheck { report, logs_without_pictures: dataset.logs_without_pictures().to_vec() })
}
