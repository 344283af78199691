//! Initial parameter values, drawn on the host so that every backend starts from the same numbers.

use burn::module::{Param, ParamId};
use burn::tensor::{Device, Tensor, TensorData};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// Hands out parameters in construction order, from one seeded stream.
#[derive(Debug)]
pub struct Init {
    rng: ChaCha8Rng,
    device: Device,
    when: When,
}

/// When a parameter's values are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum When {
    Now,
    OnFirstUse,
}

impl Init {
    /// A stream for one model on one device.
    pub fn new(seed: u64, device: &Device) -> Self {
        Self { rng: ChaCha8Rng::seed_from_u64(seed), device: device.clone(), when: When::Now }
    }

    /// As [`Init::new`], but a parameter takes memory only when it is first used: for models that a file is about to fill,
    /// and for counting. Values are distributed as with `new`, but are other ones.
    pub fn lazy(seed: u64, device: &Device) -> Self {
        Self { when: When::OnFirstUse, ..Self::new(seed, device) }
    }

    /// Where the parameters are put.
    pub fn device(&self) -> &Device {
        &self.device
    }

    /// U(−bound, bound).
    pub fn uniform<const D: usize>(&mut self, shape: [usize; D], bound: f64) -> Param<Tensor<D>> {
        self.parameter(shape, move |rng, count| {
            (0..count).map(|_| (rng.random::<f64>() * 2.0 - 1.0) * bound).map(|v| v as f32).collect()
        })
    }

    /// N(0, std²).
    pub fn normal<const D: usize>(&mut self, shape: [usize; D], std: f64) -> Param<Tensor<D>> {
        self.parameter(shape, move |rng, count| {
            let mut draw = || -> f64 { StandardNormal.sample(rng) };
            (0..count).map(|_| (draw() * std) as f32).collect()
        })
    }

    /// One value everywhere.
    pub fn constant<const D: usize>(&mut self, shape: [usize; D], value: f32) -> Param<Tensor<D>> {
        self.parameter(shape, move |_, count| vec![value; count])
    }

    /// The identity matrix.
    pub fn diagonal(&mut self, width: usize) -> Param<Tensor<2>> {
        self.parameter([width, width], move |_, count| {
            (0..count).map(|i| if i % (width + 1) == 0 { 1.0 } else { 0.0 }).collect()
        })
    }

    fn parameter<const D: usize>(
        &mut self,
        shape: [usize; D],
        values: impl FnOnce(&mut ChaCha8Rng, usize) -> Vec<f32> + Send + Sync + 'static,
    ) -> Param<Tensor<D>> {
        let count = shape.iter().product();
        if self.when == When::Now {
            return Param::from_data(TensorData::new(values(&mut self.rng, count), shape), &self.device);
        }
        // A stream of its own, so that the order of first uses does not matter.
        let mut own = ChaCha8Rng::seed_from_u64(self.rng.random());
        let start = move |device: &Device, train: bool| {
            Tensor::from_data(TensorData::new(values(&mut own, count), shape), device).set_require_grad(train)
        };
        Param::uninitialized(ParamId::new(), start, self.device.clone(), true, shape.into())
    }
}

#[cfg(test)]
mod tests {
    use burn::module::Module;

    use super::*;
    use crate::weights::{fill_params, named_params, param_shapes};
    use crate::{Bias, Linear};

    #[test]
    fn lazy_parameters_are_drawn_once_and_alike_whatever_comes_first() {
        let device = Device::flex();
        let pair = || {
            let mut init = Init::lazy(3, &device);
            [Linear::new(20, 30, Bias::With, &mut init), Linear::new(20, 30, Bias::With, &mut init)]
        };
        let (forwards, backwards) = (pair(), pair());
        assert_eq!(forwards[0].num_params(), 630);
        assert_eq!(param_shapes(&forwards[0])[0], ("weight".to_owned(), vec![30, 20]));
        assert!(!forwards[0].weight.is_initialized(), "counting must not draw");
        let first = named_params(&forwards[0]).unwrap();
        named_params(&backwards[1]).unwrap();
        assert_eq!(first, named_params(&backwards[0]).unwrap());
        assert_ne!(first, named_params(&forwards[1]).unwrap());
        let bound = 1.0 / 20.0_f32.sqrt();
        let weight = &first[0].1.data;
        assert!(weight.iter().all(|v| v.abs() <= bound) && weight.iter().any(|v| v.abs() > 0.9 * bound));
    }

    #[test]
    fn filling_a_lazy_model_keeps_ids_and_training_state() {
        for device in [Device::flex(), Device::flex().autodiff()] {
            let mut init = Init::lazy(3, &device);
            let before = Linear::new(2, 3, Bias::With, &mut init);
            let id = before.weight.id;
            let after = fill_params(before, |_, shape| Ok(vec![2.0; shape.iter().product()])).unwrap();
            assert_eq!(after.weight.id, id);
            assert_eq!(after.weight.is_require_grad(), device.is_autodiff());
            assert_eq!(named_params(&after).unwrap()[0].1.data, vec![2.0; 6]);
            let frozen = Linear::new(2, 3, Bias::With, &mut init).no_grad();
            let frozen = fill_params(frozen, |_, shape| Ok(vec![2.0; shape.iter().product()])).unwrap();
            assert!(!frozen.weight.is_require_grad() && !frozen.train().weight.is_require_grad());
        }
    }
}
