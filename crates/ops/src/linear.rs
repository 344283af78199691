//! Affine maps over the last axis.

use std::borrow::Cow;

use burn::tensor::Tensor;
use rayon::prelude::*;

use crate::fused::{Blank, Kernel, fused_2, fused_3, on_flex, vectorized, written};
use crate::product::{Matrix, MatrixMut, Old, Threads, product, product_into, product_on};

/// `y = x Wᵀ + b` over the last axis.
///
/// # Shapes
/// - x: `[.., in]`
/// - weight: `[out, in]`
/// - bias: `[out]`; absent means 0
/// - output: `[.., out]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn linear<const R: usize>(x: Tensor<R>, weight: Tensor<2>, bias: Option<Tensor<1>>) -> Tensor<R> {
    let mut dims = x.dims();
    let [d_out, d_in] = weight.dims();
    assert_eq!(dims[R - 1], d_in, "last axis of {dims:?} must be {d_in}");
    if let Some(bias) = &bias {
        assert_eq!(bias.dims(), [d_out], "one bias per output");
    }
    dims[R - 1] = d_out;
    let rows = dims[..R - 1].iter().product::<usize>();
    if on_flex(&x) {
        let kernel = Linear { output: dims.to_vec(), rows, d_in, d_out };
        return match bias {
            Some(bias) => fused_3(kernel, x, weight, bias),
            None => fused_2(kernel, x, weight),
        };
    }
    let y = x.reshape([rows, d_in]).matmul(weight.transpose());
    let y = match bias {
        Some(bias) => y + bias.unsqueeze::<2>(),
        None => y,
    };
    y.reshape(dims)
}

/// Inputs: x, weight, then bias where there is one.
#[derive(Debug)]
struct Linear {
    output: Vec<usize>,
    rows: usize,
    d_in: usize,
    d_out: usize,
}

/// Weights with at most this many numbers are cheap to read again: work is shared by rows then, not inside the product.
const SMALL: usize = 1 << 14;
/// Rows of a task where work is shared by rows. Fixed, because gradients of weights are summed per task.
const TASK_ROWS: usize = 512;

/// `a · b` plus a bias per column.
fn affine(a: Matrix<'_>, b: Matrix<'_>, bias: Option<&[f32]>) -> Vec<f32> {
    let (rows, columns) = (a.rows, b.columns);
    let add = |y: &mut [f32]| {
        if let Some(bias) = bias {
            add_to_rows(y, bias);
        }
    };
    if b.rows * columns <= SMALL {
        return written(rows * columns, TASK_ROWS * columns, |i, y| {
            let count = y.len() / columns;
            let y = product_into(Threads::One, y, a.rows_at(i * TASK_ROWS, count), b);
            add(y);
            y
        });
    }
    let mut y = written(rows * columns, rows * columns, |_, y: &mut Blank| product_into(Threads::Shared, y, a, b));
    if bias.is_some() {
        y.par_chunks_mut((TASK_ROWS * columns).max(1)).for_each(add);
    }
    y
}

vectorized! {
    fn add_to_rows[](y: &mut [f32], bias: &[f32]) {
        for y in y.chunks_exact_mut(bias.len()) {
            for (y, &bias) in y.iter_mut().zip(bias) {
                *y += bias;
            }
        }
    }
}

impl Linear {
    /// Gradient of the weight, `upstreamᵀ · x`.
    fn weight_gradient(&self, x: Matrix<'_>, upstream: Matrix<'_>) -> Vec<f32> {
        let length = self.d_out * self.d_in;
        let mut total = vec![0.0; length];
        if length > SMALL || self.rows <= TASK_ROWS {
            let out = MatrixMut::row_major(&mut total, self.d_out, self.d_in);
            product(out, upstream.transposed(), x, 1.0, Old::Replaced);
            return total;
        }
        let tasks = (0..self.rows.div_ceil(TASK_ROWS)).into_par_iter().map(|task| {
            let first = task * TASK_ROWS;
            let count = TASK_ROWS.min(self.rows - first);
            let (upstream, x) = (upstream.rows_at(first, count), x.rows_at(first, count));
            let mut part = vec![0.0; length];
            let out = MatrixMut::row_major(&mut part, self.d_out, self.d_in);
            product_on(Threads::One, out, upstream.transposed(), x, 1.0, Old::Replaced);
            part
        });
        let parts: Vec<Vec<f32>> = tasks.collect();
        for part in parts {
            total.iter_mut().zip(part).for_each(|(total, part)| *total += part);
        }
        total
    }
}

impl<const N: usize> Kernel<N> for Linear {
    fn output_shape(&self) -> Vec<usize> {
        self.output.clone()
    }

    fn forward(&self, inputs: [&[f32]; N]) -> Vec<f32> {
        let x = Matrix::row_major(inputs[0], self.rows, self.d_in);
        let weight = Matrix::row_major(inputs[1], self.d_out, self.d_in);
        affine(x, weight.transposed(), inputs.get(2).copied())
    }

    fn backward(&self, inputs: [&[f32]; N], upstream: Cow<'_, [f32]>, wanted: [bool; N]) -> [Option<Vec<f32>>; N] {
        let x = Matrix::row_major(inputs[0], self.rows, self.d_in);
        let weight = Matrix::row_major(inputs[1], self.d_out, self.d_in);
        let gradient = Matrix::row_major(&upstream, self.rows, self.d_out);
        let mut gradients = [const { None }; N];
        gradients[0] = wanted[0].then(|| affine(gradient, weight, None));
        gradients[1] = wanted[1].then(|| self.weight_gradient(x, gradient));
        if let (Some(bias), Some(true)) = (gradients.get_mut(2), wanted.get(2)) {
            *bias = Some(column_sums(&upstream, self.d_out));
        }
        gradients
    }
}

/// Rows summed one after another. Fixed, so that the order of additions does not depend on the number of threads.
const ROWS: usize = 256;

/// Sum over the rows of a row-major matrix with `columns` columns.
pub(crate) fn column_sums(values: &[f32], columns: usize) -> Vec<f32> {
    if columns == 0 {
        return Vec::new();
    }
    let add = |total: &mut [f32], row: &[f32]| total.iter_mut().zip(row).for_each(|(total, value)| *total += value);
    let parts: Vec<Vec<f32>> = values
        .par_chunks(ROWS * columns)
        .map(|rows| {
            let mut total = vec![0.0; columns];
            rows.chunks_exact(columns).for_each(|row| add(&mut total, row));
            total
        })
        .collect();
    let mut total = vec![0.0; columns];
    parts.iter().for_each(|part| add(&mut total, part));
    total
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Int, Tensor};

    use super::*;
    use crate::composed_only;

    fn wave<const R: usize>(shape: [usize; R], phase: f32, device: &Device) -> Tensor<R> {
        let count = shape.iter().product::<usize>() as i64;
        if count == 0 {
            return Tensor::zeros(shape, device);
        }
        (Tensor::<1, Int>::arange(0..count, device).float() * 0.37 + phase).sin().reshape(shape)
    }

    #[test]
    fn kernel_equals_the_composition() {
        let device = Device::flex().autodiff();
        for (rows, d_in, d_out) in [(1, 1, 1), (0, 3, 2), (7, 5, 3), (600, 24, 81), (300, 200, 310)] {
            let x = wave([2, rows, d_in], 0.0, &device).require_grad();
            let weight = wave([d_out, d_in], 1.0, &device).require_grad();
            let bias = wave([d_out], 2.0, &device).require_grad();
            for with_bias in [false, true] {
                let run = || {
                    // A transposed view: kernels get contiguous copies.
                    let turned = x.clone().swap_dims(0, 1);
                    let y = linear(turned, weight.clone(), with_bias.then(|| bias.clone()));
                    let upstream = wave(y.dims(), 0.5, &device);
                    let gradients = (y.clone() * upstream).sum().backward();
                    let mut all = vec![y.into_data()];
                    all.push(x.grad(&gradients).unwrap().into_data());
                    all.push(weight.grad(&gradients).unwrap().into_data());
                    all.extend(with_bias.then(|| bias.grad(&gradients).unwrap().into_data()));
                    all
                };
                for (fused, composed) in run().into_iter().zip(composed_only(run)) {
                    let values = |data: burn::tensor::TensorData| data.try_to_vec::<f32>().unwrap();
                    for (a, b) in values(fused).into_iter().zip(values(composed)) {
                        assert!((a - b).abs() <= 2e-5 * (1.0 + b.abs()), "{rows}x{d_in}x{d_out}: {a} {b}");
                    }
                }
            }
        }
    }
}
