//! What the tests of several networks need.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};
use nn::golden::golden_stream;
use nn::weights::{HostTensor, WeightError, write_safetensors};

pub fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.try_into_vec_as().unwrap()
}

/// Values in (0, 1) from a name.
pub fn stream<const D: usize>(name: &str, shape: [usize; D], device: &Device) -> Tensor<D> {
    let values = golden_stream(name, shape.iter().product());
    Tensor::from_data(
        TensorData::new(values.iter().map(|&x| (0.5 + 0.5 * x) as f32).collect::<Vec<_>>(), shape),
        device,
    )
}

/// u8 values of `[N, C, H, W]` as f32.
pub fn from_bytes((shape, bytes): (Vec<usize>, Vec<u8>), device: &Device) -> Tensor<4> {
    let values: Vec<f32> = bytes.into_iter().map(f32::from).collect();
    let shape: [usize; 4] = shape.try_into().unwrap();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// The slope of `loss` along the signs of its gradient agrees with central differences.
pub fn check_slope<const D: usize>(
    start: &Tensor<D>,
    step: f64,
    tolerance: f64,
    loss: impl Fn(Tensor<D>) -> Tensor<1>,
) {
    let value = |input| f64::from(host(loss(input))[0]);
    let leaf = start.clone().require_grad();
    let gradient = leaf.grad(&loss(leaf.clone()).backward()).unwrap();
    let direction = Tensor::from_inner(gradient.clone().sign());
    let analytic: f64 = host(gradient).iter().map(|slope| f64::from(slope.abs())).sum();
    let ahead = value(start.clone() + direction.clone() * step);
    let behind = value(start.clone() - direction * step);
    let numeric = (ahead - behind) / (2.0 * step);
    eprintln!("slope {analytic} against {numeric}");
    assert!(analytic > 0.0 && (numeric / analytic - 1.0).abs() <= tolerance, "{analytic} against {numeric}");
}

/// A file with one tensor of zeros.
pub fn file_of(name: &str, shape: &[usize]) -> tempfile::NamedTempFile {
    let file = tempfile::NamedTempFile::new().unwrap();
    let tensor = HostTensor::new(shape, vec![0.0; shape.iter().product()]);
    write_safetensors(file.path(), &[(name.to_owned(), tensor)], &BTreeMap::new()).unwrap();
    file
}

/// The names and shapes that loading this file asked for in vain are these, but for `present`.
pub fn assert_missing(error: WeightError, mut wanted: BTreeMap<String, Vec<usize>>, present: &str) {
    let WeightError::Mismatch(mismatch) = error else { panic!("{error}") };
    assert!(mismatch.path.is_some());
    assert!(wanted.remove(present).is_some(), "{present}");
    assert_eq!(mismatch.missing.into_iter().collect::<BTreeMap<_, _>>(), wanted);
    assert!(mismatch.wrong_shape.is_empty() && mismatch.unexpected.is_empty());
}
