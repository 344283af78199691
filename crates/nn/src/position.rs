//! Fixed position codes: rotary tables and interleaved sine–cosine codes of grids.

use burn::tensor::{Device, Tensor, TensorData};

/// Base of all frequency ladders.
const BASE: f64 = 10_000.0;

/// Rotation angles of rotary attention, one row per head (or one for all heads).
///
/// Channel pairs (2j, 2j+1) turn by `angle[.., j]`.
#[derive(Debug, Clone)]
pub struct RotaryAngles {
    heads: usize,
    tokens: usize,
    pairs: usize,
    angles: Vec<f64>,
}

impl RotaryAngles {
    /// 2-D code of a row-major grid: the first half of the pairs turns with the column index, the second with the row index,
    /// f_j = 10000^(−2j / (head/2)). `head_width` must be divisible by 4.
    pub fn grid_2d(rows: usize, columns: usize, head_width: usize) -> Self {
        assert_eq!(head_width % 4, 0, "a 2-D rotary head needs a width divisible by 4, not {head_width}");
        let per_axis = head_width / 4;
        let mut angles = Vec::with_capacity(rows * columns * per_axis * 2);
        for row in 0..rows {
            for column in 0..columns {
                for index in [column, row] {
                    angles.extend((0..per_axis).map(|j| index as f64 * frequency(j, head_width / 2)));
                }
            }
        }
        Self { heads: 1, tokens: rows * columns, pairs: per_axis * 2, angles }
    }

    /// 3-D code for BEV tokens whose heads are height slices: thirds of the pairs turn with x, y and the **head index** as z.
    /// `head_width` must be divisible by 6.
    pub fn grid_2d_with_heads(heads: usize, rows: usize, columns: usize, head_width: usize) -> Self {
        assert_eq!(head_width % 6, 0, "a 3-D rotary head needs a width divisible by 6, not {head_width}");
        let per_axis = head_width / 6;
        let mut angles = Vec::with_capacity(heads * rows * columns * per_axis * 3);
        for head in 0..heads {
            for row in 0..rows {
                for column in 0..columns {
                    for index in [column, row, head] {
                        angles.extend((0..per_axis).map(|j| index as f64 * frequency(j, head_width / 3)));
                    }
                }
            }
        }
        Self { heads, tokens: rows * columns, pairs: per_axis * 3, angles }
    }

    /// Cosines and sines, each `[1 or heads, N, head_width/2]`.
    pub fn cos_sin(&self, device: &Device) -> (Tensor<3>, Tensor<3>) {
        let shape = [self.heads, self.tokens, self.pairs];
        let table = |f: fn(f64) -> f64| {
            let values: Vec<f32> = self.angles.iter().map(|a| f(*a) as f32).collect();
            Tensor::from_data(TensorData::new(values, shape), device)
        };
        (table(f64::cos), table(f64::sin))
    }
}

fn frequency(j: usize, axis_width: usize) -> f64 {
    BASE.powf(-2.0 * j as f64 / axis_width as f64)
}

/// Interleaved sine–cosine code of a (z, y, x) grid: per axis 2·⌊C/6⌋ channels in the order x, y, z; left-over channels are 0.
///
/// # Shapes
/// - output: `[Z·Y·X, C]`, x fastest
pub fn sincos_3d(cells: [usize; 3], channels: usize, device: &Device) -> Tensor<2> {
    let [nz, ny, nx] = cells;
    let pairs = channels / 6;
    let mut values = vec![0.0_f32; nz * ny * nx * channels];
    for (cell, row) in values.chunks_exact_mut(channels).enumerate() {
        let index = [cell % nx, cell / nx % ny, cell / (nx * ny)];
        for (axis, i) in index.into_iter().enumerate() {
            for j in 0..pairs {
                let angle = i as f64 * frequency(j, 2 * pairs);
                row[(axis * pairs + j) * 2] = angle.sin() as f32;
                row[(axis * pairs + j) * 2 + 1] = angle.cos() as f32;
            }
        }
    }
    Tensor::from_data(TensorData::new(values, [nz * ny * nx, channels]), device)
}
