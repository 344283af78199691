//! Convolutions with constant kernels.

use burn::tensor::Tensor;
use burn::tensor::module::conv2d;
use burn::tensor::ops::ConvOptions;
use nn::weights::WeightError;

use crate::frozen::{Values, beside};

/// What stands around an image before a convolution.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Padding {
    /// Rows and columns of zeros on both sides.
    Zeros([usize; 2]),
    /// TensorFlow's "SAME": as many as give ⌈size / stride⌉ outputs, the odd one at the bottom and right.
    Same,
}

/// Kernel, bias and geometry of a convolution.
#[derive(Debug, Clone)]
pub(crate) struct Conv2d {
    weight: Tensor<4>,
    bias: Option<Tensor<1>>,
    stride: usize,
    padding: Padding,
    groups: usize,
}

/// Zeros before and after an axis for TensorFlow's "SAME" padding.
pub(crate) fn same_padding(size: usize, kernel: usize, stride: usize) -> (usize, usize) {
    let rest = size % stride;
    let total = kernel.saturating_sub(if rest == 0 { stride } else { rest });
    (total / 2, total - total / 2)
}

impl Conv2d {
    /// `{name}.weight` and `{name}.bias`.
    pub fn with_bias(
        values: &mut Values<'_>,
        name: &str,
        shape: [usize; 4],
        stride: usize,
        padding: Padding,
    ) -> Result<Self, WeightError> {
        let weight = values.tensor(&format!("{name}.weight"), shape)?;
        let bias = Some(values.tensor(&format!("{name}.bias"), [shape[0]])?);
        Ok(Self { weight, bias, stride, padding, groups: 1 })
    }

    /// `{name}.weight` alone.
    pub fn plain(
        values: &mut Values<'_>,
        name: &str,
        shape: [usize; 4],
        stride: usize,
        padding: Padding,
    ) -> Result<Self, WeightError> {
        let weight = values.tensor(&format!("{name}.weight"), shape)?;
        Ok(Self { weight, bias: None, stride, padding, groups: 1 })
    }

    /// A kernel and the batch norm behind it.
    pub fn folded((weight, bias): (Tensor<4>, Tensor<1>), stride: usize, padding: Padding) -> Self {
        Self { weight, bias: Some(bias), stride, padding, groups: 1 }
    }

    /// The same, every channel on its own.
    pub fn depthwise(self) -> Self {
        Self { groups: self.weight.dims()[0], ..self }
    }

    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let [_, _, height, width] = x.dims();
        let [_, _, kernel_height, kernel_width] = self.weight.dims();
        let padding = match self.padding {
            Padding::Zeros(zeros) => zeros.map(|zeros| (zeros, zeros)),
            Padding::Same => {
                [same_padding(height, kernel_height, self.stride), same_padding(width, kernel_width, self.stride)]
            }
        };
        let bias = self.bias.as_ref().map(|bias| beside(bias, &x));
        let weight = beside(&self.weight, &x);
        let [(top, bottom), (left, right)] = padding;
        if self.groups == 1 && top == bottom && left == right {
            return ops::conv2d(x, weight, bias, [self.stride; 2], [top, left]);
        }
        let options = ConvOptions { padding, ..ConvOptions::new([self.stride; 2], [0; 2], [1; 2], self.groups) };
        conv2d(x, weight, bias, options)
    }
}
