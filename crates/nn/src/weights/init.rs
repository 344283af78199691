//! Initial values drawn on the host, each parameter from its own stream.

use burn::module::Module;
use rand::distr::Distribution;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

use super::fill_params;
use crate::golden::fnv1a64;

/// Distribution of a parameter's initial values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum InitRule {
    /// Even over [-bound, bound).
    Uniform(f32),
    /// Mean zero, this standard deviation.
    Normal(f32),
    /// All equal.
    Constant(f32),
}

/// Fills every float parameter by the distribution that `rule(path, shape)` names.
///
/// A parameter's values depend on `seed`, its path and its length only, so every backend and every order of
/// construction gives the same network.
#[must_use]
pub fn seeded_init<M: Module>(module: M, seed: u64, rule: impl Fn(&str, &[usize]) -> InitRule) -> M {
    fill_params(module, |path, shape| Ok(draw(seed, path, shape.iter().product(), rule(path, shape))))
        .expect("the rule cannot fail and draws as many values as the shape holds")
}

fn draw(seed: u64, path: &str, count: usize, init: InitRule) -> Vec<f32> {
    let mut rng = stream(seed, path);
    match init {
        InitRule::Constant(value) => vec![value; count],
        InitRule::Uniform(bound) => (0..count).map(|_| bound * unit(&mut rng)).collect(),
        InitRule::Normal(std) => (0..count)
            .map(|_| (f64::from(std) * Distribution::<f64>::sample(&StandardNormal, &mut rng)) as f32)
            .collect(),
    }
}

/// ChaCha8 keyed by the seed, the path and a constant that keeps these streams apart from other uses of the seed.
fn stream(seed: u64, path: &str) -> ChaCha8Rng {
    let mut key = *b"................rigscape initial";
    key[..8].copy_from_slice(&seed.to_le_bytes());
    key[8..16].copy_from_slice(&fnv1a64(path).to_le_bytes());
    ChaCha8Rng::from_seed(key)
}

/// Even over [-1, 1) in steps of 2^-23, exact in f32.
fn unit(rng: &mut ChaCha8Rng) -> f32 {
    (rng.next_u32() >> 8) as f32 / (1 << 23) as f32 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(values: &[f32]) -> (f64, f64) {
        let n = values.len() as f64;
        let mean = values.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
        (mean, (values.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n).sqrt())
    }

    #[test]
    fn distributions_have_their_moments() {
        // Standard errors at 100 000 values: mean 0.32 % and deviation 0.22 % of the deviation.
        let (mean, deviation) = moments(&draw(1, "a", 100_000, InitRule::Normal(0.02)));
        assert!(mean.abs() < 2.5e-4 && (deviation / 0.02 - 1.0).abs() < 0.01, "{mean} {deviation}");
        let uniform = draw(1, "a", 100_000, InitRule::Uniform(3.0));
        let (mean, deviation) = moments(&uniform);
        assert!(mean.abs() < 0.03 && (deviation / 3_f64.sqrt() - 1.0).abs() < 0.01, "{mean} {deviation}");
        assert!(uniform.iter().all(|&v| (-3.0..3.0).contains(&v)));
    }

    #[test]
    fn the_first_values_are_pinned() {
        let bits =
            |init: InitRule| draw(42, "blocks.0.weight", 2, init).iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(InitRule::Uniform(1.0)), [3_196_936_720, 3_158_907_136]);
        assert_eq!(bits(InitRule::Normal(1.0)), [3_149_559_930, 1_030_507_812]);
    }
}
