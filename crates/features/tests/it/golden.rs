//! Reading reference outputs: whole tensors, or strided values and probes of large ones.

use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};

/// The folder of one topic. Without `RIGSCAPE_GOLDEN` an absent folder is none, with it a failure.
pub fn folder(topic: &str) -> Option<PathBuf> {
    let (root, required) = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => (PathBuf::from(root), true),
        None => (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"), false),
    };
    let folder = root.join(topic);
    if folder.is_dir() {
        return Some(folder);
    }
    assert!(!required, "RIGSCAPE_GOLDEN has no folder {topic}");
    eprintln!("golden folder {topic} is absent and RIGSCAPE_GOLDEN is not set: this test did not run");
    None
}

/// The bytes of one safetensors file.
pub struct Golden(Vec<u8>);

impl Golden {
    pub fn open(path: &Path) -> Self {
        Self(std::fs::read(path).unwrap_or_else(|error| panic!("{error}: {}", path.display())))
    }

    fn file(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.0).unwrap()
    }

    /// Shape and bytes of a u8 tensor.
    pub fn bytes(&self, name: &str) -> (Vec<usize>, Vec<u8>) {
        let file = self.file();
        let view = file.tensor(name).unwrap();
        assert_eq!(view.dtype(), Dtype::U8, "{name}");
        (view.shape().to_vec(), view.data().to_vec())
    }

    /// Values of an f32 tensor.
    pub fn floats(&self, name: &str) -> Option<Vec<f32>> {
        let file = self.file();
        let view = file.tensor(name).ok()?;
        assert_eq!(view.dtype(), Dtype::F32, "{name}");
        Some(view.data().chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect())
    }

    /// Shape of a tensor that is stored whole.
    pub fn shape(&self, name: &str) -> Vec<usize> {
        self.file().tensor(name).unwrap().shape().to_vec()
    }

    /// Golden values of a parameter, unless the file overrides them.
    pub fn parameter(&self, name: &str, shape: &[usize]) -> Vec<f32> {
        let own = self.floats(&format!("override/{name}"));
        own.unwrap_or_else(|| nn::golden::golden_values(name, shape))
    }

    pub fn indices(&self, name: &str) -> Vec<usize> {
        let file = self.file();
        let view = file.tensor(name).unwrap();
        assert_eq!(view.dtype(), Dtype::I64, "{name}");
        view.data().chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as usize).collect()
    }

    /// Names without the suffixes of strided storage, sorted.
    pub fn names(&self) -> Vec<String> {
        let stem = |name: &str| name.strip_suffix(".strided").unwrap_or(name).to_owned();
        let suffixes = [".stats", ".probe_index", ".probe_value"];
        let file = self.file();
        let kept = file.names().into_iter().filter(|name| !suffixes.iter().any(|suffix| name.ends_with(suffix)));
        let mut names: Vec<_> = kept.map(stem).collect();
        names.sort();
        names
    }

    /// Compares a tensor with everything stored of it; `tolerance` is relative to the largest stored magnitude.
    pub fn check(&self, name: &str, actual: &[f32], tolerance: f32) {
        let errors = self.sorted_errors(name, actual);
        let worst = errors[errors.len() - 1];
        eprintln!("{name}: error {worst:.1e} of the maximum");
        assert!(worst <= tolerance, "{name}: error {worst} of the maximum");
    }

    /// Compares a tensor with everything stored of it; `tolerance` is absolute.
    pub fn check_absolute(&self, name: &str, actual: &[f32], tolerance: f32) {
        assert!(actual.iter().all(|value| value.is_finite()), "{name}");
        let (expected, actual) = self.stored(name, actual);
        let worst = expected.iter().zip(&actual).map(|(e, a)| (e - a).abs()).fold(0.0, f32::max);
        eprintln!("{name}: error {worst:.1e}");
        assert!(worst <= tolerance, "{name}: error {worst}");
    }

    /// As [`Golden::check`] for a gradient through ReLUs and max pools. Where the input of one is zero up to rounding,
    /// its slope is a matter of chance and moves a few pixels, so a twentieth of the values may be off by 1e-2.
    pub fn check_gradient(&self, name: &str, actual: &[f32], tolerance: f32) {
        let errors = self.sorted_errors(name, actual);
        let (most, worst) = (errors[errors.len() * 19 / 20], errors[errors.len() - 1]);
        eprintln!("{name}: error {most:.1e} of the maximum for 95 % of the values, {worst:.1e} for all");
        assert!(most <= tolerance && worst <= 1e-2, "{name}: errors {most}, {worst} of the maximum");
    }

    /// Errors over the largest stored magnitude, ascending.
    fn sorted_errors(&self, name: &str, actual: &[f32]) -> Vec<f32> {
        assert!(actual.iter().all(|value| value.is_finite()), "{name}");
        let (expected, actual) = self.stored(name, actual);
        let largest = expected.iter().fold(0.0_f32, |max, value| max.max(value.abs()));
        assert!(largest > 0.0, "{name} holds zeros only");
        let mut errors: Vec<f32> = expected.iter().zip(&actual).map(|(e, a)| (e - a).abs() / largest).collect();
        errors.sort_by(f32::total_cmp);
        errors
    }

    /// Everything stored of a tensor, and the same elements of `actual`.
    fn stored(&self, name: &str, actual: &[f32]) -> (Vec<f32>, Vec<f32>) {
        if let Some(full) = self.floats(name) {
            assert_eq!(full.len(), actual.len(), "{name}");
            return (full, actual.to_vec());
        }
        let mut expected = self.floats(&format!("{name}.strided")).unwrap_or_else(|| panic!("no {name}"));
        let step = stride(actual.len(), expected.len());
        let mut chosen: Vec<f32> = actual.iter().copied().step_by(step).collect();
        expected.extend(self.floats(&format!("{name}.probe_value")).unwrap());
        chosen.extend(self.indices(&format!("{name}.probe_index")).into_iter().map(|index| actual[index]));
        (expected, chosen)
    }
}

/// The step that leaves `kept` of `total` values; the stored steps have no factor 2, 3 or 5.
fn stride(total: usize, kept: usize) -> usize {
    let fits =
        |step: &usize| total.div_ceil(*step) == kept && ![2, 3, 5].iter().any(|factor| step.is_multiple_of(*factor));
    (1..=total).find(fits).unwrap_or_else(|| panic!("no step leaves {kept} of {total} values"))
}

/// Names and shapes of a golden network's parameters, without the counters beside batch norms.
pub fn manifest(folder: &Path) -> std::collections::BTreeMap<String, Vec<usize>> {
    let text = std::fs::read_to_string(folder.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&text).unwrap();
    let parameter = |entry: &serde_json::Value| {
        let shape = entry["shape"].as_array().unwrap().iter().map(|length| length.as_u64().unwrap() as usize).collect();
        (entry["name"].as_str().unwrap().to_owned(), shape)
    };
    let all = manifest["parameters"].as_array().unwrap().iter().map(parameter);
    all.filter(|(name, _)| !name.ends_with(".num_batches_tracked")).collect()
}

/// The folder of the real weights. Without `RIGSCAPE_WEIGHTS` there is none.
pub fn weights() -> Option<PathBuf> {
    let folder = std::env::var_os("RIGSCAPE_WEIGHTS").map(PathBuf::from);
    if folder.is_none() {
        eprintln!("RIGSCAPE_WEIGHTS is not set: this test did not run");
    }
    folder
}
