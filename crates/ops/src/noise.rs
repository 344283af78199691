//! Values for tests: random in kind, the same in every run. Each test has its own thread and so its own stream.

use std::cell::Cell;

use burn::tensor::{Device, Tensor, TensorData};

thread_local! {
    static DRAWN: Cell<u64> = const { Cell::new(0) };
}

/// A number in [0, 1).
fn draw() -> f64 {
    let index = DRAWN.get() + 1;
    DRAWN.set(index);
    let mut z = index.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

fn tensor<const D: usize>(shape: [usize; D], device: &Device, value: impl Fn() -> f64) -> Tensor<D> {
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| value() as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// N(mean, std²).
pub fn normal<const D: usize>(shape: [usize; D], mean: f64, std: f64, device: &Device) -> Tensor<D> {
    tensor(shape, device, || {
        let radius = (-2.0 * (1.0 - draw()).ln()).sqrt();
        mean + std * radius * (std::f64::consts::TAU * draw()).cos()
    })
}

/// U(from, to).
pub fn uniform<const D: usize>(shape: [usize; D], from: f64, to: f64, device: &Device) -> Tensor<D> {
    tensor(shape, device, || from + (to - from) * draw())
}
