//! Golden folders, golden weights, and gradients by name.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use burn::module::{Module, ModuleVisitor, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use nn::golden::{golden_stream, golden_values};
use nn::weights::HostTensor;
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;
use stable_diffusion::layout::{fill_by_state_dict_name, state_dict_name};

/// f32 against f32 with another order of sums; the golden run itself lies 4e-6 from its f64 twin.
pub const TOLERANCE: f64 = 1e-4;

/// The same for gradients.
pub const GRADIENT_TOLERANCE: f64 = 5e-4;

/// The golden folder of this name, if goldens are there at all. With `RIGSCAPE_GOLDEN` set, a missing folder is a failure.
pub fn folder(name: &str) -> Option<PathBuf> {
    let inside = Path::new("stable_diffusion").join(name);
    if let Some(root) = std::env::var_os("RIGSCAPE_GOLDEN") {
        return Some(PathBuf::from(root).join(inside));
    }
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(inside);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("did not run: no golden folder {name}; set RIGSCAPE_GOLDEN");
    None
}

pub fn json(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// The tensors of one golden file.
pub struct Golden(HashMap<String, HostTensor>);

impl Golden {
    pub fn open(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        let file = SafeTensors::deserialize(&bytes).unwrap();
        let decode = |(name, view): (&str, safetensors::tensor::TensorView)| {
            (name.to_owned(), HostTensor::new(view.shape(), values(view.dtype(), view.data())))
        };
        Self(file.iter().map(decode).collect())
    }

    pub fn host(&self, name: &str) -> &HostTensor {
        self.0.get(name).unwrap_or_else(|| panic!("golden tensor {name} is missing"))
    }

    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let host = self.host(name);
        let shape: [usize; D] = host.shape.clone().try_into().unwrap_or_else(|s| panic!("{name} has shape {s:?}"));
        Tensor::from_data(TensorData::new(host.data.clone(), shape), device)
    }

    pub fn timesteps(&self) -> Vec<f64> {
        self.host("timesteps").data.iter().map(|t| f64::from(*t)).collect()
    }

    /// Names that begin so, sorted, without the beginning.
    pub fn names(&self, prefix: &str) -> Vec<String> {
        let mut names: Vec<_> = self.0.keys().filter_map(|name| name.strip_prefix(prefix)).map(str::to_owned).collect();
        names.sort();
        names
    }

    /// Compares shapes and values; returns the largest difference over max(1, largest value).
    pub fn check<const D: usize>(&self, name: &str, got: Tensor<D>, tolerance: f64) -> f64 {
        let want = self.host(name);
        assert_eq!(got.dims().as_slice(), want.shape, "{name}: shape");
        compare(name, &values_of(got), &want.data, tolerance)
    }
}

/// Largest difference over max(1, largest wanted value).
pub fn compare(name: &str, got: &[f32], want: &[f32], tolerance: f64) -> f64 {
    assert_eq!(got.len(), want.len(), "{name}: element count");
    assert!(!want.is_empty(), "{name}: nothing to compare with");
    let scale = want.iter().fold(1.0, |scale: f64, v| scale.max(f64::from(v.abs())));
    let off = got
        .iter()
        .zip(want)
        .map(|(a, b)| f64::from(a - b).abs())
        .fold(0.0, |a: f64, b| if b > a || b.is_nan() { b } else { a });
    let worst = off / scale;
    assert!(worst <= tolerance, "{name}: off by {worst:e}, tolerance {tolerance:e}");
    worst
}

pub fn values_of<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().iter::<f32>().collect()
}

fn values(dtype: Dtype, bytes: &[u8]) -> Vec<f32> {
    match dtype {
        Dtype::F32 => bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect(),
        Dtype::F64 => bytes.chunks_exact(8).map(|b| f64::from_le_bytes(b.try_into().unwrap()) as f32).collect(),
        Dtype::I64 => bytes.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as f32).collect(),
        Dtype::U8 => bytes.iter().map(|b| f32::from(*b)).collect(),
        other => panic!("unexpected element type {other:?}"),
    }
}

/// The module with golden weights under its state-dict names.
pub fn golden_weights<M: Module>(module: M) -> M {
    fill_by_state_dict_name(module, |name, shape| Ok(Some(golden_values(name, shape)))).unwrap()
}

/// Uniform noise in [−1, 1) that depends on its name alone.
pub fn noise<const D: usize>(name: &str, shape: [usize; D], device: &Device) -> Tensor<D> {
    let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// All gradients of a module by state-dict name.
pub fn named_gradients<M: Module>(module: &M, gradients: &GradientsParams) -> BTreeMap<String, Vec<f32>> {
    struct Visitor<'a> {
        gradients: &'a GradientsParams,
        found: BTreeMap<String, Vec<f32>>,
        path: Vec<String>,
    }
    impl ModuleVisitor for Visitor<'_> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.to_owned());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
            if let Some(gradient) = self.gradients.get::<D>(param.id) {
                self.found.insert(state_dict_name(&self.path.join(".")), values_of(gradient));
            }
        }
    }
    let mut visitor = Visitor { gradients, found: BTreeMap::new(), path: Vec::new() };
    module.visit(&mut visitor);
    visitor.found
}

/// Compares every stored `prefix + name` with the gradient of that parameter; returns the worst.
pub fn check_gradients(golden: &Golden, prefix: &str, ours: &BTreeMap<String, Vec<f32>>) -> f64 {
    let names = golden.names(prefix);
    assert!(!names.is_empty(), "no gradients under {prefix}");
    let check = |name: &String| {
        let got = ours.get(name).unwrap_or_else(|| panic!("no gradient for {name}"));
        compare(name, got, &golden.host(&format!("{prefix}{name}")).data, GRADIENT_TOLERANCE)
    };
    names.iter().map(check).fold(0.0, f64::max)
}

/// Compares the directional derivative of `loss` along a fixed direction in all parameters with central differences.
pub fn check_derivative<M: Module>(module: &M, loss: impl Fn(&M) -> Tensor<1>) {
    let gradients = GradientsParams::from_grads(loss(module).backward(), module);
    let gradients = named_gradients(module, &gradients);
    let direction = |name: &str, count: usize| golden_stream(&format!("direction of {name}"), count);
    let along = |(name, gradient): (&String, &Vec<f32>)| {
        gradient.iter().zip(direction(name, gradient.len())).map(|(g, d)| f64::from(*g) * d).sum::<f64>()
    };
    let expected: f64 = gradients.iter().map(along).sum();
    let own: HashMap<_, _> = stable_diffusion::layout::state_dict_params(module).unwrap().into_iter().collect();
    assert_eq!(own.len(), gradients.len(), "parameters without a gradient");
    let at = |step: f64| {
        let moved = fill_by_state_dict_name(module.clone(), |name, _| {
            let data = &own[name].data;
            let pairs = data.iter().zip(direction(name, data.len()));
            Ok(Some(pairs.map(|(v, d)| (f64::from(*v) + step * d) as f32).collect()))
        });
        f64::from(values_of(loss(&moved.unwrap()))[0])
    };
    // Fourth order: rounding asks for large steps, thousands of parameters moving at once for small ones.
    let step = 4e-4;
    let slope = (8.0 * (at(step) - at(-step)) - (at(2.0 * step) - at(-2.0 * step))) / (12.0 * step);
    assert!(expected.abs() > 1e-2, "a derivative of {expected} tests nothing");
    assert!((slope - expected).abs() <= 1e-2 * expected.abs(), "derivative {expected}, differences {slope}");
}
