//! The distribution over latents that the encoder answers with.

use burn::tensor::Tensor;

/// Range of the log variance; outside of it the exponential leaves f32.
const LOG_VAR: [f32; 2] = [-30.0, 20.0];

/// Independent normal distributions, one per number of the latent.
#[derive(Debug, Clone)]
pub struct Posterior {
    /// `[N, latent, h, w]`
    pub mean: Tensor<4>,
    /// `[N, latent, h, w]`, within [−30, 20]
    pub log_var: Tensor<4>,
}

impl Posterior {
    /// # Shapes
    /// - moments: `[N, 2·latent, h, w]`, means before log variances
    pub fn from_moments(moments: Tensor<4>) -> Self {
        let half = moments.dims()[1] / 2;
        let log_var = moments.clone().narrow(1, half, half).clamp(LOG_VAR[0], LOG_VAR[1]);
        Self { mean: moments.narrow(1, 0, half), log_var }
    }

    /// Standard deviations, `[N, latent, h, w]`.
    pub fn std(&self) -> Tensor<4> {
        (self.log_var.clone() * 0.5).exp()
    }

    /// A draw, from standard normal noise of the mean's shape.
    pub fn sample(&self, noise: Tensor<4>) -> Tensor<4> {
        self.mean.clone() + self.std() * noise
    }

    /// Divergence from the standard normal distribution in nats, summed over each item's latent, `[N]`.
    pub fn kl(&self) -> Tensor<1> {
        let [n, c, h, w] = self.mean.dims();
        let variance = self.log_var.clone().exp();
        let terms = self.mean.clone().square() + variance - 1.0 - self.log_var.clone();
        (ops::sum_dim(terms.reshape([n, c * h * w]), 1) * 0.5).squeeze_dim(1)
    }
}
