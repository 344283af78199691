//! Normalisation layers over `ops`.

use burn::module::{Module, Param};
use burn::tensor::Tensor;

use crate::Init;

/// Layer norm over the last axis with a gain and, where asked for, a bias.
#[derive(Module, Debug)]
pub struct LayerNorm {
    /// `[width]`
    pub weight: Param<Tensor<1>>,
    /// `[width]`
    pub bias: Option<Param<Tensor<1>>>,
    epsilon: f32,
}

impl LayerNorm {
    /// Gains 1, no bias.
    pub fn new(width: usize, epsilon: f32, init: &mut Init) -> Self {
        Self { weight: init.constant([width], 1.0), bias: None, epsilon }
    }

    /// Gains 1, biases 0.
    pub fn with_bias(width: usize, epsilon: f32, init: &mut Init) -> Self {
        Self { bias: Some(init.constant([width], 0.0)), ..Self::new(width, epsilon, init) }
    }

    /// Shape unchanged.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        ops::layer_norm(x, Some(self.weight.val()), self.bias.as_ref().map(Param::val), self.epsilon)
    }
}

/// Gains of a root-mean-square norm; [`ops::rotary_attention`] applies them.
#[derive(Module, Debug)]
pub struct RmsNorm {
    /// `[width]`
    pub weight: Param<Tensor<1>>,
}

impl RmsNorm {
    /// Gains 1.
    pub fn new(width: usize, init: &mut Init) -> Self {
        Self { weight: init.constant([width], 1.0) }
    }
}

/// Group norm of `[B, C, ..]` with gain and bias per channel.
#[derive(Module, Debug)]
pub struct GroupNorm {
    /// `[C]`
    pub weight: Param<Tensor<1>>,
    /// `[C]`
    pub bias: Param<Tensor<1>>,
    groups: usize,
    epsilon: f32,
}

impl GroupNorm {
    /// Gains 1, biases 0. `groups` must divide `channels`; configs check it before they come here.
    pub fn new(channels: usize, groups: usize, epsilon: f32, init: &mut Init) -> Self {
        assert_eq!(channels % groups, 0, "{groups} groups must divide {channels} channels");
        Self { weight: init.constant([channels], 1.0), bias: init.constant([channels], 0.0), groups, epsilon }
    }

    /// Group norm followed by SiLU, the pair every feature pyramid uses. Shape unchanged.
    pub fn forward_silu<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        ops::group_norm_silu(x, self.groups, self.weight.val(), self.bias.val(), self.epsilon)
    }

    /// Shape unchanged.
    pub fn forward<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        ops::group_norm(x, self.groups, self.weight.val(), self.bias.val(), self.epsilon)
    }
}
