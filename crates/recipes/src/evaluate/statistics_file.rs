//! Saved mean and covariance of a set's features: our own safetensors files, which say what they belong to, and pytorch-fid's `.npz`.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, bail};
use data::npz::{Dtype, Npz, Want, npz_bytes};
use metrics::FeatureStatistics;
use safetensors::tensor::TensorView;
use safetensors::{Dtype as TensorDtype, SafeTensors};

/// Statistics and what they belong to: protocol, network, weights, set, seed.
#[derive(Debug, Clone, PartialEq)]
pub struct SavedStatistics {
    /// Mean, covariance, count.
    pub statistics: FeatureStatistics,
    /// Empty for files of pytorch-fid, which do not tell.
    pub metadata: BTreeMap<String, String>,
}

/// Entries that must agree before two sets may be compared.
const MUST_AGREE: [&str; 4] = ["protocol", "network", "weights_sha256", "size"];

impl SavedStatistics {
    /// Reads a file; its ending chooses the layout.
    ///
    /// # Errors
    /// Names the file that is missing, damaged or of neither layout.
    pub fn read(path: &Path) -> anyhow::Result<Self> {
        let bytes = std::fs::read(path).with_context(|| format!("cannot read the statistics {}", path.display()))?;
        let found = match path.extension().and_then(|end| end.to_str()) {
            Some("npz") => read_npz(bytes, path),
            Some("safetensors") => read_safetensors(&bytes),
            _ => bail!("statistics end in .safetensors, or .npz for pytorch-fid: {}", path.display()),
        };
        let found = found.with_context(|| format!("no usable statistics in {}", path.display()))?;
        let numbers = || found.statistics.mean.iter().chain(&found.statistics.covariance);
        if found.statistics.mean.is_empty() || numbers().any(|value| !value.is_finite()) {
            bail!("the statistics hold no numbers, NaN or infinity: {}", path.display());
        }
        Ok(found)
    }

    /// Writes a file beside its name and renames it; the ending chooses the layout.
    ///
    /// # Errors
    /// Names the file.
    pub fn write(&self, path: &Path) -> anyhow::Result<()> {
        let bytes = match path.extension().and_then(|end| end.to_str()) {
            Some("npz") => self.npz()?,
            Some("safetensors") => self.safetensors()?,
            _ => bail!("statistics end in .safetensors, or .npz for pytorch-fid: {}", path.display()),
        };
        super::write_file(path, &bytes)
    }

    /// Refuses statistics that were made in another way.
    ///
    /// # Errors
    /// Names the entry and both values.
    pub fn must_fit(&self, wanted: &BTreeMap<String, String>, path: &Path) -> anyhow::Result<()> {
        for key in MUST_AGREE {
            if let (Some(found), Some(wanted)) = (self.metadata.get(key), wanted.get(key))
                && found != wanted
            {
                bail!(
                    "the statistics were made with {key} {found}, this run has {wanted}; make them anew with --save-stats: {}",
                    path.display()
                );
            }
        }
        Ok(())
    }

    fn npz(&self) -> anyhow::Result<Vec<u8>> {
        let width = self.statistics.width();
        let (mean, covariance) = (bytes_of(&self.statistics.mean), bytes_of(&self.statistics.covariance));
        let arrays: [(&str, Dtype, &[usize], &[u8]); 2] =
            [("mu", Dtype::F64, &[width], &mean), ("sigma", Dtype::F64, &[width, width], &covariance)];
        Ok(npz_bytes(&arrays)?)
    }

    fn safetensors(&self) -> anyhow::Result<Vec<u8>> {
        let width = self.statistics.width();
        let (mean, covariance) = (bytes_of(&self.statistics.mean), bytes_of(&self.statistics.covariance));
        let count = (self.statistics.count.unwrap_or(0) as u64).to_le_bytes();
        let tensors = [
            ("mu", TensorView::new(TensorDtype::F64, vec![width], &mean)?),
            ("sigma", TensorView::new(TensorDtype::F64, vec![width, width], &covariance)?),
            ("count", TensorView::new(TensorDtype::U64, vec![1], &count)?),
        ];
        let metadata = self.metadata.clone().into_iter().collect();
        Ok(safetensors::serialize(tensors, Some(metadata))?)
    }
}

fn bytes_of(values: &[f64]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

fn read_npz(bytes: Vec<u8>, path: &Path) -> anyhow::Result<SavedStatistics> {
    let mut file = Npz::parse(bytes, path)?;
    let dtypes = &[Dtype::F64, Dtype::F32];
    let mean = file.array("mu", &Want { dtypes, shape: &[None] })?.to_f64();
    let width = Some(mean.len());
    let covariance = file.array("sigma", &Want { dtypes, shape: &[width, width] })?.to_f64();
    let statistics = FeatureStatistics { count: None, mean, covariance };
    Ok(SavedStatistics { statistics, metadata: BTreeMap::new() })
}

fn read_safetensors(bytes: &[u8]) -> anyhow::Result<SavedStatistics> {
    let (_, header) = SafeTensors::read_metadata(bytes)?;
    let metadata = header.metadata().clone().unwrap_or_default().into_iter().collect();
    let file = SafeTensors::deserialize(bytes)?;
    let doubles = |name: &str| -> anyhow::Result<(Vec<usize>, Vec<f64>)> {
        let tensor = file.tensor(name)?;
        if tensor.dtype() != TensorDtype::F64 {
            bail!("{name} is {:?}, not F64", tensor.dtype());
        }
        let values = tensor.data().chunks_exact(8).filter_map(|bytes| Some(f64::from_le_bytes(bytes.try_into().ok()?)));
        Ok((tensor.shape().to_vec(), values.collect()))
    };
    let ((shape, mean), (square, covariance)) = (doubles("mu")?, doubles("sigma")?);
    if shape.len() != 1 || square != [mean.len(), mean.len()] {
        bail!("mu is {shape:?} and sigma {square:?} where [D] and [D, D] are expected");
    }
    let count = file.tensor("count")?;
    let count = count.data().first_chunk::<8>().map(|bytes| u64::from_le_bytes(*bytes) as usize);
    let statistics = FeatureStatistics { count: count.filter(|count| *count > 0), mean, covariance };
    Ok(SavedStatistics { statistics, metadata })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn saved() -> SavedStatistics {
        let statistics =
            FeatureStatistics { count: Some(7), mean: vec![1.5, -2.0], covariance: vec![2.0, 0.25, 0.25, 1.0] };
        let entries = [("protocol", "fid/plain"), ("weights_sha256", "abc")];
        let metadata = entries.map(|(key, value)| (key.to_owned(), value.to_owned())).into();
        SavedStatistics { statistics, metadata }
    }

    #[test]
    fn both_layouts_come_back() {
        let folder = tempfile::tempdir().unwrap();
        let own = folder.path().join("a.safetensors");
        saved().write(&own).unwrap();
        assert_eq!(SavedStatistics::read(&own).unwrap(), saved());
        let other = folder.path().join("a.npz");
        saved().write(&other).unwrap();
        let found = SavedStatistics::read(&other).unwrap();
        assert_eq!((found.statistics.mean, found.statistics.count), (saved().statistics.mean, None));
        assert_eq!(found.statistics.covariance, saved().statistics.covariance);
    }

    #[test]
    fn wrong_files_and_other_settings_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("b.npz");
        std::fs::write(&path, b"no zip").unwrap();
        let refusal = |path: &Path| format!("{:#}", SavedStatistics::read(path).unwrap_err());
        assert!(refusal(&path).contains("b.npz"));
        assert!(refusal(&folder.path().join("absent.npz")).contains("absent.npz"));
        let named = folder.path().join("c.txt");
        std::fs::write(&named, b"x").unwrap();
        assert!(refusal(&named).contains(".safetensors"));
        let mut broken = saved();
        broken.statistics.mean[0] = f64::NAN;
        let path = folder.path().join("d.safetensors");
        broken.write(&path).unwrap();
        assert!(refusal(&path).contains("NaN"));
        let wanted = BTreeMap::from([("weights_sha256".to_owned(), "def".to_owned())]);
        let error = saved().must_fit(&wanted, &path).unwrap_err().to_string();
        assert!(error.contains("abc") && error.contains("def"), "{error}");
        assert!(saved().must_fit(&saved().metadata, &path).is_ok());
    }
}
