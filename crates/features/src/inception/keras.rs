//! The nsfwjs stand-in: a Keras network whose variables are stored as 8-bit numbers, read under the names of the 2015 layout.

use std::collections::BTreeMap;

use nn::weights::{WeightError, WeightFile};
use serde::Deserialize;

/// The units in the order in which Keras created and numbered them.
const UNITS: [(&str, &[&str]); 12] = [
    ("", &["Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "Conv2d_3b_1x1", "Conv2d_4a_3x3"]),
    ("Mixed_5b", BLOCK_5),
    ("Mixed_5c", BLOCK_5),
    ("Mixed_5d", BLOCK_5),
    ("Mixed_6a", &["branch3x3", "branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3"]),
    ("Mixed_6b", BLOCK_6),
    ("Mixed_6c", BLOCK_6),
    ("Mixed_6d", BLOCK_6),
    ("Mixed_6e", BLOCK_6),
    ("Mixed_7a", &["branch3x3_1", "branch3x3_2", "branch7x7x3_1", "branch7x7x3_2", "branch7x7x3_3", "branch7x7x3_4"]),
    ("Mixed_7b", BLOCK_7),
    ("Mixed_7c", BLOCK_7),
];
const BLOCK_5: &[&str] =
    &["branch1x1", "branch5x5_1", "branch5x5_2", "branch3x3dbl_1", "branch3x3dbl_2", "branch3x3dbl_3", "branch_pool"];
const BLOCK_6: &[&str] = &[
    "branch1x1",
    "branch7x7_1",
    "branch7x7_2",
    "branch7x7_3",
    "branch7x7dbl_1",
    "branch7x7dbl_2",
    "branch7x7dbl_3",
    "branch7x7dbl_4",
    "branch7x7dbl_5",
    "branch_pool",
];
const BLOCK_7: &[&str] = &[
    "branch1x1",
    "branch3x3_1",
    "branch3x3_2a",
    "branch3x3_2b",
    "branch3x3dbl_1",
    "branch3x3dbl_2",
    "branch3x3dbl_3a",
    "branch3x3dbl_3b",
    "branch_pool",
];

/// `value = q · scale + min`.
#[derive(Debug, Clone, Copy, Deserialize)]
struct Range {
    min: f64,
    scale: f64,
}

/// An open stand-in file with the value range of every tensor.
pub(super) struct Quantised<'f> {
    file: &'f WeightFile,
    ranges: BTreeMap<String, Range>,
    /// Number of a unit, counted from 1.
    numbers: BTreeMap<String, usize>,
}

impl<'f> Quantised<'f> {
    pub fn new(file: &'f WeightFile) -> Result<Self, WeightError> {
        let layout = |reason: String| WeightError::Layout { reason, path: file.path().to_path_buf() };
        let text = file.metadata().get("quantization");
        let text = text.ok_or_else(|| layout("8-bit Keras tensors without the entry quantization".to_owned()))?;
        let ranges = serde_json::from_str(text).map_err(|error| layout(format!("entry quantization: {error}")))?;
        let join = |block: &str, unit: &str| if block.is_empty() { unit.to_owned() } else { format!("{block}.{unit}") };
        let units = UNITS.iter().flat_map(|(block, units)| units.iter().map(move |unit| join(block, unit)));
        Ok(Self { file, ranges, numbers: units.zip(1..).collect() })
    }

    /// Values of a parameter of the 2015 layout, row-major in its shape.
    pub fn values(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightError> {
        let missing = || WeightError::MissingTensor { name: name.to_owned(), path: self.file.path().to_path_buf() };
        let unit = |end: &str| name.strip_suffix(end).and_then(|unit| self.numbers.get(unit));
        if let Some(number) = unit(".conv.weight") {
            return self.kernel(&format!("conv2d_{number}/kernel"), shape);
        }
        // Keras trained these norms without a gain.
        if name.ends_with(".bn.weight") {
            return Ok(vec![1.0; shape.iter().product()]);
        }
        let variables = [("bias", "beta"), ("running_mean", "moving_mean"), ("running_var", "moving_variance")];
        let found = variables
            .iter()
            .find_map(|(ours, theirs)| Some(format!("batch_normalization_{}/{theirs}", unit(&format!(".bn.{ours}"))?)));
        self.read(&found.ok_or_else(missing)?, shape)
    }

    /// `[height, width, in, out]` as `[out, in, height, width]`.
    fn kernel(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightError> {
        let &[out, channels, height, width] = shape else {
            return Err(WeightError::Count { name: name.to_owned(), shape: shape.to_vec(), found: 0 });
        };
        let stored = self.read(name, &[height, width, channels, out])?;
        let mut kernel = vec![0.0; stored.len()];
        for (at, value) in stored.into_iter().enumerate() {
            let (o, i, position) = (at % out, at / out % channels, at / out / channels);
            if let Some(place) = kernel.get_mut((o * channels + i) * height * width + position) {
                *place = value;
            }
        }
        Ok(kernel)
    }

    fn read(&self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightError> {
        let layout = |reason: String| WeightError::Layout { reason, path: self.file.path().to_path_buf() };
        let (found, values) = self.file.integers(name)?;
        if found != shape {
            return Err(layout(format!("{name} is {found:?}, the network needs {shape:?}")));
        }
        let range = self.ranges.get(name).ok_or_else(|| layout(format!("no value range for {name}")))?;
        Ok(values.into_iter().map(|value| (value as f64 * range.scale + range.min) as f32).collect())
    }
}
