//! The variational bound that trains a learned variance.

use burn::tensor::{Tensor, TensorData, activation};

use crate::NoiseSchedule;

/// Half the distance of two grey levels in a picture of values in [-1, 1].
const HALF_BIN: f64 = 1.0 / 255.0;
/// Values beyond this stand at the end of the range, whose bin is open.
const NEAR_END: f32 = 0.999;
/// Least probability of a bin.
const LEAST: f64 = 1e-12;

/// The bound of each sample in bits per number, for a variance that lies where `fraction` says between its bounds.
///
/// Source: Nichol & Dhariwal, "Improved Denoising Diffusion Probabilistic Models", eq. 4 and 15: the divergence from the true posterior, at timestep
/// 0 the likelihood of `x0` rounded to 256 levels (with the cumulative distribution by tanh, as their code has it). The mean should come without
/// a gradient: the simple loss trains it.
///
/// # Shapes
/// - fraction: `[B, ..]`, 0 at the posterior's own variance and 1 at β; the network's value v gives `(v + 1) / 2`
/// - clean: the estimate of x0, x0 and xt: as fraction
/// - timesteps: length B
/// - output: `[B]`
///
/// # Panics
/// If the shapes disagree.
#[must_use]
pub fn variance_bound<const D: usize>(
    schedule: &NoiseSchedule,
    fraction: Tensor<D>,
    clean: Tensor<D>,
    x0: Tensor<D>,
    xt: Tensor<D>,
    timesteps: &[usize],
) -> Tensor<1> {
    let dims = x0.dims();
    assert_eq!(timesteps.len(), dims[0], "one timestep per sample");
    let numbers = dims[1..].iter().product::<usize>();
    let flat = |x: Tensor<D>| x.reshape([dims[0], numbers]);
    let (fraction, clean, x0, xt) = (flat(fraction), flat(clean), flat(x0), flat(xt));
    let steps: Vec<Step> = timesteps.iter().map(|&t| Step::new(schedule, t)).collect();
    let column = |value: fn(&Step) -> f64| {
        let values: Vec<f32> = steps.iter().map(|step| value(step) as f32).collect();
        Tensor::<2>::from_data(TensorData::new(values, [steps.len(), 1]), &x0.device())
    };
    let (small, large) = (column(|s| s.log_variance), column(|s| s.log_beta));
    let log_variance = fraction * (large - small.clone()) + small.clone();
    let mean = |clean: Tensor<2>| clean * column(|s| s.clean) + xt.clone() * column(|s| s.noisy);
    let (guess, truth) = (mean(clean), mean(x0.clone()));
    let distance = (guess.clone() - truth).square();
    let divergence = (log_variance.clone() - small.clone() - 1.0
        + (small - log_variance.clone()).exp()
        + distance * (-log_variance.clone()).exp())
        * 0.5;
    let last = column(|s| if s.last { 1.0 } else { 0.0 });
    let surprise = surprise(x0, guess, log_variance * 0.5);
    let nats = divergence * (-last.clone() + 1.0) + surprise * last;
    // A matrix product rather than a sum along an axis, whose gradient not every backend has right.
    let mean = Tensor::<2>::full([numbers, 1], 1.0 / numbers as f64, &nats.device());
    nats.matmul(mean).reshape([dims[0]]) / std::f64::consts::LN_2
}

/// What the bound needs to know of a timestep.
struct Step {
    clean: f64,
    noisy: f64,
    log_variance: f64,
    log_beta: f64,
    last: bool,
}

impl Step {
    fn new(schedule: &NoiseSchedule, timestep: usize) -> Self {
        let before = |t: usize| if t == 0 { 1.0 } else { schedule.level(t - 1).cumulative() };
        let now = schedule.level(timestep).cumulative();
        let alpha = now / before(timestep);
        let beta = 1.0 - alpha;
        // The posterior of timestep 0 has no variance; it takes that of timestep 1.
        let first = timestep.max(1);
        let later = schedule.level(first).cumulative();
        let variance = (1.0 - later / before(first)) * (1.0 - before(first)) / (1.0 - later);
        Self {
            clean: before(timestep).sqrt() * beta / (1.0 - now),
            noisy: alpha.sqrt() * (1.0 - before(timestep)) / (1.0 - now),
            log_variance: variance.ln(),
            log_beta: beta.ln(),
            last: timestep == 0,
        }
    }
}

/// −ln of the probability that a Gaussian gives the bin of `x0`, elementwise.
fn surprise(x0: Tensor<2>, mean: Tensor<2>, log_deviation: Tensor<2>) -> Tensor<2> {
    let precision = (-log_deviation).exp();
    let centred = x0.clone() - mean;
    let above = cumulative((centred.clone() + HALF_BIN) * precision.clone());
    let below = cumulative((centred - HALF_BIN) * precision);
    let log = |p: Tensor<2>| p.clamp_min(LEAST).log();
    let inner = log(above.clone() - below.clone());
    let at_low_end = x0.clone().lower_elem(-NEAR_END);
    let at_high_end = x0.greater_elem(NEAR_END);
    let upper = log(-below + 1.0);
    -inner.mask_where(at_high_end, upper).mask_where(at_low_end, log(above))
}

/// `(1 + tanh(√(2/π)·(x + 0.044715·x³))) / 2`, close to the normal distribution's.
fn cumulative(x: Tensor<2>) -> Tensor<2> {
    let cubic = x.clone() * x.clone() * x.clone() * 0.044_715;
    activation::sigmoid((x + cubic) * (2.0 * (2.0 / std::f64::consts::PI).sqrt()))
}
