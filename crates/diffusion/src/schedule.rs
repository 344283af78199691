//! How much noise each training timestep holds.

use serde::{Deserialize, Serialize};

use crate::DiffusionError;

/// β over the timesteps.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum BetaSchedule {
    /// Straight line; DDPM and DiT use 1e-4 to 0.02.
    Linear {
        /// β of the first timestep.
        start: f64,
        /// β of the last timestep.
        end: f64,
    },
    /// Straight line of √β; Stable Diffusion uses 0.00085 to 0.012.
    ScaledLinear {
        /// β of the first timestep.
        start: f64,
        /// β of the last timestep.
        end: f64,
    },
    /// Nichol & Dhariwal, "Improved DDPM", eq. 17, β at most 0.999.
    Cosine,
}

/// Settings of a [`NoiseSchedule`].
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScheduleConfig {
    /// β over the timesteps.
    pub beta: BetaSchedule,
    /// Training timesteps.
    #[serde(default = "thousand")]
    pub timesteps: usize,
    /// Rescale so that the last timestep is pure noise: Lin et al., "Common Diffusion Noise Schedules and Sample Steps are
    /// Flawed", algorithm 1.
    #[serde(default)]
    pub zero_terminal_snr: bool,
}

const fn thousand() -> usize {
    1000
}

impl ScheduleConfig {
    /// Stable Diffusion's.
    pub const STABLE_DIFFUSION: Self = Self {
        beta: BetaSchedule::ScaledLinear { start: 0.00085, end: 0.012 },
        timesteps: 1000,
        zero_terminal_snr: false,
    };
    /// DDPM's and DiT's.
    pub const DDPM: Self =
        Self { beta: BetaSchedule::Linear { start: 1e-4, end: 0.02 }, timesteps: 1000, zero_terminal_snr: false };
}

/// Signal and noise of one instant: `x = alpha·x0 + sigma·noise`, alpha² + sigma² = 1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Level {
    /// Factor on the clean sample.
    pub alpha: f64,
    /// Factor on the noise.
    pub sigma: f64,
}

impl Level {
    /// No noise left.
    pub const CLEAN: Self = Self { alpha: 1.0, sigma: 0.0 };

    /// The level with this ᾱ.
    pub fn from_cumulative(alpha_bar: f64) -> Self {
        Self { alpha: alpha_bar.sqrt(), sigma: (1.0 - alpha_bar).sqrt() }
    }

    /// ᾱ = alpha².
    pub fn cumulative(self) -> f64 {
        self.alpha * self.alpha
    }

    /// Half the log signal-to-noise ratio, ln(alpha/sigma); infinite when clean.
    pub fn lambda(self) -> f64 {
        self.alpha.ln() - self.sigma.ln()
    }

    /// Noise level of a sample scaled to alpha = 1 (Karras et al., "Elucidating the Design Space"): sigma/alpha.
    pub fn edm(self) -> f64 {
        self.sigma / self.alpha
    }

    /// Signal-to-noise ratio alpha²/sigma².
    pub fn snr(self) -> f64 {
        (self.alpha / self.sigma).powi(2)
    }
}

/// ᾱ of every training timestep, f64.
#[derive(Debug, Clone, PartialEq)]
pub struct NoiseSchedule {
    cumulative: Vec<f64>,
}

impl NoiseSchedule {
    /// The table.
    ///
    /// # Errors
    /// No timesteps, β outside (0, 1).
    pub fn new(config: &ScheduleConfig) -> Result<Self, DiffusionError> {
        if config.timesteps < 2 {
            return Err(DiffusionError(format!("a schedule needs at least 2 timesteps, not {}", config.timesteps)));
        }
        let betas = betas(&config.beta, config.timesteps);
        if let Some(beta) = betas.iter().find(|beta| !(**beta > 0.0 && **beta < 1.0)) {
            return Err(DiffusionError(format!("every beta must lie between 0 and 1, one is {beta}")));
        }
        let mut cumulative: Vec<f64> = betas
            .iter()
            .scan(1.0, |product, beta| {
                *product *= 1.0 - beta;
                Some(*product)
            })
            .collect();
        if config.zero_terminal_snr {
            rescale_to_zero_snr(&mut cumulative);
        }
        Ok(Self { cumulative })
    }

    /// Number of training timesteps.
    pub fn len(&self) -> usize {
        self.cumulative.len()
    }

    /// Never: a schedule has timesteps.
    pub fn is_empty(&self) -> bool {
        self.cumulative.is_empty()
    }

    /// ᾱ by timestep.
    pub fn cumulative(&self) -> &[f64] {
        &self.cumulative
    }

    /// Level of a timestep; beyond the last one that of the last.
    pub fn level(&self, timestep: usize) -> Level {
        let at = timestep.min(self.cumulative.len().saturating_sub(1));
        Level::from_cumulative(self.cumulative.get(at).copied().unwrap_or(1.0))
    }

    /// EDM noise level of a timestep between two of the table, linear in the noise level.
    pub fn edm_at(&self, timestep: f64) -> f64 {
        let below = timestep.max(0.0).floor();
        let (low, high) = (self.level(below as usize).edm(), self.level(below as usize + 1).edm());
        low + (high - low) * (timestep.max(0.0) - below)
    }
}

fn betas(schedule: &BetaSchedule, count: usize) -> Vec<f64> {
    let line = |start: f64, end: f64, i: usize| start + (end - start) * i as f64 / (count - 1) as f64;
    let cosine = |u: f64| ((u + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
    let beta = |i: usize| match *schedule {
        BetaSchedule::Linear { start, end } => line(start, end, i),
        BetaSchedule::ScaledLinear { start, end } => line(start.sqrt(), end.sqrt(), i).powi(2),
        BetaSchedule::Cosine => {
            let share = |i: usize| i as f64 / count as f64;
            (1.0 - cosine(share(i + 1)) / cosine(share(i))).min(0.999)
        }
    };
    (0..count).map(beta).collect()
}

/// √ᾱ shifted and stretched so that the first stays and the last becomes 0.
fn rescale_to_zero_snr(cumulative: &mut [f64]) {
    let (Some(first), Some(last)) = (cumulative.first().map(|a| a.sqrt()), cumulative.last().map(|a| a.sqrt())) else {
        return;
    };
    for value in cumulative {
        *value = ((value.sqrt() - last) * first / (first - last)).powi(2);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() <= 5e-8 * b.abs().max(1.0), "{a} is not {b}");
    }

    #[test]
    fn known_values_of_the_published_schedules() {
        let sd = NoiseSchedule::new(&ScheduleConfig::STABLE_DIFFUSION).unwrap();
        close(sd.cumulative()[500], 0.276_332_683_8);
        close(sd.cumulative()[999], 0.004_660_098_5);
        close(sd.level(0).edm(), 0.029_167_2);
        close(sd.level(999).edm(), 14.614_641_2);
        close(sd.level(0).lambda(), 3.534_711_9);
        close(sd.level(999).lambda(), -2.682_023_8);
        let ddpm = NoiseSchedule::new(&ScheduleConfig::DDPM).unwrap();
        close(ddpm.cumulative()[0], 0.9999);
        close(ddpm.cumulative()[999], 4.0358e-5);
    }

    #[test]
    fn the_cosine_schedule_follows_its_curve_and_zero_snr_ends_in_pure_noise() {
        let config = ScheduleConfig { beta: BetaSchedule::Cosine, ..ScheduleConfig::DDPM };
        let cosine = NoiseSchedule::new(&config).unwrap();
        let curve = |u: f64| ((u + 0.008) / 1.008 * std::f64::consts::FRAC_PI_2).cos().powi(2);
        close(cosine.cumulative()[499], curve(0.5) / curve(0.0));
        let zero = ScheduleConfig { zero_terminal_snr: true, ..ScheduleConfig::STABLE_DIFFUSION };
        let (plain, zero) =
            (NoiseSchedule::new(&ScheduleConfig::STABLE_DIFFUSION).unwrap(), NoiseSchedule::new(&zero).unwrap());
        assert_eq!(zero.level(999).alpha, 0.0);
        close(zero.cumulative()[0], plain.cumulative()[0]);
        assert!(zero.cumulative().windows(2).all(|pair| pair[1] < pair[0]));
    }

    #[test]
    fn impossible_schedules_are_refused() {
        for (beta, timesteps) in [
            (BetaSchedule::Linear { start: 0.0, end: 0.02 }, 1000),
            (BetaSchedule::Linear { start: 0.1, end: 1.0 }, 1000),
            (BetaSchedule::Linear { start: f64::NAN, end: 0.5 }, 1000),
            (BetaSchedule::Cosine, 1),
        ] {
            assert!(NoiseSchedule::new(&ScheduleConfig { beta, timesteps, zero_terminal_snr: false }).is_err());
        }
    }
}
