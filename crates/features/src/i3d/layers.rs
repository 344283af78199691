//! Convolutions, pools and mixed blocks over time and space, with TensorFlow's "SAME" padding.

use burn::tensor::activation::relu;
use burn::tensor::module::max_pool2d;
use burn::tensor::ops::{MaxPoolOptions, PadMode};
use burn::tensor::{Int, Tensor, TensorData};
use nn::weights::WeightError;

use crate::conv::same_padding;
use crate::frozen::{Values, beside};

/// Convolution, batch norm, ReLU.
#[derive(Debug, Clone)]
pub(super) struct Conv3d {
    weight: Tensor<5>,
    bias: Tensor<1>,
    stride: usize,
}

impl Conv3d {
    pub fn read(
        values: &mut Values<'_>,
        name: &str,
        shape: [usize; 5],
        stride: usize,
        epsilon: f64,
    ) -> Result<Self, WeightError> {
        let (weight, bias) = values.folded(&format!("{name}.conv3d"), shape, &format!("{name}.bn"), epsilon)?;
        Ok(Self { weight, bias, stride })
    }

    pub fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        let [_, _, frames, height, width] = x.dims();
        let [_, _, kernel, ..] = self.weight.dims();
        let [time, rows, columns] = [frames, height, width].map(|size| same_padding(size, kernel, self.stride));
        let (weight, bias) = (beside(&self.weight, &x), beside(&self.bias, &x));
        let symmetric = [time, rows, columns].iter().all(|(before, after)| before == after);
        let (x, zeros) = if symmetric {
            (x, [time.0, rows.0, columns.0])
        } else {
            (x.pad([time, rows, columns], PadMode::Constant(0.0)), [0; 3])
        };
        relu(ops::conv3d(x, weight, Some(bias), [self.stride; 3], zeros))
    }
}

/// Max pool of values that are not negative, so that zeros around them change nothing.
#[derive(Debug, Clone)]
pub(super) struct MaxPool3d {
    pub kernel: [usize; 3],
    pub stride: [usize; 3],
}

impl MaxPool3d {
    /// First over space, frame by frame, then over time.
    pub fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        let [count, channels, frames, height, width] = x.dims();
        let [_, kernel_rows, kernel_columns] = self.kernel;
        let [_, stride_rows, stride_columns] = self.stride;
        let padding =
            [same_padding(height, kernel_rows, stride_rows), same_padding(width, kernel_columns, stride_columns)];
        let options = MaxPoolOptions {
            padding,
            ..MaxPoolOptions::new([kernel_rows, kernel_columns]).with_stride([stride_rows, stride_columns])
        };
        let pooled = max_pool2d(x.reshape([count, channels * frames, height, width]), options);
        let [_, _, height, width] = pooled.dims();
        self.over_time(pooled.reshape([count, channels, frames, height, width]))
    }

    fn over_time(&self, x: Tensor<5>) -> Tensor<5> {
        let (kernel, stride, frames) = (self.kernel[0], self.stride[0], x.dims()[2]);
        if kernel == 1 && stride == 1 {
            return x;
        }
        let (before, after) = same_padding(frames, kernel, stride);
        let padded = x.pad([(before, after), (0, 0), (0, 0)], PadMode::Constant(0.0));
        let count = (frames + before + after - kernel) / stride + 1;
        let shifted = (0..kernel).map(|shift| every(&padded, shift, count, stride));
        shifted.reduce(Tensor::max_pair).unwrap_or(padded.clone())
    }
}

/// Frames `start`, `start + step`, … of `[N, C, T, H, W]`.
fn every(x: &Tensor<5>, start: usize, count: usize, step: usize) -> Tensor<5> {
    if step == 1 {
        return x.clone().narrow(2, start, count);
    }
    let frames: Vec<i64> = (0..count).map(|at| (start + at * step) as i64).collect();
    let frames: Tensor<1, Int> = Tensor::from_data(TensorData::new(frames, [count]), &x.device());
    x.clone().select(2, frames)
}

/// Four branches whose outputs stand one after the other.
#[derive(Debug, Clone)]
pub(super) struct Mixed {
    point: Conv3d,
    middle: [Conv3d; 2],
    narrow: [Conv3d; 2],
    pooled: Conv3d,
}

impl Mixed {
    pub fn read(
        values: &mut Values<'_>,
        name: &str,
        channels: usize,
        widths: [usize; 6],
        epsilon: f64,
    ) -> Result<Self, WeightError> {
        let mut conv = |branch: &str, [out, from]: [usize; 2], kernel: usize| {
            Conv3d::read(values, &format!("{name}.{branch}"), [out, from, kernel, kernel, kernel], 1, epsilon)
        };
        let [point, middle_in, middle, narrow_in, narrow, pooled] = widths;
        Ok(Self {
            point: conv("b0", [point, channels], 1)?,
            middle: [conv("b1a", [middle_in, channels], 1)?, conv("b1b", [middle, middle_in], 3)?],
            narrow: [conv("b2a", [narrow_in, channels], 1)?, conv("b2b", [narrow, narrow_in], 3)?],
            pooled: conv("b3b", [pooled, channels], 1)?,
        })
    }

    pub fn forward(&self, x: Tensor<5>) -> Tensor<5> {
        let chain = |[first, second]: &[Conv3d; 2]| second.forward(first.forward(x.clone()));
        let pool = MaxPool3d { kernel: [3; 3], stride: [1; 3] };
        let branches = vec![
            self.point.forward(x.clone()),
            chain(&self.middle),
            chain(&self.narrow),
            self.pooled.forward(pool.forward(x.clone())),
        ];
        Tensor::cat(branches, 1)
    }
}
