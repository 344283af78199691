//! Walking the float parameters of a burn module by path. Values are in the module's own memory layout.

use std::collections::BTreeMap;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param};
use burn::tensor::{Tensor, TensorData};

use super::{HostTensor, Mismatch, WeightError};

/// All float parameters with their paths, in the order of the module's fields.
///
/// # Errors
/// [`WeightError::Readback`] when a device fails.
pub fn named_params<M: Module>(module: &M) -> Result<Vec<(String, HostTensor)>, WeightError> {
    let mut collector = ValueCollector::default();
    module.visit(&mut collector);
    collector.error.map_or(Ok(collector.found), Err)
}

/// Paths and shapes of all float parameters, without touching their values.
#[must_use]
pub fn param_shapes<M: Module>(module: &M) -> Vec<(String, Vec<usize>)> {
    let mut collector = ShapeCollector::default();
    module.visit(&mut collector);
    collector.found
}

/// Replaces every float parameter by the values that `values(path, shape)` returns for it.
///
/// Parameter ids, devices and whether a parameter is trained stay as they are.
///
/// # Errors
/// The first error of `values`, or [`WeightError::Count`] when it returns another number of values.
pub fn fill_params<M: Module>(
    module: M,
    mut values: impl FnMut(&str, &[usize]) -> Result<Vec<f32>, WeightError>,
) -> Result<M, WeightError> {
    fill_some_params(module, |name, shape| values(name, shape).map(Some))
}

/// As [`fill_params`], but parameters for which `values` returns nothing keep what they have.
///
/// # Errors
/// As [`fill_params`].
pub fn fill_some_params<M: Module>(
    module: M,
    values: impl FnMut(&str, &[usize]) -> Result<Option<Vec<f32>>, WeightError>,
) -> Result<M, WeightError> {
    let mut filler = Filler { path: Path::default(), values, error: None };
    let module = module.map(&mut filler);
    filler.error.map_or(Ok(module), Err)
}

/// Replaces every float parameter by the tensor of the same path; all names and shapes must fit.
///
/// # Errors
/// [`WeightError::Mismatch`] with every missing, unexpected and wrongly shaped name.
pub fn load_strict<M: Module>(module: M, mut tensors: BTreeMap<String, HostTensor>) -> Result<M, WeightError> {
    let wanted = param_shapes(&module).into_iter().collect();
    let found = tensors.iter().map(|(name, tensor)| (name.clone(), tensor.shape.clone())).collect();
    let mismatch = Mismatch::between(&wanted, &found);
    if !mismatch.is_empty() {
        return Err(WeightError::Mismatch(Box::new(mismatch)));
    }
    fill_params(module, |name, _| Ok(tensors.remove(name).map(|tensor| tensor.data).unwrap_or_default()))
}

/// The names from the root down to where a walk stands.
#[derive(Default)]
struct Path(Vec<String>);

impl Path {
    fn enter(&mut self, name: &str) {
        self.0.push(name.to_owned());
    }

    fn exit(&mut self) {
        self.0.pop();
    }

    fn joined(&self) -> String {
        self.0.join(".")
    }
}

#[derive(Default)]
struct ShapeCollector {
    path: Path,
    found: Vec<(String, Vec<usize>)>,
}

impl ModuleVisitor for ShapeCollector {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        self.found.push((self.path.joined(), param.lazy_shape().as_slice().to_vec()));
    }

    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.enter(name);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.exit();
    }
}

#[derive(Default)]
struct ValueCollector {
    path: Path,
    found: Vec<(String, HostTensor)>,
    error: Option<WeightError>,
}

impl ModuleVisitor for ValueCollector {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        let value = param.val();
        let shape = value.dims().to_vec();
        match value.try_into_vec_as::<f32>() {
            Ok(data) => self.found.push((self.path.joined(), HostTensor { shape, data })),
            Err(error) => {
                let failed = WeightError::Readback { name: self.path.joined(), reason: error.to_string() };
                self.error.get_or_insert(failed);
            }
        }
    }

    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.enter(name);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.exit();
    }
}

struct Filler<F> {
    path: Path,
    values: F,
    error: Option<WeightError>,
}

impl<F: FnMut(&str, &[usize]) -> Result<Option<Vec<f32>>, WeightError>> Filler<F> {
    fn checked_values(&mut self, shape: &[usize]) -> Result<Option<Vec<f32>>, WeightError> {
        let name = self.path.joined();
        let values = (self.values)(&name, shape)?;
        match &values {
            Some(values) if values.len() != shape.iter().product::<usize>() => {
                Err(WeightError::Count { name, shape: shape.to_vec(), found: values.len() })
            }
            _ => Ok(values),
        }
    }
}

impl<F: FnMut(&str, &[usize]) -> Result<Option<Vec<f32>>, WeightError>> ModuleMapper for Filler<F> {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        if self.error.is_some() {
            return param;
        }
        let shape = param.lazy_shape().as_slice().to_vec();
        match self.checked_values(&shape) {
            Ok(None) => param,
            // A parameter that was never used is replaced without drawing its first values.
            Ok(Some(values)) if !param.is_initialized() => {
                let new = Tensor::from_data(TensorData::new(values, shape), &param.lazy_device());
                let id = param.id;
                param.transform_for_load(new, id)
            }
            Ok(Some(values)) => param.map(|old| {
                let new = Tensor::from_data(TensorData::new(values, shape), &old.device());
                if old.is_require_grad() { new.require_grad() } else { new }
            }),
            Err(error) => {
                self.error = Some(error);
                param
            }
        }
    }

    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.enter(name);
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.exit();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::golden::golden_values;
    use burn::tensor::Device;

    #[derive(Module, Debug)]
    struct Leaf {
        weight: Param<Tensor<2>>,
        bias: Option<Param<Tensor<1>>>,
    }

    #[derive(Module, Debug)]
    struct Tree {
        leaves: Vec<Leaf>,
        gain: Param<Tensor<1>>,
    }

    fn tree(device: &Device) -> Tree {
        let leaf = |rows: usize, bias: bool| Leaf {
            weight: Param::from_tensor(Tensor::zeros([rows, 2], device)),
            bias: bias.then(|| Param::from_tensor(Tensor::zeros([rows], device))),
        };
        let gain = Param::from_tensor(Tensor::ones([3], device)).set_require_grad(false);
        Tree { leaves: vec![leaf(2, true), leaf(3, false)], gain }
    }

    fn golden(tree: &Tree) -> BTreeMap<String, HostTensor> {
        let named = param_shapes(tree).into_iter();
        named.map(|(name, shape)| (name.clone(), HostTensor::new(&shape, golden_values(&name, &shape)))).collect()
    }

    #[test]
    fn paths_shapes_and_values() {
        let tree = tree(&Device::flex());
        let names: Vec<_> = param_shapes(&tree);
        let expected = [
            ("leaves.0.weight", vec![2, 2]),
            ("leaves.0.bias", vec![2]),
            ("leaves.1.weight", vec![3, 2]),
            ("gain", vec![3]),
        ];
        assert_eq!(names, expected.map(|(name, shape)| (name.to_owned(), shape)));
        assert_eq!(named_params(&tree).unwrap()[3].1, HostTensor::new(&[3], vec![1.0; 3]));
    }

    #[test]
    fn loading_keeps_ids_devices_and_training_state() {
        for device in [Device::flex(), Device::flex().autodiff()] {
            let before = tree(&device);
            let tensors = golden(&before);
            let after = load_strict(before.clone(), tensors.clone()).unwrap();
            assert_eq!(named_params(&after).unwrap().into_iter().collect::<BTreeMap<_, _>>(), tensors);
            assert_eq!(after.gain.id, before.gain.id);
            assert_eq!(after.leaves[0].weight.device().is_autodiff(), device.is_autodiff());
            assert_eq!(after.leaves[0].weight.is_require_grad(), device.is_autodiff());
            assert!(!after.gain.is_require_grad());
            let trained = after.train();
            assert!(trained.leaves[1].weight.is_require_grad() && !trained.gain.is_require_grad());
        }
    }

    #[test]
    fn every_difference_is_listed() {
        let tree = tree(&Device::flex());
        let mut tensors = golden(&tree);
        tensors.remove("gain");
        tensors.remove("leaves.0.bias");
        tensors.insert("leaves.0.b".to_owned(), HostTensor::new(&[2], vec![0.0; 2]));
        tensors.insert("leaves.1.weight".to_owned(), HostTensor::new(&[2, 3], vec![0.0; 6]));
        let Err(error) = load_strict(tree, tensors) else { panic!("loaded") };
        let text = error.in_file(std::path::Path::new("dir/w.safetensors")).to_string();
        let lines: Vec<_> = text.lines().map(str::trim).collect();
        assert_eq!(
            lines,
            [
                "weights do not fit: 2 missing, 1 unexpected, 1 of another shape",
                "missing     gain [3]",
                "missing     leaves.0.bias [2]",
                "unexpected  leaves.0.b",
                "shape       leaves.1.weight is [2, 3], the model needs [3, 2]",
                "in: dir/w.safetensors",
            ]
        );
    }

    #[test]
    fn parameters_without_new_values_keep_theirs() {
        let before = tree(&Device::flex());
        let rule = |name: &str, _: &[usize]| Ok((name == "leaves.0.bias").then(|| vec![5.0; 2]));
        let after = named_params(&fill_some_params(before, rule).unwrap()).unwrap();
        let values: Vec<f32> = after.iter().map(|(_, tensor)| tensor.data[0]).collect();
        assert_eq!(values, [0.0, 5.0, 0.0, 1.0]);
    }

    #[test]
    fn a_rule_with_too_few_values_is_an_error() {
        let Err(error) = fill_params(tree(&Device::flex()), |_, _| Ok(vec![0.0; 2])) else { panic!("filled") };
        assert!(matches!(error, WeightError::Count { name, found: 2, .. } if name == "leaves.0.weight"));
    }
}
