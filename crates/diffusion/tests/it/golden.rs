//! Reads `golden/samplers`.

use std::path::PathBuf;

use burn::tensor::{Device, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};

/// The stored numbers.
pub struct Golden {
    bytes: Vec<u8>,
    /// Scheduler, settings and model of every trajectory.
    pub cases: serde_json::Value,
}

impl Golden {
    /// `None` where no golden folder is named; a named folder must hold everything.
    pub fn open() -> Option<Self> {
        let folder = PathBuf::from(std::env::var_os("RIGSCAPE_GOLDEN")?).join("samplers");
        let read = |name: &str| {
            let path = folder.join(name);
            std::fs::read(&path).unwrap_or_else(|error| panic!("{error}: {}", path.display()))
        };
        // Python writes infinities into JSON; none of those settings is read here.
        let text =
            String::from_utf8(read("cases.json")).unwrap().replace("-Infinity", "null").replace("Infinity", "null");
        let cases = serde_json::from_str(&text).unwrap();
        Some(Self { bytes: read("io.safetensors"), cases })
    }

    /// Shape and values as f64.
    pub fn values(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        let file = SafeTensors::deserialize(&self.bytes).unwrap();
        let view = file.tensor(name).unwrap_or_else(|error| panic!("{name}: {error}"));
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => data.as_chunks::<4>().0.iter().map(|b| f64::from(f32::from_le_bytes(*b))).collect(),
            Dtype::F64 => data.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect(),
            Dtype::I64 => data.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b) as f64).collect(),
            other => panic!("{name} holds {other:?}"),
        };
        (view.shape().to_vec(), values)
    }

    /// One entry along the first axis, or the whole tensor.
    pub fn tensor(&self, name: &str, entry: Option<usize>, device: &Device) -> Tensor<4> {
        let (shape, values) = self.values(name);
        let (shape, values) = match entry {
            None => (shape, values),
            Some(entry) => {
                let size: usize = shape[1..].iter().product();
                (shape[1..].to_vec(), values[entry * size..(entry + 1) * size].to_vec())
            }
        };
        let values: Vec<f32> = values.into_iter().map(|v| v as f32).collect();
        Tensor::from_data(TensorData::new(values, shape), device)
    }
}

/// Fails unless `|a − b| ≤ tolerance · max(1, largest |b|)` everywhere.
pub fn assert_close(got: &Tensor<4>, want: &Tensor<4>, tolerance: f32, what: &str) {
    let worst = (got.clone() - want.clone()).abs().max().into_scalar::<f32>();
    let scale = want.clone().abs().max().into_scalar::<f32>().max(1.0);
    assert!(worst <= tolerance * scale, "{what}: off by {worst}, values up to {scale}");
}
