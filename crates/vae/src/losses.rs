//! Training losses of BEV-VAE (section 5) and the adaptive adversarial weight (section 5.1).
//!
//! Image terms are means over the pixels, channels and valid views; the KL is a sum over the latent and a mean over samples.

use burn::tensor::activation::relu;
use burn::tensor::{Bool, Int, Tensor, TensorData};
use nn::layout::patches_from_image;

/// Mean squared difference over valid views (item 2). Where a dataset has pixels to ignore, a view's mean is over those that count.
///
/// # Shapes
/// - decoded, target: `[B, V, 3, H, W]`
/// - mask: `[B, V]`
/// - counted: `[B, V, 1, H, W]`, 1 where a pixel counts, else 0; `None` when all do
/// - output: `[1]`
pub fn masked_l2(
    decoded: Tensor<5>,
    target: Tensor<5>,
    mask: Tensor<2, Bool>,
    counted: Option<Tensor<5>>,
) -> Tensor<1> {
    let [b, v, c, h, w] = decoded.dims();
    let squares = (decoded - target).square();
    let per_view = match counted {
        None => ops::mean_dim(squares.reshape([b, v, c * h * w]), 2),
        Some(counted) => {
            let sum = ops::sum_dim((squares * counted.clone()).reshape([b, v, c * h * w]), 2);
            // A view without any counted pixel has the error 0.
            sum / ops::sum_dim(counted.reshape([b, v, h * w]), 2).mul_scalar(c as f64).clamp_min(1.0)
        }
    };
    let weights = mask.float();
    (per_view.reshape([b, v]) * weights.clone()).sum() / weights.sum()
}

/// The target's pixels where a pixel does not count, so that networks which look at whole pictures find no difference there.
///
/// # Shapes
/// As [`masked_l2`].
pub fn with_ignored_pixels_of(decoded: Tensor<5>, target: &Tensor<5>, counted: Option<&Tensor<5>>) -> Tensor<5> {
    match counted {
        None => decoded,
        Some(counted) => target.clone() + (decoded - target.clone()) * counted.clone(),
    }
}

/// Hinge loss of the discriminator: mean max(0, 1 − D(x)) + mean max(0, 1 + D(x̂)) (item 5).
pub fn hinge_discriminator(real: Tensor<1>, fake: Tensor<1>) -> Tensor<1> {
    relu(1.0 - real).mean() + relu(fake + 1.0).mean()
}

/// First-order substitute for R1: the mean squared slope of the score along random directions, by central differences. For directions
/// v ~ N(0, I) its expectation is the mean of ‖∇D‖² up to O(ε²) (item 5.2).
///
/// # Shapes
/// - images, directions: `[N, 3, H, W]`
/// - output: `[1]`
pub fn squared_slope(
    score: impl Fn(Tensor<4>) -> Tensor<1>,
    images: Tensor<4>,
    directions: Tensor<4>,
    epsilon: f64,
) -> Tensor<1> {
    let n = images.dims()[0];
    let step = directions * epsilon;
    let scores = score(Tensor::cat(vec![images.clone() + step.clone(), images - step], 0));
    let slope = (scores.clone().narrow(0, 0, n) - scores.narrow(0, n, n)) / (2.0 * epsilon);
    slope.square().mean()
}

/// LeCam regulariser: mean (D(x) − a_F)² + mean (D(x̂) − a_R)² with the running means a_R, a_F of the scores of real and painted
/// pictures (item 5.2; Tseng et al., "Regularizing Generative Adversarial Networks under Limited Data", equation 4).
pub fn lecam(real: Tensor<1>, fake: Tensor<1>, [mean_real, mean_fake]: [f64; 2]) -> Tensor<1> {
    (real - mean_fake).square().mean() + (fake - mean_real).square().mean()
}

/// Adversarial loss of the generator: −mean D(x̂) (item 6).
pub fn adversarial(fake: Tensor<1>) -> Tensor<1> {
    -fake.mean()
}

/// The views at the given flat positions (sample · V + view).
///
/// # Shapes
/// - images: `[B, V, 3, H, W]`
/// - output: `[N, 3, H, W]`
pub fn select_views(images: Tensor<5>, positions: &[usize]) -> Tensor<4> {
    let [b, v, c, h, w] = images.dims();
    let indices: Vec<i64> = positions.iter().map(|p| *p as i64).collect();
    let count = indices.len();
    let indices = Tensor::<1, Int>::from_data(TensorData::new(indices, [count]), &images.device());
    images.reshape([b * v, c, h, w]).select(0, indices)
}

/// Norm of a loss's gradient over the weight of the last layer, ∇_L = hᵀ·G, without a tape: the last layer is linear per token.
///
/// # Shapes
/// - tokens: `[N, h, w, E]`, entering the last layer
/// - gradient: `[N, 3, h·k, w·k]`, with respect to the decoded pictures
/// - output: `[1]`
pub fn last_layer_gradient_norm(tokens: Tensor<4>, gradient: Tensor<4>) -> Tensor<1> {
    let [n, h, w, e] = tokens.dims();
    let patch = gradient.dims()[2] / h;
    let patches = patches_from_image(gradient, patch);
    let numbers = patches.dims()[3];
    let tokens = tokens.reshape([n * h * w, e]);
    let weight_gradient = tokens.transpose().matmul(patches.reshape([n * h * w, numbers]));
    weight_gradient.square().sum().sqrt()
}

/// λ = ‖∇_L L_R‖ / (‖∇_L L_A‖ + 1e-6), clamped to [0, 1e4] (item 7).
pub fn adaptive_weight(reconstruction_norm: Tensor<1>, adversarial_norm: Tensor<1>) -> Tensor<1> {
    (reconstruction_norm / (adversarial_norm + 1e-6)).clamp(0.0, 1e4)
}
