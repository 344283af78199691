//! The coarse transformer: linear attention within and between the two images.

use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use nn::weights::WeightError;

use super::WIDTH;
use crate::frozen::{Values, beside};

const HEADS: usize = 8;
const HEAD_WIDTH: usize = WIDTH / HEADS;

/// Self and cross by turns, four of each.
const LAYERS: usize = 8;

/// Of the layer norms.
const NORM_EPSILON: f32 = 1e-5;

/// Of the attention's denominator.
const ATTENTION_EPSILON: f64 = 1e-6;

/// Channels by fours: sin and cos of the column, sin and cos of the row, both counted from 1, at the angular frequency e^(−2k).
///
/// The published outdoor weights were trained with this formula; the intended 10000^(−2k/128) does not fit them.
///
/// # Shapes
/// - output: `[1, 256, rows, columns]`
pub(super) fn position_code(rows: usize, columns: usize, device: &Device) -> Tensor<4> {
    let mut values = Vec::with_capacity(WIDTH * rows * columns);
    for channel in 0..WIDTH {
        let frequency = (-2.0 * (channel / 4) as f64).exp();
        for row in 0..rows {
            for column in 0..columns {
                let place = if channel % 4 < 2 { column } else { row };
                let angle = (place + 1) as f64 * frequency;
                values.push(if channel % 2 == 0 { angle.sin() } else { angle.cos() } as f32);
            }
        }
    }
    Tensor::from_data(TensorData::new(values, [1, WIDTH, rows, columns]), device)
}

#[derive(Debug, Clone)]
pub(super) struct CoarseTransformer(Vec<Layer>);

impl CoarseTransformer {
    pub fn read(values: &mut Values<'_>) -> Result<Self, WeightError> {
        let layers = (0..LAYERS).map(|at| Layer::read(values, &format!("loftr_coarse.layers.{at}")));
        Ok(Self(layers.collect::<Result<_, _>>()?))
    }

    /// # Shapes
    /// - first: `[N, L, 256]`, second: `[N, S, 256]`; the same out
    pub fn forward(&self, mut first: Tensor<3>, mut second: Tensor<3>) -> (Tensor<3>, Tensor<3>) {
        for (at, layer) in self.0.iter().enumerate() {
            if at % 2 == 0 {
                first = layer.forward(first.clone(), first);
                second = layer.forward(second.clone(), second);
            } else {
                first = layer.forward(first, second.clone());
                second = layer.forward(second, first.clone());
            }
        }
        (first, second)
    }
}

/// Gain and offset of a layer norm.
#[derive(Debug, Clone)]
struct Norm(Tensor<1>, Tensor<1>);

impl Norm {
    fn read(values: &mut Values<'_>, name: &str) -> Result<Self, WeightError> {
        Ok(Self(values.tensor(&format!("{name}.weight"), [WIDTH])?, values.tensor(&format!("{name}.bias"), [WIDTH])?))
    }

    fn forward(&self, x: Tensor<3>) -> Tensor<3> {
        let (gain, offset) = (beside(&self.0, &x), beside(&self.1, &x));
        ops::layer_norm(x, Some(gain), Some(offset), NORM_EPSILON)
    }
}

/// One encoder layer; matrices are `[out, in]`.
#[derive(Debug, Clone)]
struct Layer {
    query: Tensor<2>,
    key: Tensor<2>,
    value: Tensor<2>,
    merge: Tensor<2>,
    mlp: [Tensor<2>; 2],
    norms: [Norm; 2],
}

impl Layer {
    fn read(values: &mut Values<'_>, name: &str) -> Result<Self, WeightError> {
        let mut matrix = |part: &str, shape: [usize; 2]| values.tensor(&format!("{name}.{part}.weight"), shape);
        Ok(Self {
            query: matrix("q_proj", [WIDTH; 2])?,
            key: matrix("k_proj", [WIDTH; 2])?,
            value: matrix("v_proj", [WIDTH; 2])?,
            merge: matrix("merge", [WIDTH; 2])?,
            mlp: [matrix("mlp.0", [2 * WIDTH; 2])?, matrix("mlp.2", [WIDTH, 2 * WIDTH])?],
            norms: [Norm::read(values, &format!("{name}.norm1"))?, Norm::read(values, &format!("{name}.norm2"))?],
        })
    }

    /// What `x` learns from `source`, added to it.
    fn forward(&self, x: Tensor<3>, source: Tensor<3>) -> Tensor<3> {
        let query = heads(linear(x.clone(), &self.query));
        let (key, value) = (heads(linear(source.clone(), &self.key)), heads(linear(source, &self.value)));
        let message = linear(joined(linear_attention(query, key, value)), &self.merge);
        let both = Tensor::cat(vec![x.clone(), self.norms[0].forward(message)], 2);
        let message = linear(relu(linear(both, &self.mlp[0])), &self.mlp[1]);
        x + self.norms[1].forward(message)
    }
}

fn linear(x: Tensor<3>, matrix: &Tensor<2>) -> Tensor<3> {
    let [images, cells, width] = x.dims();
    let matrix = beside(matrix, &x).transpose();
    let [_, out] = matrix.dims();
    x.reshape([images * cells, width]).matmul(matrix).reshape([images, cells, out])
}

/// `[N, L, 256]` as `[N, 8, L, 32]`.
fn heads(x: Tensor<3>) -> Tensor<4> {
    let [images, cells, _] = x.dims();
    x.reshape([images, cells, HEADS, HEAD_WIDTH]).swap_dims(1, 2)
}

fn joined(x: Tensor<4>) -> Tensor<3> {
    let [images, _, cells, _] = x.dims();
    x.swap_dims(1, 2).reshape([images, cells, WIDTH])
}

/// φ(q)·(Σ φ(k)ᵀ v) / (φ(q)·Σ φ(k) + ε) with φ = elu + 1.
///
/// # Shapes
/// - query: `[N, 8, L, 32]`; key, value: `[N, 8, S, 32]`
/// - output: `[N, 8, L, 32]`
fn linear_attention(query: Tensor<4>, key: Tensor<4>, value: Tensor<4>) -> Tensor<4> {
    let (query, key) = (positive(query), positive(key));
    let cells = key.dims()[2] as f64;
    let summed = key.clone().swap_dims(2, 3).matmul(value / cells);
    let total = ops::sum_dim(key, 2).swap_dims(2, 3);
    let weight = query.clone().matmul(total) + ATTENTION_EPSILON;
    query.matmul(summed) / weight * cells
}

/// elu + 1: x + 1 above zero, eˣ below.
fn positive(x: Tensor<4>) -> Tensor<4> {
    relu(x.clone()) + x.clamp_max(0.0).exp()
}
