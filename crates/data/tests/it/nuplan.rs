//! The nuPlan reader and writer: against the golden numbers, on the fixtures, on databases made and broken here, and against each other.

mod broken;
mod golden;
mod made;
mod malformed;
mod maps;
mod reading;
mod writing;

use data::nuplan::{NuPlan, NuPlanConfig};
use data::{DataError, SceneDataset, SceneFrame};

fn open(config: &NuPlanConfig) -> NuPlan {
    NuPlan::open(config).unwrap()
}

fn frames(dataset: &NuPlan) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

fn variant(error: &DataError) -> &'static str {
    match error {
        DataError::Missing { .. } => "Missing",
        DataError::Format { .. } => "Format",
        DataError::Column { .. } => "Column",
        DataError::Array { .. } => "Array",
        DataError::Dangling { .. } => "Dangling",
        DataError::Calibration { .. } => "Calibration",
        DataError::Annotation { .. } => "Annotation",
        DataError::Image { .. } => "Image",
        DataError::ImageSize { .. } => "ImageSize",
        DataError::UnsafePath { .. } => "UnsafePath",
        DataError::Empty { .. } => "Empty",
        DataError::UnknownClass { .. } => "UnknownClass",
        DataError::Config(_) => "Config",
        _ => "another",
    }
}
