//! What the network predicts, and how the loss weighs timesteps.

use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::Level;

/// The network's regression target at `x = α·x0 + σ·noise`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Target {
    /// The noise, ε.
    #[default]
    Noise,
    /// v = α·noise − σ·x0 (Salimans & Ho, "Progressive Distillation").
    Velocity,
    /// The clean sample, x0.
    Clean,
}

impl Target {
    /// The target itself, for training. `alpha` and `sigma` broadcast against the samples: `[B, 1, ...]`.
    pub fn of<const D: usize>(self, x0: Tensor<D>, noise: Tensor<D>, alpha: Tensor<D>, sigma: Tensor<D>) -> Tensor<D> {
        match self {
            Self::Noise => noise,
            Self::Velocity => alpha * noise - sigma * x0,
            Self::Clean => x0,
        }
    }

    /// The clean sample that an output stands for. With `Noise` at a level without signal there is none.
    pub fn clean<const D: usize>(self, output: Tensor<D>, x: Tensor<D>, level: Level) -> Tensor<D> {
        let Level { alpha, sigma } = level;
        match self {
            Self::Noise => (x - output * sigma) / alpha,
            Self::Velocity => x * alpha - output * sigma,
            Self::Clean => output,
        }
    }

    /// The noise that an output stands for.
    pub fn noise<const D: usize>(self, output: Tensor<D>, x: Tensor<D>, level: Level) -> Tensor<D> {
        let Level { alpha, sigma } = level;
        match self {
            Self::Noise => output,
            Self::Velocity => output * alpha + x * sigma,
            Self::Clean => (x - output * alpha) / sigma,
        }
    }
}

/// Weight of a timestep's squared error.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LossWeight {
    /// 1, DDPM's simple loss.
    #[default]
    Uniform,
    /// Hang et al., "Efficient Diffusion Training via Min-SNR Weighting Strategy": the error of x0 counts min(SNR, γ).
    MinSnr(f64),
}

impl LossWeight {
    /// Factor on the squared error of `target` at `level`.
    pub fn factor(self, target: Target, level: Level) -> f64 {
        let Self::MinSnr(gamma) = self else { return 1.0 };
        let snr = level.snr();
        // The same clean-sample weight, divided by what turns each target's error into that of x0.
        match target {
            Target::Clean => snr.min(gamma),
            Target::Noise => snr.min(gamma) / snr,
            Target::Velocity => snr.min(gamma) / (snr + 1.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::Device;

    use super::*;

    #[test]
    fn every_target_gives_back_sample_and_noise() {
        let device = Device::flex();
        let x0 = Tensor::<2>::from_floats([[0.3, -1.2], [2.0, 0.1]], &device);
        let noise = Tensor::<2>::from_floats([[-0.7, 0.4], [1.1, -2.0]], &device);
        let level = Level::from_cumulative(0.37);
        let x = x0.clone() * level.alpha + noise.clone() * level.sigma;
        for target in [Target::Noise, Target::Velocity, Target::Clean] {
            let full = |value: f64| Tensor::<2>::full([2, 1], value, &device);
            let output = target.of(x0.clone(), noise.clone(), full(level.alpha), full(level.sigma));
            let error = |a: Tensor<2>, b: &Tensor<2>| (a - b.clone()).abs().max().into_scalar::<f32>();
            assert!(error(target.clean(output.clone(), x.clone(), level), &x0) < 1e-6);
            assert!(error(target.noise(output, x.clone(), level), &noise) < 1e-6);
        }
    }

    #[test]
    fn min_snr_weighs_every_target_by_the_same_error_of_the_clean_sample() {
        // An error e of x0 is e·α/σ in ε and e/σ in v.
        for cumulative in [0.01, 0.5, 0.9, 0.999] {
            let level = Level::from_cumulative(cumulative);
            let weight = |target| LossWeight::MinSnr(5.0).factor(target, level);
            let clean = weight(Target::Clean);
            assert!((weight(Target::Noise) * level.snr() - clean).abs() < 1e-9);
            assert!((weight(Target::Velocity) / level.sigma.powi(2) - clean).abs() < 1e-9);
            assert!(clean <= 5.0);
        }
        assert_eq!(LossWeight::Uniform.factor(Target::Noise, Level::from_cumulative(0.5)), 1.0);
    }
}
