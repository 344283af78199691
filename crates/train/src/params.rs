//! Parameters of any burn module by path, such as `image_encoder.blocks.0.attn.qkv.weight`.
//!
//! Optimizer, moving average and checkpoint need to treat tensors of every rank alike, so a parameter travels as its
//! shape and its values in row-major order, without autodiff. Only float parameters are seen: integer and boolean
//! tensors of a module are constants that its `init` makes.

use std::collections::BTreeMap;

use burn::module::{Module, ModuleMapper, ModuleVisitor, Param, ParamId};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};

/// Name, shape and identity of one parameter.
#[derive(Clone, Debug, PartialEq)]
pub struct ParamInfo {
    /// Field names and list positions from the module's root, joined by dots.
    pub path: String,
    /// Extent of every axis.
    pub shape: Vec<usize>,
    /// burn's key, under which gradients are stored.
    pub id: ParamId,
}

impl ParamInfo {
    /// The last part of the path, such as `weight`.
    pub fn leaf(&self) -> &str {
        self.path.rsplit('.').next().unwrap_or(&self.path)
    }

    /// Number of values.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether an axis has extent zero.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }
}

/// A tensor of any rank: its shape and its values in row-major order.
#[derive(Clone, Debug)]
pub struct NamedTensor {
    /// Extent of every axis.
    pub shape: Vec<usize>,
    /// All values, `[product of shape]`, without autodiff.
    pub values: Tensor<1>,
}

/// Tensors by parameter path, in alphabetical order.
pub type NamedTensors = BTreeMap<String, NamedTensor>;

/// Every float parameter, in the module's own order. Reads no values.
pub fn list_parameters<M: Module>(module: &M) -> Vec<ParamInfo> {
    let mut all = Vec::new();
    visit(module, |info, _| all.push(info.clone()));
    all
}

/// Number of values in all float parameters. Reads no values.
pub fn count_parameters<M: Module>(module: &M) -> usize {
    list_parameters(module).iter().map(ParamInfo::len).sum()
}

/// Every float parameter with its values on the module's device.
pub fn named_parameters<M: Module>(module: &M) -> NamedTensors {
    let mut all = NamedTensors::new();
    visit(module, |info, values| {
        all.insert(info.path.clone(), NamedTensor { shape: info.shape.clone(), values: values() });
    });
    all
}

/// Replaces every float parameter by `change(info, values)`; values are `[product of shape]` without autodiff. Autodiff
/// and `require_grad` stay as they were.
pub fn map_parameters<M: Module>(module: M, mut change: impl FnMut(&ParamInfo, Tensor<1>) -> Tensor<1>) -> M {
    module.map(&mut Mapper {
        path: Vec::new(),
        change: |info: &ParamInfo, values, _| Some(change(info, values)),
        grads: None,
    })
}

/// The device of the first parameter without autodiff, `None` for a module without parameters.
pub(crate) fn inner_device<M: Module>(module: &M) -> Option<Device> {
    module.devices().into_iter().next().map(Device::inner)
}

/// Replaces every parameter that has a gradient by `change(info, values, gradient)`; the gradients are used up.
pub(crate) fn map_with_gradients<M: Module>(
    module: M,
    grads: &mut GradientsParams,
    mut change: impl FnMut(&ParamInfo, Tensor<1>, Tensor<1>) -> Tensor<1>,
) -> M {
    let change = |info: &ParamInfo, values, grad: Option<Tensor<1>>| grad.map(|grad| change(info, values, grad));
    module.map(&mut Mapper { path: Vec::new(), change, grads: Some(grads) })
}

/// Calls `look(info, gradient)` for every parameter that has a gradient.
pub(crate) fn visit_gradients<M: Module>(module: &M, grads: &GradientsParams, look: impl FnMut(&ParamInfo, Tensor<1>)) {
    module.visit(&mut GradientVisitor { path: Vec::new(), grads, look });
}

/// Replaces every gradient by `change(gradient)`.
pub(crate) fn map_gradients<M: Module>(
    module: &M,
    grads: &mut GradientsParams,
    change: impl FnMut(Tensor<1>) -> Tensor<1>,
) {
    module.visit(&mut GradientMapper { grads, change });
}

/// Calls `look(info, values)` for every float parameter; values are fetched only when the closure is called.
fn visit<M: Module>(module: &M, look: impl FnMut(&ParamInfo, &dyn Fn() -> Tensor<1>)) {
    module.visit(&mut Visitor { path: Vec::new(), look });
}

fn info_of<const D: usize>(path: &[String], param: &Param<Tensor<D>>) -> ParamInfo {
    ParamInfo { path: path.join("."), shape: param.lazy_shape().as_slice().to_vec(), id: param.id }
}

fn flat<const D: usize>(tensor: Tensor<D>) -> Tensor<1> {
    let len = tensor.shape().num_elements();
    tensor.inner().reshape([len])
}

struct Visitor<F> {
    path: Vec<String>,
    look: F,
}

impl<F: FnMut(&ParamInfo, &dyn Fn() -> Tensor<1>)> ModuleVisitor for Visitor<F> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        (self.look)(&info_of(&self.path, param), &|| flat(param.base()));
    }
}

struct Mapper<'a, F> {
    path: Vec<String>,
    change: F,
    grads: Option<&'a mut GradientsParams>,
}

impl<F: FnMut(&ParamInfo, Tensor<1>, Option<Tensor<1>>) -> Option<Tensor<1>>> ModuleMapper for Mapper<'_, F> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let info = info_of(&self.path, &param);
        let grad = self.grads.as_mut().and_then(|grads| grads.remove::<D>(param.id)).map(flat);
        param.map(|tensor| {
            let shape = tensor.shape();
            // `from_inner` would come back with the default tape settings; a parameter whose checkpointing strategy
            // differs from its inputs' is refused in the next forward pass.
            let (on_tape, strategy) = (tensor.is_autodiff(), tensor.gradient_checkpointing_strategy());
            let require_grad = tensor.is_require_grad();
            let Some(changed) = (self.change)(&info, flat(tensor.clone()), grad) else { return tensor };
            let mut changed = changed.reshape(shape);
            if on_tape {
                changed = Tensor::from_inner(changed);
                if let Some(strategy) = strategy {
                    changed = changed.with_gradient_checkpointing_strategy(strategy);
                }
            }
            changed.set_require_grad(require_grad)
        })
    }
}

struct GradientVisitor<'a, F> {
    path: Vec<String>,
    grads: &'a GradientsParams,
    look: F,
}

impl<F: FnMut(&ParamInfo, Tensor<1>)> ModuleVisitor for GradientVisitor<'_, F> {
    fn enter_module(&mut self, name: &str, _container_type: &str) {
        self.path.push(name.to_string());
    }

    fn exit_module(&mut self, _name: &str, _container_type: &str) {
        self.path.pop();
    }

    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(grad) = self.grads.get::<D>(param.id) {
            (self.look)(&info_of(&self.path, param), flat(grad));
        }
    }
}

struct GradientMapper<'a, F> {
    grads: &'a mut GradientsParams,
    change: F,
}

impl<F: FnMut(Tensor<1>) -> Tensor<1>> ModuleVisitor for GradientMapper<'_, F> {
    fn visit_float<const D: usize>(&mut self, param: &Param<Tensor<D>>) {
        if let Some(grad) = self.grads.remove::<D>(param.id) {
            let shape = grad.shape();
            let changed: Tensor<D> = (self.change)(flat(grad)).reshape(shape);
            self.grads.register(param.id, changed);
        }
    }
}
