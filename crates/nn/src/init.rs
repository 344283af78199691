//! Initial parameter values, drawn on the host so that every backend starts from the same numbers.

use burn::module::Param;
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Hands out parameters in construction order, from one seeded stream.
#[derive(Debug)]
pub struct Init {
    rng: ChaCha8Rng,
    device: Device,
}

impl Init {
    /// A stream for one model on one device.
    pub fn new(seed: u64, device: &Device) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), device: device.clone() }
    }

    /// Where the parameters are put.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// U(−bound, bound).
    pub fn uniform<const D: usize>(&mut self, shape: [usize; D], bound: f64) -> Param<Tensor<D>> {
        let count = shape.iter().product();
        let values = (0..count).map(|_| (self.rng.random::<f64>() * 2.0 - 1.0) * bound).map(|v| v as f32).collect();
        self.parameter(values, shape)
    }

    /// N(0, std²).
    pub fn normal<const D: usize>(&mut self, shape: [usize; D], std: f64) -> Param<Tensor<D>> {
        let count = shape.iter().product();
        let mut draw = || -> f64 { StandardNormal.sample(&mut self.rng) };
        let values = (0..count).map(|_| (draw() * std) as f32).collect();
        self.parameter(values, shape)
    }

    /// One value everywhere.
    pub fn constant<const D: usize>(&mut self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.parameter(vec![value; shape.iter().product()], shape)
    }

    /// The identity matrix.
    pub fn diagonal(&mut self, width: usize) -> Param<Tensor<2>> {
        let values = (0..width * width).map(|i| if i % (width + 1) == 0 { 1.0 } else { 0.0 }).collect();
        self.parameter(values, [width, width])
    }

    fn parameter<const D: usize>(&self, values: Vec<f32>, shape: [usize; D]) -> Param<Tensor<D>> {
        Param::from_data(TensorData::new(values, shape), &self.device)
    }
}
