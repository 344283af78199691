//! Building frozen networks from named values. A network reads every value through [`Values`], so the names it needs are
//! exactly those that it asks for.

use std::collections::BTreeMap;

use burn::tensor::{Device, Tensor, TensorData};
use nn::weights::{Mismatch, WeightError, WeightFile};

/// Counters that PyTorch keeps beside every batch norm.
pub(crate) const NORM_COUNTER: &str = ".num_batches_tracked";

/// Where values come from: by name and shape.
pub(crate) type Read<'a> = dyn FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError> + 'a;

/// Hands out values by name and shape.
pub(crate) struct Values<'a> {
    read: &'a mut Read<'a>,
    /// Without a tape: constants are lifted onto one only when the images are on one.
    device: Device,
}

impl<'a> Values<'a> {
    pub fn new(device: &Device, read: &'a mut Read<'a>) -> Self {
        Self { read, device: device.clone().without_autodiff() }
    }

    /// Values of one tensor, row-major.
    pub fn host(&mut self, name: &str, shape: &[usize]) -> Result<Vec<f32>, WeightError> {
        let data = (self.read)(name, shape)?;
        if data.len() != shape.iter().product::<usize>() {
            return Err(WeightError::Count { name: name.to_owned(), shape: shape.to_vec(), found: data.len() });
        }
        Ok(data)
    }

    /// Puts values on the device.
    pub fn put<const D: usize>(&self, data: Vec<f32>, shape: [usize; D]) -> Tensor<D> {
        Tensor::from_data(TensorData::new(data, shape), &self.device)
    }

    /// One tensor, on the device.
    pub fn tensor<const D: usize>(&mut self, name: &str, shape: [usize; D]) -> Result<Tensor<D>, WeightError> {
        let data = self.host(name, &shape)?;
        Ok(self.put(data, shape))
    }

    /// A kernel `[out, ..]` without a bias and the batch norm behind it (in inference mode) as one kernel and one bias.
    pub fn folded<const D: usize>(
        &mut self,
        kernel: &str,
        shape: [usize; D],
        norm: &str,
        epsilon: f64,
    ) -> Result<(Tensor<D>, Tensor<1>), WeightError> {
        let mut weight = self.host(&format!("{kernel}.weight"), &shape)?;
        let [channels, rest @ ..] = shape.as_slice() else {
            return Ok((self.put(weight, shape), self.put(vec![], [0])));
        };
        let mut of_norm = |part: &str| self.host(&format!("{norm}.{part}"), &[*channels]);
        let (gain, offset) = (of_norm("weight")?, of_norm("bias")?);
        let (mean, variance) = (of_norm("running_mean")?, of_norm("running_var")?);
        let scale = |at: usize| f64::from(gain[at]) / (f64::from(variance[at]) + epsilon).sqrt();
        let row = rest.iter().product::<usize>().max(1);
        for (at, values) in weight.chunks_mut(row).enumerate() {
            values.iter_mut().for_each(|value| *value = (f64::from(*value) * scale(at)) as f32);
        }
        let bias = (0..*channels).map(|at| (f64::from(offset[at]) - f64::from(mean[at]) * scale(at)) as f32);
        Ok((self.put(weight, shape), self.put(bias.collect(), [*channels])))
    }
}

/// Builds a network from a file whose names and shapes must be exactly what `build` asks for, but for those that
/// `is_unused` allows besides.
pub(crate) fn load_strict<N>(
    file: &WeightFile,
    device: &Device,
    is_unused: impl Fn(&str) -> bool,
    build: impl Fn(&mut Values<'_>) -> Result<N, WeightError>,
) -> Result<N, WeightError> {
    let mut wanted = BTreeMap::new();
    build(&mut Values::new(&Device::flex(), &mut |name: &str, shape: &[usize]| {
        wanted.insert(name.to_owned(), shape.to_vec());
        Ok(vec![1.0; shape.iter().product()])
    }))?;
    let found = file.names().filter(|name| wanted.contains_key(*name) || !is_unused(name));
    let found = found.filter_map(|name| Some((name.to_owned(), file.shape(name)?.to_vec()))).collect();
    let mismatch = Mismatch::between(&wanted, &found);
    if !mismatch.is_empty() {
        return Err(WeightError::Mismatch(Box::new(mismatch)).in_file(file.path()));
    }
    build(&mut Values::new(device, &mut |name: &str, _: &[usize]| Ok(file.tensor(name)?.data)))
}

/// A constant where `input` is: on its tape, if it has one.
pub(crate) fn beside<const D: usize, const E: usize>(constant: &Tensor<D>, input: &Tensor<E>) -> Tensor<D> {
    if input.is_autodiff() { Tensor::from_inner(constant.clone()) } else { constant.clone() }
}
